"""Results to save, and what a folder holds."""

from __future__ import annotations

import hashlib
import itertools
import json
import os

import pytest

import lmdsl as lm
from lmdsl.common import arrays
from lmdsl.results.directory import reading, vectors, writing

OURS = {"certificate.json", "problem.json", "solution.npz"}
posix = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes and links")


def names(path):
    return {entry.name for entry in path.iterdir()}


def refusing(number, *calls):
    """Return a stand-in for a function of ``os`` that fails, at the given calls or always."""
    count = itertools.count(1)

    def fail(*_, **__):
        if not calls or next(count) in calls:
            raise OSError(number, os.strerror(number))

    return fail


def put(target, certificate=None, **contents):
    """Write a directory anew, its digests right."""
    stored = certificate or json.loads((target / "certificate.json").read_text())
    for name, held in contents.items():
        path = target / f"{name}.npz"
        path.write_bytes(arrays.packed(held))
        stored["files"][path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    (target / "certificate.json").write_bytes(reading.text(stored))


def refused(target):
    try:
        return not lm.verify(target).holds
    except lm.BadInput:
        return True


def content(array, kind):
    return arrays.header(array.shape, kind) + array.tobytes()


def put_apart(source, target, **changed):
    """Write a saved result anew, every vector in its own file, digests right."""
    result, about = lm.Result.load(source), json.loads((source / "certificate.json").read_text())
    begun, there = writing.Begun(target), {}
    for name, kind in vectors.types(result.problem).items():
        file = f"{name}.npy"
        held = changed.get(name, content(getattr(result, name), kind))
        begun.path(file).write_bytes(held)
        there[file] = reading.digest_of(file, held)
    others = [name for name in about["files"] if name not in (*there, vectors.ARCHIVE)]
    files = {name: (source / name).read_bytes() for name in others}
    begun.finish(files, there, lambda keys: reading.text({**about, **keys}))

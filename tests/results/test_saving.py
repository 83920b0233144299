"""Result directories on strange file systems, beside files of others; no answer is lost."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
import stat

import interrupted_saves
import numpy as np
import pytest
from problems import made, steps
from saved_results import OURS, names, posix, refusing

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.common import files
from lmdsl.results.directory import archive, writing
from lmdsl.systems import FunctionSystem


@pytest.fixture
def file(tmp_path):
    (tmp_path / "problem.json").write_text(json.dumps(steps()))
    return str(tmp_path / "problem.json")


# Whose files ----------------------------------------------------------------------------------


def test_other_files_of_a_result_directory_stay(tmp_path, results):
    target = tmp_path / "out"
    results[0].save(target)
    own = {"figures.pdf": b"%PDF", ".DS_Store": b"\0", "figures.png": b"mine", "notes": b"x",
           ".problem.json.swp": b"vi", "model.npz.bak": b"y"}  # fmt: skip
    for name, content in own.items():
        (target / name).write_bytes(content)
    (target / "runs").mkdir()
    (target / "runs" / "certificate.json").write_text("{}")
    before = target.stat().st_ino
    results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.01
    assert {name: (target / name).read_bytes() for name in own} == own
    assert (target / "runs" / "certificate.json").read_text() == "{}"
    assert names(target) == OURS | set(own) | {"runs"}
    assert target.stat().st_ino == before


MARKED = '{"format": "lmdsl-result/1"}'


@pytest.mark.parametrize(
    "held",
    [
        {"certificate.json": "{}"},
        {"certificate.json": "my diploma", "solution.npz": "x"},
        {"certificate.json": '{"format": "other/1"}', "problem.json": "{}"},
        {"certificate.json/content": "x"},
        {"problem.json": "{}", "solution.npz": "x"},
        {"figures.png": "x"},
        {".hidden": "x"},
        {".problem.json.0123456789abcdeX": "x"},
        {"certificate.json": MARKED, "solution.npz/thesis.tex": "x"},
        {"certificate.json": MARKED, "model.npz/thesis.tex": "x"},
        {"certificate.json": "[" * 100_000},
        {"certificate.json": "\xff"},
    ],
)
def test_a_folder_without_our_mark_is_refused_and_untouched(tmp_path, file, results, capsys, held):
    target = tmp_path / "out"
    for name, text in held.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_text(text)
    assert main(["solve", file, "--out", str(target)]) == 2
    assert capsys.readouterr().out == ""  # before work starts
    with pytest.raises(lm.BadInput):
        results[0].save(target)
    assert {name: (target / name).read_text() for name in held} == held
    assert names(target) == {name.split("/")[0] for name in held}


@pytest.mark.parametrize("litter", [".DS_Store", "Thumbs.db", "lost+found", "._x"])
def test_what_systems_leave_in_an_empty_folder_is_nothing(tmp_path, results, litter):
    target = tmp_path / "out"
    (target / litter).mkdir(parents=True)
    results[0].save(target)
    assert names(target) == OURS | {litter}


@posix
def test_links(tmp_path, results):
    place, link = tmp_path / "place", tmp_path / "link"
    link.symlink_to(place)
    results[0].save(link)  # made where the link points to
    assert link.is_symlink()
    assert interrupted_saves.gamma_held(place, results) == 1.0
    results[1].save(link)
    assert link.is_symlink()
    assert interrupted_saves.gamma_held(link, results) == 1.01
    assert names(tmp_path) == {"place", "link"}
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(lm.BadInput):
        results[0].save(loop)


def test_a_directory_of_an_earlier_version(tmp_path, results):
    target = tmp_path / "out"
    results[0].save(target)
    path = target / "certificate.json"
    stored = json.loads(path.read_text())
    del stored["save"], stored["files"]
    path.write_text(json.dumps(stored))
    with np.load(target / "solution.npz") as held:
        np.savez(target / "solution.npz", **held)
    assert interrupted_saves.gamma_held(target, results) == 1.0
    assert lm.verify(target).holds
    results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.01


def test_rows_of_an_older_function_go(tmp_path, results):
    own = made(steps()).replaced(system=FunctionSystem(next=lambda x, u: (x - 0.25 * u,)))
    target = tmp_path / "out"
    lm.solve(own).save(target)
    assert names(target) == OURS | {"model.npz"}
    loaded = lm.Result.load(target)
    with pytest.raises(lm.BadInput, match="copy that directory"):
        loaded.save(tmp_path / "again")
    results[1].save(target)
    assert names(target) == OURS
    assert lm.verify(target).holds


# File systems ---------------------------------------------------------------------------------


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EBADF])
def test_no_fsync(tmp_path, results, monkeypatch, number, there):
    if there:
        results[0].save(tmp_path / "out")
    monkeypatch.setattr(files.os, "fsync", refusing(number))
    results[1].save(tmp_path / "out")
    assert interrupted_saves.gamma_held(tmp_path / "out", results) == 1.01
    made(steps()).save(tmp_path / "p.json")
    assert lm.load(tmp_path / "p.json") == made(steps())


@pytest.mark.parametrize("there", [False, True])
def test_neither_modes_nor_locks_nor_the_mask_are_touched(tmp_path, results, monkeypatch, there):
    if there:
        results[0].save(tmp_path / "out")
    for name in ("chmod", "fchmod", "umask", "chown", "lockf"):
        if hasattr(os, name):
            monkeypatch.setattr(os, name, refusing(errno.EPERM))
    fcntl = pytest.importorskip("fcntl")
    for name in ("flock", "lockf"):
        monkeypatch.setattr(fcntl, name, refusing(errno.ENOSYS))
    results[1].save(tmp_path / "out")
    made(steps()).save(tmp_path / "p.json")
    assert names(tmp_path) == {"out", "p.json"}
    assert lm.verify(tmp_path / "out").holds


@posix
def test_permissions_are_those_of_the_mask(tmp_path, results):
    mask = os.umask(0o027)
    try:
        results[0].save(tmp_path / "out")
        made(steps()).save(tmp_path / "p.json")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o750
    for path in ("out/certificate.json", "out/solution.npz", "p.json"):
        assert stat.S_IMODE((tmp_path / path).stat().st_mode) == 0o640


@pytest.mark.parametrize("held", [[], ["lost+found"], ["result"]])
def test_a_mount_point(tmp_path, results, monkeypatch, held):
    """A directory that can neither be renamed nor replaced nor removed."""
    target = tmp_path / "out"
    target.mkdir()
    if held == ["result"]:
        results[0].save(target)
    elif held:
        (target / held[0]).mkdir()
    monkeypatch.setattr(writing.os, "rename", refusing(errno.EBUSY))
    monkeypatch.setattr(os, "rmdir", refusing(errno.EBUSY))
    results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.01
    assert names(tmp_path) == {"out"}


def broken(number, at):
    """Return an ``os.replace`` that fails from the given call on."""
    count, true = itertools.count(1), os.replace

    def replaced(a, b):
        if next(count) >= at:
            raise OSError(number, os.strerror(number))
        true(a, b)

    return replaced


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_directory_that_fails_half_way(tmp_path, results, monkeypatch, at):
    target = tmp_path / "out"
    results[0].save(target)
    with monkeypatch.context() as patch:
        patch.setattr(writing.os, "replace", broken(errno.EIO, at))
        with pytest.raises(lm.BadInput, match="input/output error"):
            results[1].save(target)
    assert interrupted_saves.gamma_held(target, results) == (1.0 if at == 1 else 1.01)
    assert lm.verify(target).holds
    results[2].save(target)
    assert interrupted_saves.gamma_held(target, results) == 1.02
    assert names(target) == OURS


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_full_disk(tmp_path, results, monkeypatch, there, at):
    target = tmp_path / "out"
    if there:
        results[0].save(target)
    before = {p.name: p.read_bytes() for p in target.iterdir()} if there else {}
    true, count = writing.write_new, itertools.count(1)

    def full(path, pieces):
        if next(count) >= at:
            path.write_bytes(b"half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        true(path, pieces)

    monkeypatch.setattr(writing, "write_new", full)
    with pytest.raises(lm.BadInput, match="no space left"):
        results[1].save(target)
    assert {p.name: p.read_bytes() for p in target.iterdir()} == before if there else True
    assert names(tmp_path) == ({"out"} if there else set())


# The answer is never lost ---------------------------------------------------------------------


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_a_result_that_cannot_be_saved_is_rescued(tmp_path, file, monkeypatch, capsys, form):
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setattr(archive.tempfile, "tempdir", str(home))
    true = writing.write

    def fails(target, *rest):
        if target == tmp_path / "out":
            raise OSError(errno.EROFS, "Read-only file system")
        true(target, *rest)

    monkeypatch.setattr(writing, "write", fails)
    assert main(["solve", file, "--out", str(tmp_path / "out"), *form]) == 2
    said = capsys.readouterr()
    assert "verified" in said.out
    if form:
        assert json.loads(said.out)["status"] == "verified"
    (saved,) = home.glob("lmdsl-*/out")
    assert said.err.count("\n") == 1
    assert "read-only file system" in said.err
    assert str(saved) in said.err
    assert lm.verify(saved).holds
    monkeypatch.setattr(writing, "write", refusing(errno.ENOSPC))
    monkeypatch.chdir(home)
    monkeypatch.setattr(archive.Path, "home", lambda: home)
    shutil.rmtree(saved.parent)
    assert main(["solve", file, "--out", str(tmp_path / "out"), *form]) == 2
    said = capsys.readouterr()
    assert "verified" in said.out
    assert "nothing was saved" in said.err
    assert list(home.iterdir()) == []


def test_saved_also_where_nobody_reads_the_report(tmp_path, file, monkeypatch):
    class Gone:
        def write(self, *_):
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")

        flush = write

    monkeypatch.setattr("sys.stdout", Gone())
    assert main(["solve", file, "--out", str(tmp_path / "out"), "--json"]) == 0
    assert lm.verify(tmp_path / "out").holds

"""Directories whose vectors are files of their own, as ranks write them: the same, but mapped."""

import json
import os
import shutil

import numpy as np
import pytest
from problems import made, standard_map
from saved_results import content, names, posix, put_apart, refused

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.results.directory import reading, vectors, writing

OURS = {"certificate.json", "problem.json", *(f"{name}.npy" for name in vectors.TYPES)}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    target = tmp_path_factory.mktemp("saved") / "out"
    lm.solve(made(standard_map(10))).save(target)
    return target


@pytest.fixture
def target(saved, tmp_path):
    put_apart(saved, tmp_path / "apart")
    return tmp_path / "apart"


def test_it_is_the_same_result(saved, target, tmp_path):
    assert names(target) == OURS
    one, found = lm.Result.load(saved), lm.Result.load(target)
    for name in vectors.TYPES:
        array = getattr(found, name)
        assert array.tobytes() == getattr(one, name).tobytes()
        assert type(array) is np.ndarray
        assert not array.flags.owndata  # mapped: it takes no memory of its own
        assert not array.flags.writeable
    assert found.to_dict() == one.to_dict()
    assert lm.verify(target).holds
    assert lm.verify(target).same_model
    assert found.simulate(100).to_dict() == one.simulate(100).to_dict()
    found.save(tmp_path / "again")
    again = tmp_path / "again/solution.npz"
    assert again.read_bytes() == (saved / "solution.npz").read_bytes()


@pytest.mark.long
def test_commands_read_it(target, tmp_path, capsys):
    for command in (["verify"], ["simulate", "--starts", "50"], ["plot"], ["explain"],
                    ["export", "--format", "csv", "--out", str(tmp_path / "x.csv")]):  # fmt: skip
        assert main([command[0], str(target), *command[1:]]) == 0, capsys.readouterr().err


def test_a_proof_is_added(target):
    before = (target / "value.npy").read_bytes()
    assert main(["prove", str(target), "--time-limit", "0.1"]) in (0, 1)
    assert names(target) == OURS | {"proof.npz"}
    assert (target / "value.npy").read_bytes() == before
    assert lm.verify(target).holds


def test_a_save_replaces_it_and_is_replaced(saved, target, tmp_path):
    lm.solve(made(standard_map(10, 1.01))).save(target)
    assert names(target) == {"certificate.json", "problem.json", "solution.npz"}
    put_apart(saved, target)
    assert names(target) == OURS
    assert lm.Result.load(target).gamma == lm.Result.load(saved).gamma


def test_what_was_begun_is_not_seen_and_can_be_left(saved, target, tmp_path):
    for place in (target, tmp_path / "new"):
        begun = writing.Begun(place)
        begun.path("value.npy").write_bytes(b"half")
        assert not place.exists() or lm.verify(place).holds
        begun.abandon()
    assert names(tmp_path) == {"apart"}
    assert names(target) == OURS


SPOILED = {  # a file of value.npy with right digest
    "short": lambda b: b[:-1],
    "long": lambda b: b + b"\0",
    "empty": lambda b: b"",
    "text": lambda b: b"value",
    "pickle": lambda b: content_of(np.array([{}] * 4, dtype=object)),
    "float32": lambda b: content_of(np.zeros(100, np.float32)),
    "big-endian": lambda b: content_of(np.zeros(100, ">f8")),
    "two axes": lambda b: content_of(np.zeros((10, 10))),
    "header": lambda b: b[:10] + b"{" * (len(b) - 10),
    "version": lambda b: b[:6] + b"\x02\x00" + b[8:],
}


def content_of(array):
    import io

    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize("how", SPOILED)
def test_files_that_are_not_what_they_should_be(saved, tmp_path, how, capsys):
    held = content(lm.Result.load(saved).value, "<f8")
    put_apart(saved, tmp_path / "out", value=SPOILED[how](held))
    assert main(["verify", str(tmp_path / "out")]) == 2
    assert "value.npy" in capsys.readouterr().err


@pytest.mark.parametrize("name", vectors.TYPES)
def test_a_spoiled_vector_is_refused(saved, tmp_path, name):
    """With the right digest by what is claimed, else by the digest."""
    array = getattr(lm.Result.load(saved), name).copy()
    inside = np.flatnonzero(lm.Result.load(saved).cell_status == 1)
    array[inside[3]] = array[inside[3]] / 2 if array.dtype.kind == "f" else 0
    put_apart(saved, tmp_path / "out", **{name: content(array, vectors.TYPES[name])})
    assert refused(tmp_path / "out")
    put_apart(saved, tmp_path / "digest")
    shutil.copy(tmp_path / f"out/{name}.npy", tmp_path / "digest")
    with pytest.raises(lm.BadInput, match="not the one this result was saved with"):
        lm.verify(tmp_path / "digest")


@posix
@pytest.mark.parametrize("kind", ["missing", "link", "fifo", "folder"])
def test_only_regular_files_are_mapped(target, tmp_path, kind):
    path = target / "value.npy"
    path.rename(tmp_path / "value.npy")
    if kind == "link":
        path.symlink_to(tmp_path / "value.npy")
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(lm.BadInput, match=r"value\.npy"):
        lm.Result.load(target)


def test_digests_of_blocks():
    """By hand: of two blocks, one of them whole."""
    from hashlib import sha256

    held = bytes(range(256)) * 5000
    two = sha256(held[: 2**20]).digest() + sha256(held[2**20 :]).digest()
    assert reading.digest_of("value.npy", held) == "blocks:" + sha256(two).hexdigest()
    assert reading.digest_of("problem.json", held) == sha256(held).hexdigest()


def test_loading_takes_no_memory_for_vectors(saved, tmp_path):
    """Of a million cells, 37 MB: what NumPy and Python allocate meanwhile."""
    import tracemalloc

    N, held = 10**6, {}
    for name, kind in vectors.TYPES.items():
        held[name] = content(np.zeros(N, kind), kind)
    put_apart(saved, tmp_path / "out", **held)
    place = tmp_path / "out/problem.json"
    problem = json.loads(place.read_text())
    for axis in problem["state_box"].values():
        axis["cells"] = 1000
    place.write_bytes(reading.text(problem))
    about = json.loads((tmp_path / "out/certificate.json").read_text())
    about["files"]["problem.json"] = reading.digest_of("problem.json", place.read_bytes())
    (tmp_path / "out/certificate.json").write_bytes(reading.text(about))
    tracemalloc.start()
    result = lm.Result.load(tmp_path / "out")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(result.value) == N
    assert peak < 20e6  # of which 16 MiB are what a small file may hold

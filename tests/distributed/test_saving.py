"""Directories that ranks write together: those of one process, whole or not at all."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from problems import made, standard_map
from random_problems import random_problem
from saved_results import names
from test_compiled import without_enclosures

import lmdsl as lm
from lmdsl import distributed
from lmdsl.distributed import saving
from lmdsl.ranks.threaded import as_threads
from lmdsl.results.directory import vectors, writing

EXAMPLES = Path(__file__).parents[2] / "examples"
OURS = {"certificate.json", "problem.json", *(f"{name}.npy" for name in vectors.TYPES)}


def over(count, problem, out, **options):
    """The answer of every rank of so many."""
    return as_threads(
        count, lambda ranks: distributed.solve(problem, out=out, ranks=ranks, **options)
    )


def certificate(path):
    return json.loads((path / "certificate.json").read_text())


def require_same(one, found):
    """Require the vectors of one process: policies to the bit, values to 12 digits."""
    assert (found.control_index == one.control_index).all()
    assert (found.cell_status == one.cell_status).all()
    for name in ("value", "lower", "measure"):
        ours, theirs = getattr(one, name), getattr(found, name)
        assert (np.isinf(ours) == np.isinf(theirs)).all()
        some = np.isfinite(ours)
        top = np.abs(ours[some]).max(initial=0.0)
        assert np.abs(ours[some] - theirs[some]).max(initial=0.0) <= 1e-6 * top, name


def require_one_save(tmp_path, problem, counts=(1, 2, 4, 3), **options):
    """Require what every number of ranks saves to be what one process finds."""
    one, first = lm.solve(problem, **options), None
    for count in counts:
        out = tmp_path / str(count)
        answers = over(count, problem, out, **options)
        told = [answer.to_dict() for answer in answers]
        assert all({**each, "seconds": 0} == {**told[0], "seconds": 0} for each in told)
        found = lm.Result.load(out)
        assert (found.status, found.cause, found.exit_status) == (
            one.status, one.cause, one.exit_status)  # fmt: skip
        for answer in answers:  # every rank has its own part of what was saved
            rank = answers.index(answer)
            own = slice(*answer.starts[rank : rank + 2])
            for name, array in answer.arrays().items():
                assert array.tobytes() == getattr(found, name)[own].tobytes()
        assert found.cost == told[0]["cost"]
        require_same(one, found)
        checked = lm.verify(out)
        assert checked.same_model
        assert checked.holds == (one.exit_status in (0, 3)), checked.reasons
        bits = {name: (out / name).read_bytes() for name in OURS - {"certificate.json"}}
        first = first or (bits, certificate(out)["model_sha256"])
        assert certificate(out)["model_sha256"] == first[1]
        if count in (1, 2, 4):
            assert bits == first[0]


@pytest.mark.parametrize("seed", [0, 3, 13])
def test_random_problems(tmp_path, seed):
    require_one_save(tmp_path, without_enclosures(seed))


def test_a_map(tmp_path):
    require_one_save(tmp_path, made(standard_map(12)), (1, 2, 4, 3, 7))


@pytest.mark.parametrize("name", ["logistic_map", "standard_map_held"])
def test_shipped_systems(tmp_path, name):
    require_one_save(tmp_path, lm.load(EXAMPLES / f"{name}.json"), (2, 3))


def test_refusals(tmp_path):
    """Of gamma, of C, and with require_all."""
    require_one_save(tmp_path / "gamma", made(standard_map(12, 2.6)), (1, 2, 3))
    some = next(p for p in map(random_problem, range(40)) if lm.solve(p).status == "verified"
                and lm.solve(p).coverage.share < 1 and p.successors == "sampled")  # fmt: skip
    require_one_save(tmp_path / "all", some, (1, 2), require_all=True)


def test_an_older_directory_is_replaced(tmp_path):
    out = tmp_path / "out"
    lm.solve(made(standard_map(10))).save(out)
    (out / "mine.txt").write_text("kept")
    over(2, made(standard_map(12)), out)
    assert names(out) == OURS | {"mine.txt"}
    assert lm.verify(out).holds
    over(3, made(standard_map(10, 1.01)), out)
    assert names(out) == OURS | {"mine.txt"}
    assert lm.Result.load(out).gamma == 1.01
    lm.solve(made(standard_map(10))).save(out)
    assert names(out) == {"certificate.json", "problem.json", "solution.npz", "mine.txt"}


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("stage", ["_made", "_written", "_hashes", "_finish"])
def test_a_disk_that_is_full_leaves_what_there_was(tmp_path, monkeypatch, older, stage):
    out, problem = tmp_path / "out", made(standard_map(10))
    if older:
        over(2, problem, out)
    before = {path.name: path.read_bytes() for path in tmp_path.glob("out/*")}
    whole = getattr(saving, stage)

    def full(*arguments):
        outcome = whole(*arguments) if stage == "_written" else None
        if stage != "_written" or arguments[2]:  # of one rank alone, the last
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return outcome

    monkeypatch.setattr(saving, stage, full)
    with pytest.raises(lm.BadInput, match="out: cannot write .*: no space left on device"):
        over(2, problem.replaced(gamma=1.01), out)
    assert {path.name: path.read_bytes() for path in tmp_path.glob("out/*")} == before
    assert names(tmp_path) == ({"out"} if older else set())


def test_a_folder_that_a_rank_does_not_see(tmp_path, monkeypatch):
    hidden = saving._written

    def unseen(answer, places, first):
        if first:
            places = {name: tmp_path / "elsewhere" / path.name for name, path in places.items()}
        return hidden(answer, places, first)

    monkeypatch.setattr(saving, "_written", unseen)
    with pytest.raises(lm.BadInput, match=r"no such file or directory \(rank 1\)"):
        over(3, made(standard_map(10)), tmp_path / "out")
    assert names(tmp_path) == set()


def test_places_are_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr("lmdsl.distributed.solving.solved", None)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/mine.txt").write_text("")
    for name in ("file", "folder"):
        with pytest.raises(lm.BadInput, match="choose another name"):
            over(2, made(standard_map(10)), tmp_path / name)


def test_leftovers_of_killed_saves_are_removed(tmp_path):
    out = tmp_path / "out"
    begun = writing.Begun(out)
    begun.path("value.npy").write_bytes(b"half")
    over(2, made(standard_map(10)), out)
    assert names(tmp_path) == {"out"}
    begun = writing.Begun(out)
    begun.path("value.npy").write_bytes(b"half")
    assert lm.verify(out).holds
    over(2, made(standard_map(10)), out)
    assert names(out) == OURS


def test_a_python_function_is_not_saved(tmp_path):
    from lmdsl.systems import FunctionSystem

    problem = lm.load(EXAMPLES / "logistic_map.json").replaced(
        system=FunctionSystem(next=lambda x, u: (3.9 * x * (1 - x) + u,))
    )
    with pytest.raises(lm.BadInput, match="Python functions"):
        over(2, problem, tmp_path / "out")
    assert names(tmp_path) == set()

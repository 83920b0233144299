"""Directories that ranks write together: those of one process, whole or not at all."""

import errno
import json
import os
from pathlib import Path

import pytest
from alike import require_alike, sampled
from problems import made, standard_map
from saved_results import names

import lmdsl as lm
from lmdsl import distributed
from lmdsl.distributed import saving
from lmdsl.ranks.threaded import as_threads
from lmdsl.results.directory import vectors, writing

pytestmark = pytest.mark.long  # in other versions it would find nothing else

EXAMPLES = Path(__file__).parents[2] / "examples"
OURS = {"certificate.json", "problem.json", *(f"{name}.npy" for name in vectors.TYPES)}


def over(count, problem, out, **options):
    """The answer of every rank of so many."""
    return as_threads(
        count, lambda ranks: distributed.solve(problem, out=out, ranks=ranks, **options)
    )


def certificate(path):
    return json.loads((path / "certificate.json").read_text())


def require_one_save(tmp_path, problem, counts=(1, 2, 4, 3), **options):
    """Require what every number of ranks saves to be what one process finds."""
    one, first = lm.solve(problem, **options), None
    for count in counts:
        out = tmp_path / str(count)
        answers = over(count, problem, out, **options)
        require_alike(one, answers)
        found = lm.Result.load(out)
        assert (found.status, found.cause, found.exit_status) == (
            one.status, one.cause, one.exit_status)  # fmt: skip
        for rank, answer in enumerate(answers):  # every rank has its own part of what was saved
            own = slice(*answer.starts[rank : rank + 2])
            for name, array in answer.arrays().items():
                assert array.tobytes() == getattr(found, name)[own].tobytes()
        assert found.cost == answers[0].cost
        checked = lm.verify(out)
        assert checked.same_model
        assert checked.holds == (one.exit_status in (0, 3)), checked.reasons
        bits = {name: (out / name).read_bytes() for name in OURS - {"certificate.json"}}
        first = first or (bits, certificate(out)["model_sha256"])
        assert certificate(out)["model_sha256"] == first[1]
        if count in (1, 2, 4):
            assert bits == first[0]


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 5, 13])
def test_random_problems(tmp_path, seed):
    require_one_save(tmp_path, sampled(seed))


def test_a_map(tmp_path):
    require_one_save(tmp_path, made(standard_map(12)))


@pytest.mark.parametrize(
    "name", ["logistic_map", pytest.param("standard_map_held", marks=pytest.mark.long)]
)
def test_shipped_systems(tmp_path, name):
    require_one_save(tmp_path, lm.load(EXAMPLES / f"{name}.json"), (2, 3))


@pytest.mark.long
def test_refusals(tmp_path):
    """Of gamma, and with require_all."""
    require_one_save(tmp_path / "gamma", made(standard_map(12, 9)), (1, 2, 3))
    require_one_save(tmp_path / "all", sampled(9), (1, 2), require_all=True)


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
    with pytest.raises(lm.BadInput, match=r"out: cannot write .*: no space left on device"):
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

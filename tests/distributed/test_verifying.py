"""Verifying over ranks finds what one process finds, of sound directories and of spoiled ones."""

import json
from dataclasses import replace

import numpy as np
import pytest
from alike import sampled
from problems import made, standard_map
from saved_results import content, put_apart
from verifications import over, require_same

import lmdsl as lm
from lmdsl import distributed
from lmdsl.distributed.auditing import same_levels
from lmdsl.ranks.threaded import as_threads
from lmdsl.results.directory import reading, vectors
from lmdsl.slabs import compiling

pytestmark = pytest.mark.long  # in other versions it would find nothing else


def require_alike(path, counts=(1, 2, 3)):
    """Require the outcome of one process; sentences about claims are other ones."""
    one = lm.verify(path)
    for count in counts:
        found = over(count, path)
        assert (found.holds, found.status, found.same_model) == (
            one.holds, one.status, one.same_model)  # fmt: skip
        assert found.certificate.claims == one.certificate.claims
        assert bool(found.reasons) == bool(one.reasons)
        ours, theirs = found.certificate.cost, one.certificate.cost
        assert (ours is None) == (theirs is None)
        assert ours is None or ours == pytest.approx(theirs, rel=1e-12)
    return one


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    target = tmp_path_factory.mktemp("saved") / "out"
    as_threads(2, lambda r: distributed.solve(made(standard_map(10)), out=target, ranks=r))
    return target


def test_a_sound_directory(saved, monkeypatch):
    assert require_alike(saved, (1, 2, 3, 4)).holds
    monkeypatch.setattr("lmdsl.distributed.verifying.verify_alone", None)  # not by rank 0 alone
    assert over(2, saved).holds


@pytest.mark.parametrize(
    "seed", [1, 7, 8, *(pytest.param(seed, marks=pytest.mark.long) for seed in (0, 3, 9, 13, 25))]
)
def test_random_problems(tmp_path, seed):
    """Verified, not verified, empty."""
    as_threads(2, lambda r: distributed.solve(sampled(seed), out=tmp_path / "out", ranks=r))
    require_alike(tmp_path / "out")


def test_what_one_process_saved_is_checked_by_the_first(tmp_path):
    lm.solve(made(standard_map(10))).save(tmp_path / "out")
    assert require_alike(tmp_path / "out", (2,)).holds
    assert over(2, tmp_path / "out", exact=True).holds


def spoiled(array, rng):
    """An array of which one entry is another one."""
    array = array.copy()
    k = int(rng.choice(np.flatnonzero(array > 0))) if array.any() else 0
    array[k] = array[k] / 2 if array.dtype.kind == "f" else (array[k] + 1) % 5
    return array


@pytest.mark.parametrize("name", vectors.TYPES)
def test_a_spoiled_vector_is_refused(saved, tmp_path, name):
    rng = np.random.default_rng(7)
    for k in range(3):
        array = spoiled(getattr(lm.Result.load(saved), name), rng)
        out = tmp_path / str(k)
        put_apart(saved, out, **{name: content(array, vectors.TYPES[name])})
        assert not require_alike(out, (2, 3)).holds
    (tmp_path / f"0/{name}.npy").write_bytes((saved / f"{name}.npy").read_bytes())
    with pytest.raises(lm.BadInput, match="not the one this result was saved with"):
        over(2, tmp_path / "0")


NUMBERS = {
    "cost": 1.0, "lower_bound": 9.0, "gap": 0.5, "contraction": 0.1, "pairs": 3, "cells": 99,
    "attractor_cells": 1, "stabilizable_cells": 7, "gamma": 1.5, "measure_residual": 1e-3,
    "status": "unverified", "cause": "empty", "scope": "all states", "reasons": ["none"],
}  # fmt: skip


@pytest.mark.parametrize("key", NUMBERS)
def test_a_spoiled_number_is_refused(saved, tmp_path, key):
    put_apart(saved, tmp_path / "out")
    place = tmp_path / "out/certificate.json"
    said = json.loads(place.read_text())
    place.write_bytes(reading.text({**said, key: NUMBERS[key]}))
    assert not require_alike(tmp_path / "out", (2,)).holds


@pytest.mark.parametrize("claim", ["stabilizing", "upper_bound", "lower_bound", "measure"])
def test_a_claim_that_is_not_made_is_refused(saved, tmp_path, claim):
    put_apart(saved, tmp_path / "out")
    place = tmp_path / "out/certificate.json"
    said = json.loads(place.read_text())
    said["claims"][claim] = False
    place.write_bytes(reading.text(said))
    assert not require_alike(tmp_path / "out", (2,)).holds


def test_another_model_is_told(saved, tmp_path):
    put_apart(saved, tmp_path / "out")
    place = tmp_path / "out/certificate.json"
    said = json.loads(place.read_text())
    place.write_bytes(reading.text({**said, "model_sha256": "0" * 64}))
    one = require_alike(tmp_path / "out", (2,))
    assert one.holds
    assert not one.same_model


def test_a_model_of_one_rank_that_is_another_one_is_refused(saved, monkeypatch):
    """The last rank compiles its cells with costs that are too small."""
    from dataclasses import replace

    whole = compiling.compiled

    def cheaper(ranks, *arguments):
        lp = whole(ranks, *arguments)
        cost = lp.cost * 0.5 if ranks.rank == 1 else lp.cost
        return replace(lp, cost=cost, _known=lp._algorithm_1)

    monkeypatch.setattr(compiling, "compiled", cheaper)
    found = over(2, saved)
    assert not found.same_model
    assert not found.holds


def test_what_cannot_be_read_is_one_error(tmp_path):
    with pytest.raises(lm.BadInput, match="is not a result directory"):
        over(2, tmp_path / "none")


def test_enclosed_successors(tmp_path, monkeypatch):
    """Claim 7 and sure levels, by all ranks; levels that are spoiled are refused."""
    problem, out = sampled(5).replaced(successors="enclosed"), tmp_path / "out"
    as_threads(2, lambda r: distributed.solve(problem, out=out, ranks=r))
    assert require_alike(out).holds
    monkeypatch.setattr("lmdsl.distributed.verifying.verify_alone", None)
    found = over(3, out)
    assert found.holds
    assert found.certificate.safe

    own = lm.Result.load(out)
    lp = as_threads(1, lambda ranks: compiling.compiled(ranks, problem))[0]
    assert same_levels(lp, own)
    levels = own.sure_levels.copy()
    levels[-1] += 1
    assert not same_levels(lp, replace(own, sure_levels=levels))
    assert not same_levels(lp, replace(own, sure_levels=None))


def test_a_problem_that_was_written_anew_is_noted(saved, tmp_path):
    put_apart(saved, tmp_path / "out")
    place = tmp_path / "out/problem.json"
    place.write_text(json.dumps(json.loads(place.read_text())))  # in one line
    one = require_same(tmp_path / "out", (2, 3))
    assert one.holds
    assert "problem.json was written anew" in one.notes[0]
    place.write_text(place.read_text().replace('"gamma": 1.0', '"gamma": 1.01'))
    assert not require_same(tmp_path / "out", (2, 3)).holds


def test_what_one_process_saved_of_ranks_is_checked_by_all(saved, tmp_path, monkeypatch):
    """Its vectors are in one archive; the digest is that of ranks."""
    lm.Result.load(saved).save(tmp_path / "out")
    monkeypatch.setattr("lmdsl.distributed.verifying.verify_alone", None)
    assert require_same(tmp_path / "out", (2, 3)).holds
    held = (tmp_path / "out/solution.npz").read_bytes()
    (tmp_path / "out/solution.npz").write_bytes(held[:-2000] + bytes(1) + held[-1999:])
    assert not require_same(tmp_path / "out", (2, 3)).holds

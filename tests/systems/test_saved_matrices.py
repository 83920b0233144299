"""Finite models saved with their matrices: spoiled, hostile, and of large integers."""

from __future__ import annotations

import json

import numpy as np
import pytest
from certificate_files import checked, exported

import lmdsl as lm
from lmdsl.common import arrays
from lmdsl.results.result import Result
from lmdsl.systems.matrices.rows import GivenRows


def spoilable(tmp_path):
    rng = np.random.default_rng(4)
    P = rng.dirichlet(np.full(6, 0.2), size=(2, 6))
    result = lm.solve(lm.from_matrices(P, rng.random((6, 2)), [0], discount=0.95))
    result.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds
    assert "(claims speak of the finite model as it was given)" in str(lm.verify(tmp_path / "out"))
    return result, tmp_path / "out"


def test_a_spoiled_matrix_is_not_confirmed(tmp_path):
    result, out = spoilable(tmp_path)
    rows = result.problem.system.rows
    held = rows.arrays()
    assert GivenRows.read(rows.sizes(), held) == rows
    cost = {**held, "cost": held["cost"] * 1.001}
    swapped = {**held, "code": held["code"].copy()}
    k = int(np.flatnonzero((rows.cell > 0) & (np.diff(rows.pointer) > 1))[0])
    a, b = rows.pointer[k : k + 2]
    swapped["code"][a], swapped["code"][b - 1] = held["code"][b - 1], held["code"][a]
    for spoiled in (cost, swapped):
        (out / "model.npz").write_bytes(arrays.packed(spoiled).replace(arrays.MARK, b"other"))
        found = lm.verify(out)
        assert not found.holds
        assert not found.same_model


@pytest.mark.parametrize("name", ["pointer", "target", "code", "numerator", "cell", "control"])
def test_rows_that_are_none_are_refused(name, tmp_path):
    result, out = spoilable(tmp_path)
    held = result.problem.system.rows.arrays()
    for change in (1, 2**31 - 7):
        array = held[name].copy()
        array.ravel()[1] += np.asarray(change).astype(array.dtype)
        content = arrays.packed({**held, name: array}).replace(arrays.MARK, b"other")
        (out / "model.npz").write_bytes(content)
        with pytest.raises(lm.BadInput, match=r"model\.npz"):
            lm.verify(out)


@pytest.mark.parametrize("sizes", [None, {}, {"cells": 10**9}, {"limbs": 10**6}, {"pairs": -1},
                                   {"entries": 10**9, "codes": 10**9}, {"codes": 3}])  # fmt: skip
def test_sizes_of_a_stranger(sizes, tmp_path):
    _, out = spoilable(tmp_path)
    stored = json.loads((out / "problem.json").read_text())
    held = stored["system"]["sizes"]
    stored["system"]["sizes"] = sizes if not sizes else {**held, **sizes}
    (out / "problem.json").write_text(json.dumps(stored) + " ")
    with pytest.raises(lm.BadInput):
        lm.verify(out)


def test_large_denominators_are_stored_and_exported(tmp_path):
    """Probabilities down to 1e-300: integers of a thousand bits."""
    P = np.array([[1 - 1e-3, 1e-3, 1e-300], [1e-200, 0.25, 0.75], [0, 0, 1]])
    result = lm.solve(lm.from_matrices(P, [1, 1, 0], [2], discount=0.5))
    assert result.status == "verified"
    result.save(tmp_path / "out")
    assert Result.load(tmp_path / "out").problem == result.problem
    assert lm.verify(tmp_path / "out", exact=True).holds
    status, said = checked(exported(result, tmp_path))
    assert status == 0, said


@pytest.mark.parametrize("targets", [(), (0,)])
@pytest.mark.parametrize("status", ["verified", "unverified"])
def test_another_best_reward_is_not_confirmed(targets, status, tmp_path):
    """Without targets it stands in no row and no cost: only the reward knows it."""
    rng = np.random.default_rng(5)
    P = rng.dirichlet(np.ones(6), size=(2, 6))
    problem = lm.from_matrices(P, rng.random((6, 2)), targets, discount=0.9, maximise=True)
    limit = 1 if status == "unverified" else None
    result = lm.solve(problem, max_iterations=limit)
    out = tmp_path / "out"
    result.save(out)
    assert lm.verify(out).holds == result.verified
    stored = json.loads((out / "problem.json").read_text())
    best = stored["system"]["best_reward"]
    certificate = json.loads((out / "certificate.json").read_text())
    assert certificate["reward"] == result.reward
    for other in (best * (1 + 1e-6), best + 1, 0.0, None):
        system = {**stored["system"], "best_reward": other}
        if other is None:
            del system["best_reward"]
        (out / "problem.json").write_text(json.dumps({**stored, "system": system}) + " ")
        found = lm.verify(out)
        assert not found.holds
        assert any("reward is stored as" in reason for reason in found.reasons), found
    # A directory saved before the key was: it is verified as it was.
    (out / "problem.json").write_text(json.dumps(stored) + " ")
    del certificate["reward"]
    (out / "certificate.json").write_text(json.dumps(certificate, indent=1))
    assert lm.verify(out).holds == result.verified

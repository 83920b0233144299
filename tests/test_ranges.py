"""Large models are worked on in ranges of cells; so are small ones here, to the same answer."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from problems import made, standard_map

import lmdsl as lm
from lmdsl import bellman, certificate, linear, peeling, rows, sweeps, threads, witness


@pytest.mark.parametrize("workers", [1, 2])
def test_ranges_and_halves_give_the_same_policy(monkeypatch, workers):
    problem = made(standard_map(16))
    whole = lm.solve(problem)
    monkeypatch.setattr(bellman, "GRAIN", 1)
    monkeypatch.setattr(sweeps, "SPLIT", 1)
    for room in (rows, peeling, certificate, witness):
        monkeypatch.setattr(room, "MANY", 1)
    monkeypatch.setattr(threads, "count", lambda: workers)
    parts = lm.solve(problem)
    assert parts.status == whole.status == "verified"
    np.testing.assert_array_equal(parts.control_index, whole.control_index)
    np.testing.assert_allclose(parts.value, whole.value, rtol=1e-12)


def test_halves_solve_the_system(monkeypatch):
    rng = np.random.default_rng(0)
    n = 60
    M = sp.random_array((n, n), density=0.1, rng=rng, format="csr")
    M.data *= 0.9 / np.maximum(M.sum(axis=1), 1e-9).max()
    b = rng.random(n)
    monkeypatch.setattr(sweeps, "SPLIT", 1)
    x = linear.solve(M, b)
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(n) - M.toarray(), b), rtol=1e-12)


def test_a_pass_agrees_with_numpy(monkeypatch):
    lp = lm.compile(made(standard_map(16)))
    V = np.random.default_rng(1).random(lp.n)
    Q = lp.gamma * (lp.rows.matrix() @ V) + lp.cost
    monkeypatch.setattr(bellman, "GRAIN", 1)
    found = bellman.improve(lp, V)
    np.testing.assert_allclose(found.value, np.minimum.reduceat(Q, lp.pair_pointer[:-1]))
    np.testing.assert_allclose(Q[found.pair], found.value)

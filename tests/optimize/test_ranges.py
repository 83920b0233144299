"""Large models are worked on in ranges of cells; so are small ones here, to the same answer."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from models import mdp, random_lp
from problems import made, standard_map

import lmdsl as lm
from lmdsl.certificate import judge, vectors
from lmdsl.machine import threads
from lmdsl.model import rows
from lmdsl.optimize import witness
from lmdsl.optimize.linear import equations, gauss_seidel, substitution
from lmdsl.optimize.policies import bellman


@pytest.mark.parametrize("workers", [1, 2])
def test_ranges_and_halves_give_the_same_policy(monkeypatch, workers):
    problem = made(standard_map(16))
    whole = lm.solve(problem)
    monkeypatch.setattr(vectors, "TRANSITIONS_A_RANGE", 1)
    monkeypatch.setattr(gauss_seidel, "PARALLEL_FROM", 1)
    for module in (rows, substitution, judge, witness):
        monkeypatch.setattr(module, "PARALLEL_FROM", 1)
    monkeypatch.setattr(threads, "count", lambda: workers)
    parts = lm.solve(problem)
    assert parts.status == whole.status == "verified"
    np.testing.assert_array_equal(parts.control_index, whole.control_index)
    np.testing.assert_allclose(parts.value, whole.value, rtol=1e-12)


def test_halves_solve_the_system(monkeypatch):
    rng = np.random.default_rng(0)
    n = 60
    M = sp.csr_array(rng.random((n, n)) * (rng.random((n, n)) < 0.1))
    M.data *= 0.9 / np.maximum(M.sum(axis=1), 1e-9).max()
    b = rng.random(n)
    monkeypatch.setattr(gauss_seidel, "PARALLEL_FROM", 1)
    x = equations.solve(M, b)
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(n) - M.toarray(), b), rtol=1e-12)


def test_a_pass_agrees_with_numpy(monkeypatch):
    lp = lm.compile(made(standard_map(16)))
    V = np.random.default_rng(1).random(lp.n)
    Q = lp.gamma * (lp.rows.matrix() @ V) + lp.cost
    monkeypatch.setattr(vectors, "TRANSITIONS_A_RANGE", 1)
    found = bellman.improve(lp, V)
    np.testing.assert_allclose(found.value, np.minimum.reduceat(Q, lp.pair_pointer[:-1]))
    np.testing.assert_allclose(Q[found.policy], found.value)


@pytest.mark.parametrize("gamma", [0.9, 1.0, 1.3])
def test_a_rising_pass_agrees_with_numpy(gamma, monkeypatch):
    """Cells in turn, staying put summed up; who stays at no less than 1 / gamma is no choice."""
    monkeypatch.setattr(vectors, "TRANSITIONS_A_RANGE", 1)
    rose = stuck = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        lp = random_lp(rng, 20, controls=4, samples=3, spread=2)
        lp, V = replace(lp, cost=np.ones(lp.K)), rng.random(lp.n) * 20
        P = lp.rows.matrix().toarray()
        for ranges, backwards in itertools.product((1, 3), (False, True)):
            monkeypatch.setattr(bellman, "IN_PLACE", ranges)
            count = min(ranges, lp.n)
            value, pair = V.copy(), np.zeros(lp.n, dtype=int)
            for part in range(count):
                x, cells = V.copy(), range(lp.n * part // count, lp.n * (part + 1) // count)
                for i in cells[:: -1 if backwards else 1]:
                    own = np.arange(lp.pair_pointer[i], lp.pair_pointer[i + 1])
                    left = 1 - gamma * P[own, i]
                    q = 1 + gamma * (P[own] @ x - P[own, i] * x[i])
                    q = np.where(left > 0, q / np.where(left > 0, left, 1), np.inf)
                    stuck += (left <= 0).any()
                    pair[i] = own[q.argmin()]
                    rose += q.min() > x[i]
                    value[i] = x[i] = max(x[i], q.min())
            found = bellman.rise(lp, V, gamma, backwards)
            np.testing.assert_allclose(found.value, value, rtol=1e-12)
            np.testing.assert_array_equal(found.policy, pair)
    assert rose
    assert bool(stuck) == (gamma >= 1)


def test_of_equal_controls_a_pass_takes_the_first():
    choices = [({-1: 1}, 2.0), ({-1: 1}, 1.0), ({-1: 1}, 1.0)]
    lp = mdp([choices, choices[1:]], 1, 1.0)
    assert bellman.improve(lp, np.zeros(2)).policy.tolist() == [1, 3]

"""Evaluating a policy: leaps along a slow mode, and systems that sweeps do not solve."""

import copy

import numpy as np
import pytest
import scipy.sparse as sp
from models import random_lp
from problems import made
from slow_models import above, exact, mixing, transport

import lmdsl as lm
from lmdsl.common import types
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.linear import equations, extrapolation, gauss_seidel
from lmdsl.optimize.linear.policy_system import of_policy
from lmdsl.optimize.linear.substitution import Peeled
from lmdsl.optimize.policies import evaluation, iteration
from lmdsl.optimize.policies.screening import Screen


@pytest.mark.parametrize("gamma", [0.5, 0.9999, 1.0, 1.01])
def test_the_rows_of_a_policy_as_a_system(gamma):
    """The diagonal apart, as 1 / (1 - own); a cell that stays put for ever never ends."""
    problem = made(
        {
            "system": {"kind": "map", "next": {"x": "x + u"}},
            "state_box": {"x": {"low": -1, "high": 1, "cells": 40}},
            "attractor": {"points": [{"x": 0}]},
            "control_grid": {"u": {"low": -0.2, "high": 0.2, "points": 9}},
            "stage_cost": "1",
            "sampling": {"kind": "random", "points": 6, "seed": 0},
            "gamma": gamma,
        }
    )
    lp, rng = lm.compile(problem), np.random.default_rng(9)
    stays = np.zeros(lp.n, dtype=bool)
    for _ in range(20):
        pair = rng.integers(lp.pair_pointer[:-1], lp.pair_pointer[1:])
        found = of_policy(lp, pair, gamma)
        expected = gamma * lp.rows.matrix(pair).toarray()
        own = expected.diagonal().copy()
        stays |= own == gamma
        inverse = np.full(lp.n, gauss_seidel.NEVER)
        inverse[own < 1] = 1 / (1 - own[own < 1])
        np.testing.assert_allclose(found.inverse, inverse, rtol=1e-12)
        rest = np.diag(own)
        for i, (begin, end) in enumerate(zip(found.begin, found.end, strict=True)):
            rest[i, found.indices[begin:end]] += found.data[begin:end]
        np.testing.assert_allclose(rest, expected, rtol=1e-15)
    assert stays.any()


@pytest.mark.parametrize("escape", [0.5, 0.02, 1e-3])
@pytest.mark.parametrize("make", ["mixing", "transport"])
def test_a_leap_stays_above_its_equation(escape, make):
    rng = np.random.default_rng(1)
    for n in (1, 2, 50, 400):
        M = mixing(n, escape, rng) if make == "mixing" else transport(n, rng)
        b = rng.uniform(0.1, 1.0, n)
        x = above(M, b, rng)
        before, V = x.copy(), exact(M, b)
        t = extrapolation.extrapolate(gauss_seidel.SplitMatrix.of(M), b, x)
        assert t >= 1
        assert (x <= before * (1 + 1e-15)).all()
        assert (x >= V * (1 - 1e-12)).all()
        assert (x >= (b + M @ x) * (1 - 1e-12)).all()


def test_a_leap_removes_the_one_slow_mode():
    rng = np.random.default_rng(2)
    M = mixing(2000, 0.01, rng)
    b = rng.uniform(0.1, 1.0, 2000)
    system, V = gauss_seidel.SplitMatrix.of(M), exact(M, b)
    start = above(M, b, rng)
    x, plain = start.copy(), start.copy()
    t = extrapolation.extrapolate(system, b, x)
    system.sweep(b, plain, 20)
    assert t == pytest.approx(100, rel=0.2)  # 1 / (1 - rate)
    assert np.abs(x / V - 1).max() < 0.1 * np.abs(plain / V - 1).max()


def test_a_leap_is_not_taken_from_below_nor_at_the_solution():
    rng = np.random.default_rng(3)
    M = mixing(300, 0.01, rng)
    b = rng.uniform(0.1, 1.0, 300)
    system, V = gauss_seidel.SplitMatrix.of(M), exact(M, b)
    below, swept = 0.5 * V, 0.5 * V
    assert extrapolation.extrapolate(system, b, below) == 1
    system.sweep(b, swept, extrapolation.SWEEPS)
    np.testing.assert_array_equal(below, swept)
    assert extrapolation.extrapolate(system, b, V) == 1


@pytest.mark.parametrize("escape", [0.5, 0.02, 1e-3, 1e-6])
def test_lifted_vectors_prove_that_a_mixing_set_is_left(escape):
    rng = np.random.default_rng(6)
    for n in (1, 2, 50, 400):
        M, b = mixing(n, escape, rng), rng.uniform(0.1, 1.0, n)
        V = exact(M, b)
        for start in (np.zeros(n), V * rng.random(n), V, V * rng.uniform(0.5, 1.5, n)):
            x, system = start.copy(), gauss_seidel.SplitMatrix.of(M)
            system.sweep(b, x, 20)
            lifted = extrapolation.lift(system, b, x)
            # Near V only rounding is left to go by; the slower the escape, the more steps it takes.
            assert lifted or (start > 0.99 * V).any() or escape < 1e-3
            assert not lifted or (x >= (b + M @ x) * (1 - 1e-12)).all()


@pytest.mark.parametrize("growth", [1.0, 1.001, 3.0])
def test_what_is_not_left_is_not_lifted(growth):
    rng = np.random.default_rng(7)
    for n in (1, 2, 50, 400):
        M, b = mixing(n, 0.0, rng) * growth, np.ones(n)
        x = np.ones(n)
        if extrapolation.lift(
            gauss_seidel.SplitMatrix.of(M), b, x
        ):  # what rounding made of it proves nothing
            assert not (x > b + M @ x).all()


def test_what_is_carried_along_is_swept_not_lifted():
    """No single mode is slow: somewhere the residual grows in 16 steps, though all mass leaves."""
    M, b = transport(400, np.random.default_rng(8)), np.ones(400)
    system = gauss_seidel.SplitMatrix.of(M)
    assert not extrapolation.lift(system, b, b.copy())
    assert system.sweep(b, b.copy(), 200)[1] < 1e-14


def test_a_policy_is_proved_stabilizing_where_mass_hardly_escapes(monkeypatch):
    lp = random_lp(np.random.default_rng(9), cells=500, samples=6, spread=6, absorb=1e-3)
    pair, ones, lifted = lp.tree[1], np.ones(lp.n), []
    lift = equations.lift
    monkeypatch.setattr(equations, "lift", lambda *a: lifted.append(lift(*a)) or lifted[-1])
    assert first_policy._proved(lp, pair, ones, types.never) is not None
    assert lifted == [True]
    assert evaluation.peeled(lp, pair, 1.0).system.sweep(ones, ones.copy(), 200)[1] > 1e-3


@pytest.mark.parametrize("outside", [0, 30, 900])
def test_a_small_core_alone_is_lifted(outside):
    rng = np.random.default_rng(10)
    inner = mixing(300, 1e-2, rng)
    into = sp.csr_array(rng.random((outside, 300)) * (rng.random((outside, 300)) < 0.01))
    M = sp.csr_array(sp.block_array([[inner, None], [into, sp.csr_array((outside, outside))]]))
    peeled = Peeled.of(gauss_seidel.SplitMatrix.of(M))
    assert 250 < len(peeled.core) <= 300
    assert peeled.small == (outside == 900)
    b = np.ones(300 + outside)
    x = b.copy()
    equations.advance(peeled, b, x, 1, 0.0, 0.0)
    assert equations.lift(peeled, b, x)
    assert (x >= (b + M @ x) * (1 - 1e-12)).all()


def test_a_policy_is_proved_stabilizing_as_long_as_sweeps_gain(monkeypatch):
    """A slow pendulum at gamma = 1.02: 30 sweeps gain two digits of w, which needs four."""
    data = copy.deepcopy(dict(lm.systems.InvertedPendulum.problem))
    for axis in data["state_box"].values():
        axis["cells"] = 100
    system = {**data["system"], "step": 0.02, "substeps": 1}
    lp = lm.compile(made({**data, "system": system, "on_exit": "clip", "gamma": 1.02}))
    advance, calls = equations.advance, []
    monkeypatch.setattr(equations, "advance", lambda *a: calls.append(a[3]) or advance(*a))
    horizon = 4.0 * lp.tree[0].max()
    start, unit = np.full(lp.n, horizon), np.ones(lp.K)
    done = iteration.iterate(lp, lp.tree[1], start, 1 - 1 / horizon, unit, limit=6)
    calls.clear()
    assert first_policy._proved(lp, done.policy, done.value, types.never) is not None
    assert len(calls) > 1


def test_policies_of_mixing_models_are_the_same_with_and_without_leaps(monkeypatch):
    taken = 0
    for seed in range(10):
        lp = random_lp(np.random.default_rng(seed), cells=60, controls=4, samples=3)
        pair = lp.tree[1]
        w, _ = evaluation.stability_vector(lp, pair)
        if w is None:
            continue
        start = iteration.bound(lp, pair, w)
        done = iteration.iterate(lp, pair, start)
        with monkeypatch.context() as patch:
            patch.setattr(extrapolation, "extrapolate", lambda *_: 1.0)
            plain = iteration.iterate(lp, pair, start)
        np.testing.assert_allclose(done.value, plain.value, rtol=1e-11)
        screen = Screen(lp)
        screen.slots.system(done.policy)
        taken += not Peeled.of(screen.slots.current).small
    assert taken


@pytest.mark.parametrize("n", [1100, 3000])
def test_a_symmetric_walk_is_solved(n):
    """Sweeps from b gain as much in each of the first n squared: their rate says nothing."""
    half = np.full(n, 0.5)
    M, b = sp.csr_array(sp.dia_array((np.array([half, half]), [-1, 1]), shape=(n, n))), np.ones(n)
    i = np.arange(1, n + 1)
    np.testing.assert_allclose(equations.solve(M, b), i * (n + 1.0 - i), rtol=1e-9)


@pytest.mark.parametrize("own", [1.0, 1.5])
@pytest.mark.parametrize("size", [1.0, 100.0, 1e300])
def test_krylov_refuses_cells_that_stay_put_for_ever(own, size):
    rng = np.random.default_rng(11)
    M = sp.lil_array(mixing(1500, 0.1, rng))
    M[7, 7] = own
    M, b = sp.csr_array(M), np.full(1500, size)
    assert equations._krylov(gauss_seidel.SplitMatrix.of(M), b, b.copy(), types.never) is None
    assert equations.solve(M, b) is None


def test_krylov_finds_the_slow_mode_of_a_well_mixed_set():
    rng = np.random.default_rng(5)
    M, b = mixing(3000, 1e-6, rng), np.ones(3000)
    guess = equations._krylov(gauss_seidel.SplitMatrix.of(M), b, b.copy(), types.never)
    np.testing.assert_allclose(guess, exact(M, b), rtol=1e-6)

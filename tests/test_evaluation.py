"""Evaluating a policy: leaps along a slow mode, and systems that sweeps do not solve."""

import numpy as np
import pytest
import scipy.sparse as sp
from models import random_lp

from lmdsl import linear, policy, sweeps
from lmdsl.peeling import Peeled
from lmdsl.screening import Screen


def mixing(n, escape, rng, spread=4):
    """Return a sparse matrix whose rows sum to 1 - escape, with targets anywhere."""
    target = rng.integers(0, n, (n, spread))
    weight = rng.random((n, spread))
    weight *= (1 - escape) / weight.sum(axis=1, keepdims=True)
    M = sp.csr_array((weight.ravel(), (np.repeat(np.arange(n), spread), target.ravel())), (n, n))
    M.sum_duplicates()
    return M


def transport(n, rng):
    """Return a walk to the left with a little spread: no single slow mode."""
    back, stay = rng.uniform(0.0, 0.1, n), rng.uniform(0.3, 0.5, n)
    M = sp.dia_array((np.array([1 - back - stay, stay, back]), [-1, 0, 1]), shape=(n, n))
    return sp.csr_array(M)


def exact(M, b):
    return sp.linalg.spsolve(sp.eye_array(M.shape[0], format="csc") - M.tocsc(), b)


def above(M, b, rng):
    """Return an x >= b + M x, neither near the solution nor parallel to it."""
    return exact(M, b * rng.uniform(1.0, 3.0, len(b)))


@pytest.mark.parametrize("escape", [0.5, 0.02, 1e-3])
@pytest.mark.parametrize("make", ["mixing", "transport"])
def test_a_leap_stays_above_its_equation(escape, make):
    rng = np.random.default_rng(1)
    for n in (1, 2, 50, 400):
        M = mixing(n, escape, rng) if make == "mixing" else transport(n, rng)
        b = rng.uniform(0.1, 1.0, n)
        x = above(M, b, rng)
        before, V = x.copy(), exact(M, b)
        t = linear.leap(sweeps.System.of(M), b, x)
        assert t >= 1
        assert (x <= before * (1 + 1e-15)).all()
        assert (x >= V * (1 - 1e-12)).all()
        assert (x >= (b + M @ x) * (1 - 1e-12)).all()


def test_a_leap_removes_the_one_slow_mode():
    rng = np.random.default_rng(2)
    M = mixing(2000, 0.01, rng)
    b = rng.uniform(0.1, 1.0, 2000)
    system, V = sweeps.System.of(M), exact(M, b)
    start = above(M, b, rng)
    x, plain = start.copy(), start.copy()
    t = linear.leap(system, b, x)
    system.sweep(b, plain, 20)
    assert t == pytest.approx(100, rel=0.2)  # 1 / (1 - rate)
    assert np.abs(x / V - 1).max() < 0.1 * np.abs(plain / V - 1).max()


def test_a_leap_is_not_taken_from_below_nor_at_the_solution():
    rng = np.random.default_rng(3)
    M = mixing(300, 0.01, rng)
    b = rng.uniform(0.1, 1.0, 300)
    system, V = sweeps.System.of(M), exact(M, b)
    below, swept = 0.5 * V, 0.5 * V
    assert linear.leap(system, b, below) == 1
    system.sweep(b, swept, linear.LEAP_SWEEPS)
    np.testing.assert_array_equal(below, swept)
    assert linear.leap(system, b, V) == 1


def test_policies_of_mixing_models_are_the_same_with_and_without_leaps(monkeypatch):
    taken = 0
    for seed in range(10):
        lp = random_lp(np.random.default_rng(seed), cells=60, controls=4, samples=3)
        pair = lp.tree[1]
        w, _ = policy.stability_vector(lp, pair)
        if w is None:
            continue
        start = policy.bound(lp, pair, w)
        done = policy.iterate(lp, pair, start)
        with monkeypatch.context() as patch:
            patch.setattr(linear, "leap", lambda *_: 1.0)
            plain = policy.iterate(lp, pair, start)
        np.testing.assert_allclose(done.value, plain.value, rtol=1e-11)
        screen = Screen(lp)
        screen.slots.system(done.pair)
        taken += not Peeled.of(screen.slots.held).small
    assert taken


@pytest.mark.parametrize("n", [1100, 3000])
def test_a_symmetric_walk_is_solved(n):
    """Sweeps from b gain as much in each of the first n squared: their rate says nothing."""
    half = np.full(n, 0.5)
    M, b = sp.csr_array(sp.dia_array((np.array([half, half]), [-1, 1]), shape=(n, n))), np.ones(n)
    i = np.arange(1, n + 1)
    np.testing.assert_allclose(linear.solve(M, b), i * (n + 1.0 - i), rtol=1e-9)


def test_krylov_finds_the_slow_mode_of_a_well_mixed_set():
    rng = np.random.default_rng(5)
    M, b = mixing(3000, 1e-6, rng), np.ones(3000)
    guess = linear._krylov(sweeps.System.of(M), b, b.copy(), linear.never)
    np.testing.assert_allclose(guess, exact(M, b), rtol=1e-6)

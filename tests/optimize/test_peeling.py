"""Peeling a system: the cells outside the core by substitution, the core by itself."""

from __future__ import annotations

import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from models import dense, random_lp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu, spsolve

from lmdsl.machine import threads
from lmdsl.model import rows
from lmdsl.optimize.linear import classes, equations, substitution
from lmdsl.optimize.linear.gauss_seidel import SplitMatrix
from lmdsl.optimize.linear.policy_system import Slots
from lmdsl.optimize.linear.substitution import Peeled


def matrix(seed, n, cyclic, radius=0.9):
    """Return a nonnegative matrix: arbitrary among the first cells, else only to lower ones."""
    rng = np.random.default_rng(seed)
    dense = rng.random((n, n)) * (rng.random((n, n)) < 3 / n)
    allowed = np.tri(n, dtype=bool)
    allowed[:cyclic, :cyclic] = True
    dense = np.where(allowed, dense, 0.0)
    dense *= radius / max(dense.sum(axis=1).max(), 1e-9)
    shuffle = rng.permutation(n)
    return sp.csr_array(dense[np.ix_(shuffle, shuffle)])


def cases(test):
    """Run a test on random systems."""
    given_cases = given(st.integers(0, 10_000), st.integers(1, 40), st.integers(0, 12))
    return settings(deadline=None)(given_cases(test))


@cases
def test_core_is_closed_and_holds_every_cycle(seed, n, cyclic):
    M = matrix(seed, n, min(cyclic, n))
    peeled = Peeled.of(SplitMatrix.of(M))
    core = np.zeros(n, dtype=bool)
    core[peeled.core] = True
    off = M.toarray() * (1 - np.eye(n))
    assert sorted([*peeled.core, *peeled.order]) == list(range(n))
    assert not off[np.ix_(core, ~core)].any()  # nothing leads out of it
    place = np.full(n, n)
    place[peeled.order] = np.arange(len(peeled.order))
    ends = [0, *peeled.levels]
    assert ends[-1] == len(peeled.order)
    for first, last in pairwise(ends):
        level = peeled.order[first:last]
        assert not off[np.ix_(level, level)].any()
    for i in peeled.order:
        assert (place[np.flatnonzero(off[i])] > place[i]).all()
    _, label = connected_components(sp.csr_array(off), connection="strong")
    assert core[np.bincount(label)[label] > 1].all()


@cases
def test_solutions_agree_with_dense_ones(seed, n, cyclic):
    M = matrix(seed, n, min(cyclic, n))
    rng = np.random.default_rng(seed + 1)
    b = rng.random(n) * (rng.random(n) < 0.7)  # some exact zeros
    peeled, whole = Peeled.of(SplitMatrix.of(M)), np.eye(n) - M.toarray()
    x = rng.random(n)
    assert equations.solve_from(peeled, b, x, lambda: M)
    np.testing.assert_allclose(x, np.linalg.solve(whole, b), rtol=1e-12, atol=1e-15)
    mu = equations.solve_transposed(peeled, b, lambda: M)
    np.testing.assert_allclose(mu, np.linalg.solve(whole.T, b), rtol=1e-11, atol=1e-15)
    for start in (None, rng.random(n)):
        np.testing.assert_array_equal(
            equations.solve_transposed(peeled, np.zeros(n), lambda: M, start=start), 0
        )


@cases
def test_advancing_stays_on_its_side(seed, n, cyclic):
    M = matrix(seed, n, min(cyclic, n))
    b = np.random.default_rng(seed + 2).random(n) + 0.1
    exact = np.linalg.solve(np.eye(n) - M.toarray(), b)
    for factor in (0.5, 2.0):  # below b + M x, and above
        x = factor * exact
        before = x.copy()
        equations.advance(Peeled.of(SplitMatrix.of(M)), b, x, 2, 0.0, 0.0)
        ahead = b + M @ x
        if factor < 1:
            assert (x >= before * (1 - 1e-13)).all()
            assert (x <= ahead * (1 + 1e-13)).all()
        else:
            assert (x <= before * (1 + 1e-13)).all()
            assert (x >= ahead * (1 - 1e-13)).all()


def test_cells_of_a_level_ascend_where_they_are_not_few_and_far_apart():
    n = 5000
    chains = np.arange(0, n, 100)  # 50 chains of 100 cells: each level has cells all over
    step = np.where(np.arange(n - 1) % 100 < 99, 0.5, 0.0)
    peeled = Peeled.of(SplitMatrix.of(sp.csr_array(np.diag(step, 1))))
    np.testing.assert_array_equal(peeled.levels, 50 * np.arange(1, 101))
    np.testing.assert_array_equal(peeled.order.reshape(100, 50), chains + np.arange(100)[:, None])


def test_a_walk_in_from_both_ends_is_peeled_pair_by_pair():
    n = 4001
    i = np.arange(n)
    step = np.sign(n // 2 - i)
    go = step != 0
    M = sp.csr_array((np.full(go.sum(), 0.5), (i[go], (i + step)[go])), shape=(n, n))
    peeled, b = Peeled.of(SplitMatrix.of(M)), np.random.default_rng(0).random(n)
    assert not len(peeled.core)
    assert len(peeled.levels) == n // 2 + 1
    assert len(peeled._spans) == 1  # one sweep, however many levels
    x = np.zeros(n)
    assert peeled.substitute(b, x)
    np.testing.assert_allclose(x - M @ x, b, rtol=1e-13)


@pytest.mark.parametrize("many", [1, 4, 1000])
@pytest.mark.parametrize("workers", [1, 2])
def test_large_levels_in_several_threads(monkeypatch, many, workers):
    M = matrix(3, 300, 5)
    peeled, b = Peeled.of(SplitMatrix.of(M)), np.random.default_rng(0).random(300)
    monkeypatch.setattr(substitution, "PARALLEL_FROM", many)
    monkeypatch.setattr(threads, "count", lambda: workers)
    x = np.linalg.solve(np.eye(300) - M.toarray(), b)
    y = np.where(np.isin(np.arange(300), peeled.core), x, np.nan)
    assert peeled.substitute(b, y)
    np.testing.assert_allclose(y, x, rtol=1e-12)
    never = sp.csr_array(np.eye(300))
    assert not Peeled.of(SplitMatrix.of(never)).substitute(np.ones(300), np.ones(300))


def test_a_system_without_cycles_is_solved_at_once():
    M = matrix(0, 200, 0)
    peeled = Peeled.of(SplitMatrix.of(M))
    assert not len(peeled.core)
    x = np.zeros(200)
    assert equations.advance(peeled, np.ones(200), x, 1, 0.0, 0.0) == 0.0
    np.testing.assert_allclose(x - M @ x, 1.0, rtol=1e-13)


@pytest.mark.parametrize("own", [1.0, 1.5])
def test_staying_for_ever_has_no_solution_where_something_is_paid(own):
    M = sp.csr_array(np.array([[own, 0.0], [0.5, 0.0]]))
    peeled = Peeled.of(SplitMatrix.of(M))
    for b in (np.array([1e-200, 1.0]), np.array([1.0, 0.0])):
        assert not equations.solve_from(peeled, b, b.copy(), lambda: M)
        assert equations.advance(peeled, b, b.copy(), 9, 0.0, 0.0) == np.inf
    x = np.zeros(2)
    assert equations.solve_from(peeled, np.array([0.0, 1.0]), x, lambda: M)
    np.testing.assert_array_equal(x, [0.0, 1.0])


def test_a_growing_cycle_has_no_solution():
    M = sp.csr_array(np.array([[0.0, 1.1, 0.0], [1.0, 0.0, 0.0], [0.5, 0.5, 0.0]]))
    peeled = Peeled.of(SplitMatrix.of(M))
    assert list(peeled.core) == [0, 1]
    assert not equations.solve_from(peeled, np.ones(3), np.ones(3), lambda: M)


def well_mixed(n, escape):
    """Return a matrix whose sweeps are slow for one reason only: mass hardly escapes."""
    rng = np.random.default_rng(n)
    rows = np.repeat(np.arange(n), 4)
    M = sp.csr_array((np.full(4 * n, 0.25), (rows, rng.integers(0, n, 4 * n))), shape=(n, n))
    return M * (1 - escape)


@pytest.mark.parametrize("scale", [1e-200, 1e-17, 1.0, 1e200])
@pytest.mark.parametrize("zeros", [False, True])
def test_well_mixed_systems_are_solved_without_factors(monkeypatch, zeros, scale):
    M = well_mixed(1200, 1e-3)
    b = scale * np.random.default_rng(1).random(1200)
    if zeros:
        b[100:] = 0.0
    exact = spsolve(sp.eye_array(1200, format="csc") - M.tocsc(), b)
    monkeypatch.setattr(classes, "solve_by_class", lambda *_: pytest.fail("it was factored"))
    np.testing.assert_allclose(equations.solve(M, b), exact, rtol=1e-9)
    mu = equations.solve_transposed(Peeled.of(SplitMatrix.of(M)), b, lambda: M)
    np.testing.assert_allclose(mu - M.T @ mu, b, atol=1e-11 * mu.max())


def test_factors_in_several_threads_leave_the_filters_of_warnings_alone(monkeypatch):
    M, delays = well_mixed(30, 0.1), iter([0.05, 0.1, 0.15])

    def slow(A):
        time.sleep(next(delays))
        return splu(A)

    monkeypatch.setattr("scipy.sparse.linalg.splu", slow)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        before = list(warnings.filters)
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(lambda _: classes._factors(M), range(3)))
        assert list(warnings.filters) == before


def test_a_well_mixed_system_that_grows_has_no_solution():
    M = well_mixed(1100, -1e-3)
    assert equations.solve(M, np.ones(1100)) is None


@pytest.mark.parametrize("seed", range(12))
def test_slots_hold_the_rows_of_the_last_policy(monkeypatch, seed):
    rng = np.random.default_rng(seed)
    lp = random_lp(rng, 20, 5, gamma=0.9)
    if seed % 2:
        monkeypatch.setattr(rows, "PARALLEL_FROM", 1)  # in several ranges
    P, slots = dense(lp), Slots.of(lp.rows, lp.pair_pointer, lp.gamma, lp._directions)
    pair = lp.pair_pointer[:-1].copy()
    for _ in range(6):
        system = slots.system(pair)
        found = np.zeros((lp.n, lp.n))
        for i in range(lp.n):
            span = slice(int(system.begin[i]), int(system.end[i]))
            np.add.at(found[i], system.indices[span], system.data[span])
        assert not found.diagonal().any()
        np.fill_diagonal(found, 1 - 1 / system.inverse)
        np.testing.assert_allclose(found, lp.gamma * P[pair], rtol=1e-12, atol=1e-15)
        moved = rng.random(lp.n) < 0.4
        drawn = rng.integers(lp.pair_pointer[:-1], lp.pair_pointer[1:])
        pair = np.where(moved, drawn, pair)

"""x = b + M x: classes, where x > 0, sweeps in halves and sweeps that diverge, by definition."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from lmdsl.optimize.linear import classes, equations, gauss_seidel
from lmdsl.optimize.linear.gauss_seidel import SplitMatrix


def sparse(n, rng, density=0.06, largest=0.9):
    """Return a random matrix whose rows sum to at most ``largest``."""
    M = sp.csr_array(rng.random((n, n)) * (rng.random((n, n)) < density))
    return sp.csr_array(M * (largest / np.maximum(M.sum(axis=1), 1e-9).max()))


@pytest.mark.parametrize("density", [0.01, 0.03, 0.06])
def test_every_class_comes_after_all_it_leads_to(density):
    rng, several = np.random.default_rng(0), 0
    for _ in range(30):
        M = sparse(40, rng, density)
        order, ends = classes.classes(M)
        assert sorted(order) == list(range(40))
        label = np.empty(40, dtype=int)
        label[order] = np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))
        reach = np.linalg.matrix_power((M.toarray() > 0) + np.eye(40), 40) > 0
        np.testing.assert_array_equal(label[:, None] == label, reach & reach.T)
        i, j = np.nonzero(M.toarray())
        assert (label[j] <= label[i]).all()
        several += len(ends) > 1
    assert several


def test_class_by_class_is_the_solution():
    rng = np.random.default_rng(1)
    for _ in range(40):
        M, b = sparse(40, rng), rng.random(40) * (rng.random(40) < 0.3)
        x, tried = classes.solve_by_class(M, b)
        assert tried
        expected = np.linalg.solve(np.eye(40) - M.toarray(), b)
        np.testing.assert_allclose(x, expected, rtol=1e-11, atol=1e-300)


@pytest.mark.parametrize("own", [1.0, 1.5])
def test_a_cell_that_keeps_all_of_itself_costs_nothing_or_has_no_solution(own):
    M = sp.csr_array(np.array([[own, 0.0], [0.5, 0.0]]))
    assert classes.solve_by_class(M, np.array([1.0, 1.0])) == (None, True)
    x, _ = classes.solve_by_class(M, np.array([0.0, 1.0]))
    np.testing.assert_array_equal(x, [0.0, 1.0])


def test_where_the_solution_is_positive():
    rng = np.random.default_rng(2)
    for _ in range(30):
        M, b = sparse(60, rng, 0.02), np.where(rng.random(60) < 0.05, 1.0, 0.0)
        reach = np.linalg.matrix_power((M.toarray() > 0) + np.eye(60), 60) > 0
        np.testing.assert_array_equal(equations._positive(SplitMatrix.of(M), b), reach @ (b > 0))


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_each_half_sees_the_other_as_it_was_before_the_sweep(count, monkeypatch):
    monkeypatch.setattr(gauss_seidel, "PARALLEL_FROM", 1)
    rng = np.random.default_rng(count)
    for n in (2, 7, 50):
        M, b, x = sparse(n, rng, 0.5).toarray(), rng.random(n), rng.random(n)
        system, own = SplitMatrix.of(sp.csr_array(M)), np.diag(M).copy()
        expected = x.copy()
        for sweep in range(count):
            before = expected.copy()
            order, downwards = system.directions.cycle[sweep % len(system.directions.cycle)]
            for half in (slice(0, n // 2), slice(n // 2, n)):
                seen = before.copy()
                cells = system.directions.in_halves[order][half].astype(int)
                for i in cells[:: -1 if downwards else 1]:
                    rest = M[i] @ seen - own[i] * seen[i]
                    seen[i] = expected[i] = (b[i] + rest) / (1 - own[i])
        system.sweep(b, x, count, enough=-1.0, flat=-1.0)
        np.testing.assert_allclose(x, expected, rtol=1e-12)


@pytest.mark.parametrize("split", [1, 10**9])
def test_sweeps_that_diverge_say_so(split, monkeypatch):
    monkeypatch.setattr(gauss_seidel, "PARALLEL_FROM", split)
    M = sp.csr_array(np.array([[0.0, 3.0], [3.0, 0.0]]))
    x = np.ones(2)
    assert SplitMatrix.of(M).sweep(np.ones(2), x, 2_000)[1] == np.inf

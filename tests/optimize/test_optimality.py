"""Policy iteration and certificate against enumeration of every policy."""

from __future__ import annotations

import numpy as np
import pytest
from models import brute_force, dense, mdp, random_lp

import lmdsl as lm
from lmdsl.certificate.bounds import exactly_below
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.policies import evaluation, iteration, ties


@pytest.mark.parametrize("gamma", [1.0, 1.05, 1.3, 2.0])
@pytest.mark.parametrize("zero", [0.0, 0.4, 0.9])
def test_optimal_among_all_policies(gamma, zero):
    solved = refused = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, int(100 * gamma), int(10 * zero)])
        lp = random_lp(rng, 5, 3, gamma=gamma, zero=zero, absorb=0.3 * gamma)
        if not lp.n:
            continue
        best, rho = brute_force(lp)
        result = lm.solve(lp)
        if best is None:
            assert rho * gamma > 1 - 1e-8
            exactly = abs(rho * gamma - 1) < 1e-8  # then the numbers may decide neither way
            assert result.status == "not_stabilizable" or (exactly and not result.verified), seed
            refused += 1
            continue
        assert result.status == "verified", (seed, result.message)
        solved += 1
        on = lp.cells
        scale = max(best.max(), lp.cost.max(), 1e-12)
        np.testing.assert_allclose(result.value[on], best, rtol=1e-6, atol=1e-7 * scale)
        assert (result.lower[on] <= best * (1 + 1e-9) + 1e-12 * scale).all()
        assert (result.value[on] >= best * (1 - 1e-9) - 1e-12 * scale).all()
    assert solved > 5
    assert refused > 2 or gamma < 1.3


@pytest.mark.parametrize("seed", range(30))
def test_discounted_optimum(seed):
    rng = np.random.default_rng(seed)
    lp = random_lp(rng, cells=6, gamma=0.9, zero=0.2)
    V = np.zeros(lp.n)
    P = dense(lp)
    for _ in range(500):
        V = np.minimum.reduceat(0.9 * P @ V + lp.cost, lp.pair_pointer[:-1])
    result = lm.solve(lp)
    np.testing.assert_allclose(result.lower[lp.cells], V, rtol=1e-6, atol=1e-9)
    if result.status == "unverified":
        assert "raise gamma to 1" in result.message
    else:
        assert result.status == "verified"
        np.testing.assert_allclose(result.value[lp.cells], V, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("seed", range(40))
def test_near_the_limit_no_false_yes_and_no_silence(seed):
    rng = np.random.default_rng(1000 + seed)
    lp = random_lp(rng, cells=5, gamma=1.0)
    if not lp.n:
        return
    _, rho = brute_force(lp)
    if rho < 1e-9:
        return
    from dataclasses import replace

    for factor in (1 - 1e-2, 1 - 1e-4, 1 - 1e-7, 1 + 1e-7, 1 + 1e-4, 1.5):
        gamma = factor / rho
        if gamma < 1:
            continue
        result = lm.solve(replace(lp, gamma=gamma))
        if factor < 1 - 1e-5:
            assert result.status == "verified", (factor, result.message)
            assert result.certificate.stabilizing
            assert result.gap <= 1e-6
        elif factor < 1:
            assert result.status in ("verified", "unverified")
        else:
            assert result.status != "verified"
        if factor > 1 + 1e-5:
            assert result.status == "not_stabilizable", (factor, result.message)


@pytest.mark.parametrize("seed", range(20))
def test_canonical_policy_does_not_depend_on_the_start(seed):
    rng = np.random.default_rng(seed)
    lp = random_lp(rng, cells=7, controls=4, gamma=1.0, zero=0.8, samples=4)
    if not lp.n:
        return
    found = first_policy.stabilizing(lp)
    assert isinstance(found, first_policy.Feasible)
    ends = []
    for start in (found.policy, _random_proper(lp, rng)):
        value = evaluation.evaluate(lp, start)
        done = iteration.iterate(lp, start, value)
        ends.append(ties.canonical(lp, done.policy, done.value))
    np.testing.assert_array_equal(ends[0], ends[1])


def _random_proper(lp, rng):
    for _ in range(200):
        pair = rng.integers(lp.pair_pointer[:-1], lp.pair_pointer[1:])
        if evaluation.evaluate(lp, pair, 1.0, np.ones(lp.K)) is not None:
            return pair
    return lp.tree[1]


def test_claims_hold_in_exact_arithmetic():
    from fractions import Fraction

    for seed in range(15):
        rng = np.random.default_rng(seed)
        lp = random_lp(rng, cells=6, gamma=1.02, zero=0.3 * (seed % 2))
        if not lp.n:
            continue
        result = lm.solve(lp)
        if result.status != "verified":
            continue
        on = lp.cells
        W, V_up, w = result.lower[on], result.value[on], result.witness[on]
        assert all(exactly_below(lp, k, W, lp.gamma, lp.cost) for k in range(lp.K))
        M = len(lp.controls)
        key = (lp.cell.astype(np.int64) * M + lp.control).tolist()
        for i in range(lp.n):
            k = key.index(i * M + result.control_index[on[i]])
            row = [(j, s) for j, s in lp.rows.exact(k) if j < lp.n]
            total = lp.rows.shares.total
            ahead = sum((Fraction(V_up[j]) * s for j, s in row), Fraction(0)) / total
            assert Fraction(V_up[i]) >= Fraction(lp.gamma) * ahead + Fraction(lp.cost[k])
            ahead = sum((Fraction(w[j]) * s for j, s in row), Fraction(0)) / total
            rate = Fraction(result.contraction)
            assert Fraction(lp.gamma) * ahead <= rate * Fraction(w[i])


def reset(n):
    """Control 0 advances or starts over with probability 1/2; control 1 always advances."""
    cells = []
    for i in range(n):
        row = {i - 1: 1}
        row[n - 1] = row.get(n - 1, 0) + 1
        cells.append([(row, 1.0), ({i - 1: 2}, 1.0)])
    return cells


@pytest.mark.parametrize("n", [60, 400])
@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.01])
def test_a_first_policy_that_takes_two_to_the_n_steps(n, gamma):
    result = lm.solve(mdp(reset(n), 2, gamma))
    assert result.status == "verified", result.message
    exact = np.cumsum(gamma ** np.arange(n))
    np.testing.assert_allclose(result.value[:n], exact, rtol=1e-9)


def test_a_corridor_where_news_travels_one_cell_a_step():
    n = 1500
    cells = [[({-1: 1}, 1.0)]]
    cells += [[({-1: 1}, 5000.0), ({i - 1: 1}, 1.0)] for i in range(1, n)]
    result = lm.solve(mdp(cells, 1, 1.0))
    assert result.status == "verified", result.message
    np.testing.assert_allclose(result.value[:n], np.arange(1, n + 1), rtol=1e-9)
    assert result.iterations < 150


def test_true_zeros_are_not_chased():
    cells = [[({-1: 20}, 1.0), ({0: 10, -1: 10}, 0.0)], [({-1: 20}, 1.0)]]
    result = lm.solve(mdp(cells, 20, 1.0))
    assert result.status == "verified"
    assert result.value[0] == 0
    assert result.iterations <= 2


@pytest.mark.parametrize("n", [900, 1500])
def test_free_models_of_any_size_cost_nothing(n):
    lp = mdp([[({-1 if i == 0 else i - 1: 1}, 0.0)] for i in range(n)], 1, 1.0)
    result = lm.solve(lp)
    assert result.status == "verified"
    assert result.cost == result.lower_bound == result.gap == 0.0


def test_free_cells_of_a_small_core_are_worth_exactly_nothing():
    # A long way to a cycle that pays (56, 57) and a free one (58, 59), which the way can take.
    way = [[({i + 1: 10}, 0.0), ({56: 10}, 0.5)] for i in range(55)]
    way += [[({58: 5, 59: 5}, 0.0), ({56: 10}, 0.5)]]
    pays = [[({57: 5, -1: 5}, 1.0)], [({56: 5, -1: 5}, 1.0)]]
    free = [[({59: 9, -1: 1}, 0.0)], [({58: 9, -1: 1}, 0.0), ({58: 5, -1: 5}, 0.0)]]
    lp = mdp([*way, *pays, *free], 10, 1.0)
    unpaid = np.r_[0:56, 58:60]
    start = lp.pair_pointer[1:] - 1  # every cell its last control: more than one step to go
    done = iteration.iterate(lp, start, iteration.bound(lp, start))
    assert done.steps > 1
    np.testing.assert_array_equal(done.value[unpaid], 0.0)
    answers = [lm.solve(lp, backend) for backend in ("policy-iteration", "highs:simplex")]
    for result in answers:
        assert result.status == "verified"
        value = result.value[lp.cells]
        np.testing.assert_allclose(value[56:58], 2.0, rtol=1e-12)
        assert (value[unpaid] < 1e-12).all()  # an upper bound
        np.testing.assert_array_equal(result.lower[lp.cells[unpaid]], 0.0)
    assert answers[0].control_index[lp.cells[59]] == 1  # of two free ways the shorter
    np.testing.assert_array_equal(answers[0].control_index, answers[1].control_index)

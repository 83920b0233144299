"""Rounded bounds against exact rationals, the smallest and largest doubles included."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from models import dense, mdp, random_lp
from problems import made, steps

import lmdsl as lm
from lmdsl.certificate import bounds, checks, sums
from lmdsl.certificate.bounds import exact_backup
from lmdsl.optimize import descent


@pytest.mark.parametrize("scale", [1.0, 1e-300, 1e-310, 1e280])
@pytest.mark.parametrize("gamma", [1.3, 1e-7, 1e30])
def test_bounds_enclose_the_exact_value(scale, gamma):
    for seed in range(40):
        rng = np.random.default_rng(seed)
        lp = random_lp(rng, 6, gamma=1.3, samples=7)
        if not lp.n:
            continue
        pair = lp.pair_pointer[:-1].copy()
        x = rng.random(lp.n) * 10.0 ** rng.integers(-9, 9, lp.n) * scale
        above = bounds.expected_above(lp, pair, x, gamma)
        below = descent.backup_below(lp, x, gamma, lp.cost)
        for i, k in enumerate(pair):
            exact = exact_backup(lp, int(k), x, gamma, None)
            if np.isfinite(above[i]):
                assert Fraction(above[i]) >= exact
                total = bounds.add_above(above[i : i + 1], lp.cost[k : k + 1])[0]
                if np.isfinite(total):
                    assert Fraction(total) >= Fraction(above[i]) + Fraction(float(lp.cost[k]))
            columns = range(lp.pair_pointer[i], lp.pair_pointer[i + 1])
            least = min(exact_backup(lp, j, x, gamma, lp.cost) for j in columns)
            if np.isfinite(below[i]):
                assert Fraction(below[i]) <= least


def rounded_one_way(entries, direction):
    """Return a model whose first cell leads to many, and values whose sum rounds up (1), down (-1).

    Each value is the one of a few whose addition errs most.
    """
    cells = [[(dict.fromkeys(range(1, entries + 1), 1), 0.0)]]
    cells += [[({-1: entries}, 2.0)] for _ in range(entries)]
    lp = mdp(cells, entries, 1.0)
    values, q = summands(entries, float(lp.rows.shares.value[0]), direction)
    return lp, np.append(1.0, values), q


def summands(count, factor, direction):
    """Return values of which the sum, each times a factor, rounds one way, and that sum."""
    rng, q, values = np.random.default_rng(count), 0.0, np.ones(count)
    for j in range(count):
        some = rng.uniform(1.0, 2.0, 32)
        terms = factor * some
        error = (q + terms) - (np.longdouble(q) + terms.astype(np.longdouble))
        best = int(np.argmax(direction * error))
        values[j], q = some[best], q + terms[best]
    return values, q


@pytest.mark.parametrize("direction", [1, -1])
def test_bounds_hold_where_every_rounding_errs_the_same_way(direction):
    lp, V, q = rounded_one_way(400, direction)
    exact = exact_backup(lp, 0, V, 1.0, None)
    assert direction * (Fraction(q) - exact) > 100 * Fraction(2) ** -53 * exact
    assert Fraction(bounds.expected_above(lp, lp.pair_pointer[:-1], V, 1.0)[0]) >= exact
    assert Fraction(descent.backup_below(lp, V, 1.0, None)[0]) <= exact


@pytest.mark.parametrize("direction", [1, -1])
def test_inflow_of_many_cells_errs_no_more_than_it_says(direction):
    """All mass but the first cell's flows into the first, each addition off the same way."""
    mu, q = summands(400, 1.0, direction)
    lp = mdp([[({-1: 1}, 1.0)], *([[({0: 1}, 1.0)]] * 400)], 1, 1.0)
    total, relative, absolute = bounds.inflow(lp, lp.pair_pointer[:-1], np.append(1.0, mu), 1.0)
    error = Fraction(float(total[0])) - sum(Fraction(float(x)) for x in mu)
    assert float(total[0]) == q
    assert direction * error > 100 * Fraction(2) ** -53 * Fraction(q)
    assert abs(error) <= Fraction(relative[0]) * Fraction(q) + Fraction(float(absolute[0]))


def test_long_rows_are_not_taken_for_clear():
    """The sum of so many terms is off by more than the margin of the quick look."""
    lp, W, q = rounded_one_way(30_000, 1)
    exact = exact_backup(lp, 0, W, 1.0, lp.cost)
    W[0] = q * bounds.CLEAR * (1 - 1e-15)
    assert Fraction(W[0]) > exact
    assert not bounds.holds_for_all(lp, W, 1.0, lp.cost)
    W[0] = float(exact) * (1 - 1e-15)
    assert bounds.holds_for_all(lp, W, 1.0, lp.cost)


@pytest.mark.parametrize("zero", [0.0, 0.3])
def test_the_worst_excess_by_hand(zero):
    seen = set()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        lp = random_lp(rng, 12, gamma=1.1, samples=7, zero=zero)
        if not lp.n:
            continue
        V = rng.random(lp.n) * 10.0 ** rng.integers(-2, 4, lp.n)
        r = V[lp.cell] - (lp.gamma * (dense(lp) @ V) + lp.cost)
        worst, stuck = bounds.worst_excess(lp, V)
        paid = lp.cost > 0
        assert worst == pytest.approx((np.maximum(r, 0)[paid] / lp.cost[paid]).max(initial=0.0))
        assert stuck == bool((r[~paid] > 0).any())
        seen.add(stuck)
    assert seen == ({False, True} if zero else {False})


def test_decrease_is_rounded_down():
    for seed in range(100):
        rng = np.random.default_rng(seed)
        lp = random_lp(rng, 6, gamma=1.0, samples=7)
        if not lp.n:
            continue
        pair = lp.tree[1]
        w = rng.random(lp.n) + 1.0
        w = w + bounds.expected_above(lp, pair, w, 1.0)
        d = bounds.decrease(lp, pair, w, 1.0)
        if d is None:
            continue
        for i, k in enumerate(pair):
            exact = Fraction(float(w[i])) - exact_backup(lp, int(k), w, 1.0, None)
            assert 0 < Fraction(d[i]) <= exact


def test_rounded_down():
    for q in (Fraction(1, 3), Fraction(2, 3), Fraction(1, 10), Fraction(7, 10)):
        assert Fraction(sums.rounded_down(q)) <= q


def test_too_many_open_rows_are_no_yes(monkeypatch):
    lp = lm.compile(made(steps()))
    W = np.array([1e3, 2e3, 3e3])  # each cell's step down breaks it
    monkeypatch.setattr(bounds, "MAX_EXACT", 1)
    assert bounds.undecided(lp, W, lp.gamma, lp.cost) is None
    assert not bounds.holds_for_all(lp, W, lp.gamma, lp.cost)


def test_the_gap_divides_by_the_upper_value():
    lp = lm.compile(made(steps()))
    V = np.ones(lp.n)
    assert checks.gap(lp, V, V / 2) == pytest.approx(0.5)


def test_shares_below_the_normal_range_prove_nothing_false():
    formula = (
        "where(x < 0.5, 0.1, where(w > 0, 0.1 + 0.25*where(x - floor(4*x)/4 < 0.125, 1, 0), 0.1))"
    )
    data = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": formula}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 4}},
        "attractor": {"cells": [[0]]},
        "control_grid": {},
        "noise": {"w": {"values": [0, 1], "weights": [1 - 5e-324, 5e-324]}},
        "stage_cost": "where(x < 0.5, 1e300, 0)",
        "sampling": {"kind": "grid", "per_axis": 2},
    }
    lp = lm.compile(made(data))
    result = lm.solve(lp)
    if result.certificate.upper_bound:
        V = result.value[lp.cells]
        for i, k in enumerate(lp.pair_pointer[:-1]):
            assert Fraction(V[i]) >= exact_backup(lp, int(k), V, lp.gamma, lp.cost)


def test_underflow_before_gamma_proves_nothing_false():
    lp = mdp([[({-1: 10}, 5e-324)], [({0: 3, -1: 7}, 0.0)]], 10, 1e25)
    assert not checks.check_upper(lp, np.array([0, 1]), np.array([5e-324, 2e-300]))
    lp = mdp([[({-1: 10}, 5e-324)], [({0: 6, -1: 4}, 0.0)]], 10, 1e200)
    assert not checks.check_lower(lp, np.array([5e-324, 4.5e-124]))


@pytest.mark.parametrize("n", [10, 1_000, 1_001, 20_000])
def test_sums_of_nothing_are_nothing(n):
    weight, values = np.full(n, 1 / n), np.zeros(n)
    for direction in (-np.inf, np.inf):
        assert sums.weighted(weight, values, direction) == 0.0
        values[0], weight[0] = 1.0, 0.0  # something where there is no weight
        assert sums.weighted(weight, values, direction) == 0.0
        values[0], weight[0] = 0.0, 1 / n
    values[-1] = 5e-324
    assert sums.weighted(weight, values, np.inf) > 0.0
    assert sums.weighted(weight, values, -np.inf) == 0.0


@pytest.mark.parametrize("n", [900, 1_500])
def test_weighted_sums_enclose_the_exact_one(n):
    rng = np.random.default_rng(n)
    weight, values = rng.random(n), rng.random(n) * 10.0 ** rng.integers(-9, 9, n)
    exact = sum(
        Fraction(a) * Fraction(b) for a, b in zip(weight.tolist(), values.tolist(), strict=True)
    )
    below, above = (Fraction(sums.weighted(weight, values, d)) for d in (-np.inf, np.inf))
    assert below <= exact <= above
    assert above - below <= exact * 150 * Fraction(2) ** -52

"""Intervals of recorded probabilities, and the cost over all chains they allow."""

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.stats import binom

import lmdsl as lm
from lmdsl.certificate import interval_checks
from lmdsl.certificate.interval_checks import IntervalRows
from lmdsl.data.intervals import Family, Observed, intervals, observed, unseen
from lmdsl.data.worst_case import bounds


def chain(P, counts, level, cost="1 + x", seed=0, draw=None, **more):
    """Return the problem of data drawn from a chain: state 0 is A, a cell for each state."""
    rng = np.random.default_rng(seed)
    n = len(P)
    x, y = [], []
    for i in range(1, n):
        x += [i] * counts
        y += list((draw or rng.choice)(n, size=counts, p=P[i]))
    return lm.from_data(
        np.array(x, float), None, np.array(y, float), confidence=level,
        state_box={"x": {"low": -0.5, "high": n - 0.5, "cells": n}}, control_grid={},
        stage_cost=cost, attractor={"cells": [[0]]}, **more,
    )  # fmt: skip


P4 = np.array([[1, 0, 0, 0], [0.6, 0.2, 0.2, 0], [0.1, 0.4, 0.3, 0.2], [0.2, 0, 0.5, 0.3]])


def true_value(P, cost, gamma=1.0):
    return np.linalg.solve(np.eye(len(P) - 1) - gamma * P[1:, 1:], cost)


def test_the_interval_is_that_of_clopper_and_pearson():
    """P(X >= c | low) = P(X <= c | high) = tail, by SciPy's binomial distribution."""
    seen = Observed(np.array([0, 3]), np.array([0, 1, 2]), np.array([1, 7, 42]), 2)
    rows = intervals(seen, Family(3, 4), 0.9)
    tail = 0.1 / 3 / 4 / 2
    for c, low, high in zip(seen.count, rows.low, rows.high, strict=True):
        assert binom.sf(c - 1, 50, low) == pytest.approx(tail, rel=1e-6)
        assert binom.cdf(c, 50, high) == pytest.approx(tail, rel=1e-6)
        assert binom.sf(c - 1, 50, low) <= tail
        assert binom.cdf(c, 50, high) <= tail


def test_a_successor_that_was_always_seen_has_upper_end_one():
    seen = Observed(np.array([0, 1]), np.array([0]), np.array([5]), 1)
    rows = intervals(seen, Family(1, 3), 0.95)
    assert rows.high.tolist() == [1.0]
    assert rows.low[0] == pytest.approx((0.05 / 6) ** (1 / 5), rel=1e-6)


def test_unseen_mass_in_closed_form():
    """Of 3 outcomes one was seen in all n draws: 3 (1 - eps)^n = (1 - level) / (pairs 3)."""
    seen = Observed(np.array([0, 1]), np.array([0]), np.array([40]), 1)
    eps = unseen(seen, Family(2, 3), 0.95)
    assert 3 * (1 - eps[0]) ** 40 == pytest.approx(0.05 / 2 / 3, rel=1e-9)
    every = Observed(np.array([0, 3]), np.array([0, 1, 2]), np.array([1, 1, 1]), 2)
    assert unseen(every, Family(1, 3), 0.95).tolist() == [0.0]


def test_unseen_mass_covers_at_its_level():
    """2,000 data sets of 60 draws with rare outcomes: the mass not seen is within its limit."""
    rng = np.random.default_rng(1)
    p = np.array([0.9, 0.05, 0.03, 0.01, 0.01])
    missed, tight = 0, 0
    for _ in range(2000):
        count = rng.multinomial(60, p)
        on = np.flatnonzero(count)
        seen = Observed(np.array([0, len(on)]), on, count[on], 5)
        limit = unseen(seen, Family(1, 5), 0.5)[0]
        missed += p[count == 0].sum() > limit
        tight += p[count == 0].sum() > 0.2 * limit
    assert missed <= 0.5 * 2000
    assert tight > 0


def random_rows(rng, n):
    pointer, target, low, high = [0], [], [], []
    for _ in range(n):
        on = np.sort(rng.choice(n + 1, size=rng.integers(1, n + 2), replace=False))
        p = rng.dirichlet(np.ones(len(on)))
        target += on.tolist()
        low += (p * rng.uniform(0, 1, len(on))).tolist()
        high += (p + (1 - p) * rng.uniform(0, 0.5, len(on))).tolist()
        pointer.append(len(target))
    return IntervalRows(np.array(pointer), np.array(target), np.array(low), np.array(high), n)


def extreme_by_lp(rows, V, k, sign):
    """The extreme of p'V over a row by linear programming."""
    on = slice(rows.pointer[k], rows.pointer[k + 1])
    value = np.append(V, 0.0)[rows.target[on]]
    box = list(zip(rows.low[on], np.minimum(rows.high[on], 1), strict=True))
    return sign * -linprog(-sign * value, A_eq=np.ones((1, len(value))), b_eq=[1], bounds=box).fun


@pytest.mark.parametrize("seed", range(8))
def test_the_bounds_of_a_row_are_those_of_linear_programming(seed):
    from lmdsl.data.worst_case import _extreme

    rng = np.random.default_rng(seed)
    rows, V = random_rows(rng, 5), rng.uniform(0, 3, 5)
    padded = np.append(V, 0.0)
    top, low = (_extreme(rows, V, sign)[1] for sign in (1.0, -1.0))
    for k in range(5):
        largest, least = extreme_by_lp(rows, V, k, 1), extreme_by_lp(rows, V, k, -1)
        assert interval_checks.most(rows, padded, top)[k] == pytest.approx(largest, rel=1e-9)
        assert interval_checks.least(rows, padded, low)[k] == pytest.approx(least, rel=1e-9)
        for t in rng.uniform(-1, 4, 20):  # a wrong number makes it weak, never wrong
            some = np.full(5, t)
            assert interval_checks.most(rows, padded, some)[k] >= largest - 1e-9
            assert interval_checks.least(rows, padded, some)[k] <= max(least, 0) + 1e-9


def value_iteration(rows, G, factor, sign, sweeps):
    """The worst or best cost by plain value iteration, each row sorted by hand."""
    V = np.zeros(rows.columns)
    for _ in range(sweeps):
        new = []
        for k in range(rows.columns):
            on = range(rows.pointer[k], rows.pointer[k + 1])
            value = {e: 0.0 if rows.target[e] == rows.columns else V[rows.target[e]] for e in on}
            left, total = 1 - sum(rows.low[e] for e in on), 0.0
            for e in sorted(on, key=lambda e: -sign * value[e]):
                more = min(left, rows.high[e] - rows.low[e])
                left -= more
                total += (rows.low[e] + more) * value[e]
            new.append(G[k] + factor * total)
        V = np.array(new)
    return V


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("factor", [0.8, 1.0])
def test_bounds_are_those_of_value_iteration(seed, factor):
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, 4)
    G = rng.uniform(0, 2, 4)
    found = bounds(rows, G, factor, factor)
    if not found.finite:  # then some row can avoid A for ever
        assert value_iteration(rows, np.ones(4), factor, 1.0, 3000).max() > 100
        return
    for V, sign in ((found.high, 1.0), (found.low, -1.0)):
        assert pytest.approx(value_iteration(rows, G, factor, sign, 3000), rel=1e-6, abs=1e-9) == V
    t = np.zeros(4)
    assert not interval_checks.is_above(rows, G + 0.1, factor, found.high, t).all()


def test_a_spoiled_bound_is_refused():
    from lmdsl.data.worst_case import _extreme

    rows = random_rows(np.random.default_rng(3), 4)
    G = np.ones(4)
    found = bounds(rows, G, 0.8, 0.8)
    t = _extreme(rows, found.high, 1.0)[1]
    assert interval_checks.is_above(rows, G, 0.8, found.high, t).all()
    for k in range(4):
        for spoiled in (found.high[k] * (1 - 1e-9), np.nan, np.inf, -1.0):
            V = found.high.copy()
            V[k] = spoiled
            assert not interval_checks.is_above(rows, G, 0.8, V, t).all()
    t = _extreme(rows, found.low, -1.0)[1]
    assert interval_checks.is_below(rows, G, 0.8, found.low, t).all()
    for k in range(4):
        V = found.low.copy()
        V[k] = found.low[k] * (1 + 1e-9)
        assert not interval_checks.is_below(rows, G, 0.8, V, t).all()


def test_a_chain_of_one_state_in_closed_form():
    """From the only free cell 80 of 100 go to A: cost 1 / (probability of going), by its ends."""
    x_next = [0] * 80 + [1] * 20
    problem = lm.from_data(
        [1.0] * 100, None, x_next, confidence=0.9, control_grid={}, stage_cost="1",
        state_box={"x": {"low": -0.5, "high": 1.5, "cells": 2}}, attractor={"cells": [[0]]},
    )  # fmt: skip
    tail = 0.1 / 1 / 3 / 2  # one pair, three outcomes: the cell, A, out
    stay = intervals(observed(lm.compile(problem), np.array([0])), Family(1, 3), 0.9)
    assert binom.cdf(20, 100, stay.high[0]) == pytest.approx(tail, rel=1e-6)
    result = lm.solve(problem)
    low, high = result.data.cost
    go = sorted(1 - p for p in (stay.low[0], stay.high[0]))
    assert (low, high) == pytest.approx((1 / go[1], 1 / go[0]), rel=1e-9)
    assert low < result.cost < high
    ended = lm.solve(problem.replaced(discount=0.5)).data.cost
    assert ended == pytest.approx([1 / (1 - 0.5 * (1 - g)) for g in (go[1], go[0])], rel=1e-9)


def test_where_the_worst_chain_has_no_finite_cost():
    """At gamma = 3 staying with probability 0.2 costs 2.5; the interval reaches beyond 1/3."""
    problem = lm.from_data(
        [1.0] * 100, None, [0] * 80 + [1] * 20, confidence=0.99, control_grid={}, stage_cost="1",
        state_box={"x": {"low": -0.5, "high": 1.5, "cells": 2}}, attractor={"cells": [[0]]},
        gamma=3,
    )  # fmt: skip
    result = lm.solve(problem)
    assert result.cost == pytest.approx(2.5)
    assert result.data.cost == (0.0, None)
    assert "not bounded above" in str(result.data)


def test_more_data_narrow_the_interval():
    width = []
    for counts in (50, 500, 5000):
        low, high = lm.solve(chain(P4, counts, 0.95)).data.cost
        width.append(high - low)
    assert width[0] > 2 * width[1] > 4 * width[2]


def covered(sets, counts, level):
    """Count, over data sets: intervals all right, the cost within, the support seen."""
    cost = np.array([2.0, 3.0, 4.0])
    truth = true_value(P4, cost).mean()
    right = within = whole = 0
    for seed in range(sets):
        result = lm.solve(chain(P4, counts, level, seed=seed))
        lp = result.lp
        seen = observed(lp, np.arange(lp.K))
        rows = intervals(seen, Family.of(lp), level)
        p = P4[1:, [1, 2, 3, 0]][rows.owner, rows.target]
        all_right = bool(((rows.low <= p) & (p <= rows.high)).all())
        support = len(p) == (P4[1:] > 0).sum()
        low, high = result.data.cost
        whole += support
        right += all_right
        within += low <= truth <= high
        assert not (all_right and support) or low <= truth <= high  # the theorem
    return right / sets, within / sets, whole / sets


def test_intervals_cover_at_their_level():
    right, within, whole = covered(60, 120, 0.8)
    assert whole == 1
    assert right >= 0.8
    assert within >= right


@pytest.mark.long
def test_a_thousand_data_sets_are_covered_at_their_level():
    right, within, whole = covered(1000, 120, 0.8)
    assert whole > 0.99
    assert right >= 0.8
    assert within >= right


def test_one_interval_covers_about_as_often_as_it_says():
    """One pair, three outcomes of which two occur: between 80 % and what Bonferroni gives away."""
    rng = np.random.default_rng(5)
    seen = rng.binomial(200, 0.3, 4000)
    family, hits = Family(1, 3), 0
    for count in seen:
        both = np.array([count, 200 - count])
        rows = intervals(Observed(np.array([0, 2]), np.array([0, 1]), both, 1), family, 0.8)
        hits += rows.low[0] <= 0.3 <= rows.high[0]
    assert 0.8 < 1 - 0.2 / 3 - 0.015 < hits / 4000 < 0.98


def test_biased_data_are_found_out():
    """Drawn from another chain, the interval misses the true cost: it does not cover everything."""
    biased = P4.copy()
    biased[3] = [0.05, 0, 0.5, 0.45]
    truth = true_value(P4, np.array([2.0, 3.0, 4.0])).mean()
    low, high = lm.solve(chain(biased, 3000, 0.95)).data.cost
    assert not low <= truth <= high


def test_repeated_data_are_not_independent():
    """Every draw written down fifty times: intervals are too narrow, as `independence` warns."""
    rng, missed = np.random.default_rng(7), 0
    truth = true_value(P4, np.array([2.0, 3.0, 4.0])).mean()
    for seed in range(20):

        def draw(n, size, p, rng=rng):
            return np.repeat(rng.choice(n, size=size // 50, p=p), 50)

        low, high = lm.solve(chain(P4, 2000, 0.95, seed=seed, draw=draw)).data.cost
        missed += not low <= truth <= high
    assert missed > 5


def test_the_family_is_fixed_beforehand():
    """Nothing that was observed changes the number of statements."""
    sizes = set()
    for seed in range(3):
        for counts in (5, 50):
            lp = lm.compile(chain(P4, counts, 0.9, seed=seed))
            sizes.add(Family.of(lp))
    assert sizes == {Family(3, 5)}


def test_a_run_meets_what_was_not_recorded_as_rarely_as_is_said():
    """Rare transitions: the probability of one that was not recorded, by the true chain."""
    P = P4.copy()
    P[1:, 2] -= 0.004
    P[1, 3] += 0.004  # recorded in some data sets, not in others
    P[2:, 1] += 0.004
    level, kept, some = 0.8, 0, 0
    for seed in range(60):
        result = lm.solve(chain(P, 150, level, seed=seed))
        lp, limit = result.lp, result.data.unseen_in_a_run
        seen = observed(lp, np.arange(lp.K))
        on = np.zeros((3, 4), dtype=bool)
        on[seen.owner, seen.target] = True  # the last is A
        rows = P[1:, [1, 2, 3, 0]]
        met = np.linalg.solve(
            np.eye(3) - np.where(on, rows, 0)[:, :3], np.where(on, 0, rows).sum(1)
        )
        kept += met.mean() <= limit
        some += met.mean() > 0
    assert kept >= level * 60
    assert 0 < some < 60


def test_what_a_run_may_meet_in_closed_form():
    """One free cell, always left for A: what was not seen in one step."""
    problem = lm.from_data(
        [1.0] * 200, None, [0] * 200, confidence=0.9, control_grid={}, stage_cost="1",
        state_box={"x": {"low": -0.5, "high": 1.5, "cells": 2}}, attractor={"cells": [[0]]},
    )  # fmt: skip
    data = lm.solve(problem).data
    eps = 1 - (0.05 / 1 / 3 / 3) ** (1 / 200)  # half of what may go wrong; 3 sets of one outcome
    assert data.unseen_in_a_run == pytest.approx(eps, rel=1e-6)
    assert "a run meets it with probability at most" in str(data)
    assert (
        lm.solve(problem.replaced(system=problem.system.replaced(confidence=None))).data.cost
        is None
    )


def chosen_by_the_data(sets, level):
    """Six controls that are all alike: the best of the data is the luckiest. Its true cost?"""
    p, low_side, within = np.array([0.5, 0.3, 0.2]), 0, 0
    truth = 1 / (1 - 0.5)  # from cell 1: stay 0.3, or 2; from 2 alike: leave with 0.5 in all
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        u = np.tile(np.arange(6), 2 * 40)
        x = np.repeat([1, 2], 240)
        y = rng.choice(3, size=480, p=p)
        result = lm.solve(lm.from_data(
            x.astype(float), u, y.astype(float), confidence=level, stage_cost="1",
            state_box={"x": {"low": -0.5, "high": 2.5, "cells": 3}},
            control_grid={"u": {"low": 0, "high": 5, "points": 6}}, attractor={"cells": [[0]]},
        ))  # fmt: skip
        low_side += result.cost < truth
        low, high = result.data.cost
        within += low <= truth <= high
    return low_side / sets, within / sets


def test_a_policy_chosen_by_the_data_is_covered_too():
    """The recorded cost of the chosen policy is too good; its interval holds all the same."""
    too_good, within = chosen_by_the_data(40, 0.8)
    assert too_good > 0.9
    assert within >= 0.8

"""Passes that leave rows out do what passes over all rows do, and their bounds are bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from models import random_lp
from problems import made, standard_map

import lmdsl as lm
from lmdsl.certificate import vectors
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.policies import bellman, iteration
from lmdsl.optimize.policies.screening import Screen
from lmdsl.optimize.policies.ties import first_column

MARGIN = 1e-12


def reference(lp, V, pair, backwards, ranges, settled):
    """Change each cell's control in turn where another one is better: all rows, plain NumPy.

    Cells whose value is at most ``settled`` are left as they are, and must not need a change.
    """
    P, x, new = lp.rows.matrix(), V.copy(), pair.copy()
    for first, last in ranges:
        seen = V.copy()
        for i in range(first, last)[:: -1 if backwards else 1]:
            own = np.arange(lp.pair_pointer[i], lp.pair_pointer[i + 1])
            Q = lp.gamma * (P[own] @ seen) + lp.cost[own]
            mine, best = Q[pair[i] - own[0]], Q.min()
            if seen[i] <= settled[i]:
                assert best >= min(mine, seen[i])
                continue
            if best < mine - MARGIN * abs(mine):
                new[i] = own[Q.argmin()]
            else:
                best = mine
            seen[i] = x[i] = min(best, V[i])
    return x, new


def models():
    yield lm.compile(made(standard_map(12)))
    for seed in range(12):
        yield random_lp(np.random.default_rng(seed))


def rivals(lp, pair, V):
    """Return the least Q among the other controls of each cell."""
    Q = lp.gamma * (lp.rows.matrix() @ V) + lp.cost
    others = np.where(np.arange(lp.K) == pair[lp.cell], np.inf, Q)
    return np.minimum.reduceat(others, lp.pair_pointer[:-1])


def paths():
    """Shortest paths with small integers as costs: many ties."""
    for seed in range(6):
        lp = random_lp(np.random.default_rng(seed), cells=30, controls=5, samples=1)
        yield replace(lp, cost=np.ceil(lp.cost / lp.cost.max() * 2))


def begun(lp):
    found = first_policy.stabilizing(lp)
    if not isinstance(found, first_policy.Feasible):
        return None
    return found.policy, iteration.bound(lp, found.policy, found.w)


@pytest.mark.parametrize("ranges", [1, 3])
def test_passes_agree_with_numpy_and_bounds_hold(monkeypatch, ranges):
    monkeypatch.setattr(bellman, "IN_PLACE", ranges)
    monkeypatch.setattr(vectors, "TRANSITIONS_A_RANGE", 1)
    left_out = 0
    for lp in models():
        if (start := begun(lp)) is None:
            continue
        pair, V = start
        count = min(ranges, lp.n, len(lp.rows.target))
        parts = [(lp.n * k // count, lp.n * (k + 1) // count) for k in range(count)]
        screen = Screen(lp)
        for step in range(8):
            settled = screen.rival * screen.scale
            x, new = reference(lp, V, pair, step % 2 == 1, parts, settled)
            done = screen.improve(V, pair, MARGIN)
            np.testing.assert_allclose(done.value, x, rtol=1e-13)
            np.testing.assert_array_equal(done.policy, new)
            assert done.changed == (new != pair).sum()
            np.testing.assert_array_equal(screen.slots.chosen, new)
            np.testing.assert_array_equal(screen.policy_cost, lp.cost[new])
            left_out += lp.K - done.looked
            screen.follow(V, done.value)
            pair, V = done.policy, done.value
            assert (screen.rival * screen.scale <= rivals(lp, pair, V)).all()
    assert left_out > 100


def test_ties_are_those_of_a_pass_over_all_rows():
    several = 0
    for lp in (*models(), *paths()):
        if (start := begun(lp)) is None:
            continue
        done = iteration.iterate(lp, *start)
        Q = lp.gamma * (lp.rows.matrix() @ done.value) + lp.cost
        least = np.minimum.reduceat(Q, lp.pair_pointer[:-1])[lp.cell]
        expected = (least * (1 + MARGIN) >= Q) | (np.arange(lp.K) == done.policy[lp.cell])
        for screen in (done.screen, Screen(lp)):
            ties, first, more = screen.tied(done.value, MARGIN, done.policy)
            np.testing.assert_array_equal(ties, expected)
            np.testing.assert_array_equal(first, first_column(lp, expected))
            assert more == (ties.sum() > lp.n)
        several += more
    assert several


def test_bounds_hold_for_a_policy_the_last_pass_did_not_choose():
    changed = 0
    for lp in models():
        if (start := begun(lp)) is None:
            continue
        pair, V = start
        screen = Screen(lp)
        changed += screen.improve(V, pair, MARGIN).changed
        done = screen.improve(V, pair, MARGIN)  # the policy from before that pass
        screen.follow(V, done.value)
        assert (screen.rival * screen.scale <= rivals(lp, done.policy, done.value)).all()
    assert changed

"""Ties between controls, broken in favour of what people expect: the same control next door."""

from dataclasses import replace

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices, Policy, never
from lmdsl.common.types import TimeUp as TimeUp
from lmdsl.machine import memory
from lmdsl.machine.deadline import Stopped
from lmdsl.model import stabilizable_set
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.policies import bellman
from lmdsl.optimize.policies.evaluation import evaluate
from lmdsl.optimize.policies.iteration import TIE, _even, iterate
from lmdsl.optimize.policies.screening import Screen


def canonical(
    lp: StabilizationLP,
    policy: Policy,
    value: Floats,
    screen: Screen | None = None,
    time_up: TimeUp = never,
) -> Policy:
    """Break ties so that an optimal policy reaches A: the policy that every backend ends with.

    Tied are the columns with Q <= Q_min + 1e-12 |Q_min|. Among them take those optimal for unit
    cost weighted with g, then the smallest control index; cells from which that cost is infinite
    take the smallest tied index. Where there is no memory for that, the policy at hand stays.
    ``screen`` knows lower bounds of the rivals at this value; ``time_up`` ends the work with
    Stopped.
    """
    if screen is None:
        screen = Screen(lp)
    ties, first, several = screen.tied(value, TIE, policy)
    if not several:
        return first
    if not memory.fits(_taken_by_ties(lp, int(ties.sum()))):
        return policy
    if ties.all():  # the whole model, of which no copy is made
        sub, start, columns, inside = lp, policy, None, np.arange(lp.n)
    else:
        found = stabilizable_set.stabilizable(*_columns(lp, ties))
        if not found.inside.any():
            return first
        columns = np.flatnonzero(ties)[found.surviving]
        inside = np.flatnonzero(found.inside)
        sub = lp.part(columns, inside)
        start = _renumbered(columns, policy[inside], sub)
    del ties
    unit = np.ones(sub.K)
    w = _even(sub, start, lp.growth, np.ones(sub.n))
    if w is None:
        w = evaluate(sub, start, lp.growth, unit, time_up=time_up)
    if w is None:
        start = sub._algorithm_1[1]
        w = evaluate(sub, start, lp.growth, unit, time_up=time_up)
    if w is None:
        return policy
    done = iterate(sub, start, w, lp.growth, unit, time_up=time_up)
    if time_up():
        raise Stopped
    least = bellman.improve(sub, done.value, lp.growth, unit).value
    equal = bellman.tied(replace(sub, gamma=lp.growth, cost=unit), done.value, least, TIE)
    chosen = first.copy()
    column = first_column(sub, equal)
    chosen[inside] = column if columns is None else columns[column]
    return chosen


def _renumbered(columns: Indices, policy: Policy, sub: StabilizationLP) -> Policy:
    """Return a policy in the columns of a part; where it has none, that of Algorithm 1."""
    place = np.minimum(np.searchsorted(columns, policy), len(columns) - 1)
    owned = columns[place] == policy
    return place if owned.all() else np.where(owned, place, sub._algorithm_1[1])


def _taken_by_ties(lp: StabilizationLP, count: int) -> int:
    """Return the bytes that breaking ties takes: a model of so many columns, and its costs."""
    row = len(lp.rows.target) // max(lp.K, 1) + 1
    copied = 0 if count == lp.K else 60 + row * (8 + lp.rows.code.itemsize)
    return count * (30 + copied)


def first_column(lp: StabilizationLP, allowed: Bools) -> Policy:
    """Return the first allowed column of every cell (each cell must have one)."""
    columns = np.flatnonzero(allowed)
    return columns[np.searchsorted(columns, lp.pair_pointer[:-1])]


def _columns(lp: StabilizationLP, allowed: Bools):  # type: ignore[no-untyped-def]
    count = np.add.reduceat(allowed, lp.pair_pointer[:-1], dtype=np.int64)
    pointer = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return pointer, lp.rows.take(np.flatnonzero(allowed))

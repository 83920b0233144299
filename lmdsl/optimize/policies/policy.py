"""Policies of the finite model: evaluate, improve, break ties.

A policy is an array of columns, one per cell of C (``pair``). P_u, G_u are its rows. It is
*gamma-stabilizing* when the spectral radius of gamma P_u is below 1; then its value
V = G_u + gamma P_u V is finite. Write g = max(gamma, 1).

For gamma >= 1, policy iteration from a gamma-stabilizing policy u and V >= T_u V that changes a
control only where strictly better keeps every policy gamma-stabilizing, zeros in the cost included
(docs/mathematics.md, Policy iteration).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.types import Bools, Floats, Pairs, never
from lmdsl.common.types import Stop as Stop
from lmdsl.machine import memory
from lmdsl.machine.deadline import Stopped
from lmdsl.model import stabilizable_set
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.reachability import reaches_attractor
from lmdsl.optimize.linear import equations, extrapolation
from lmdsl.optimize.linear.gauss_seidel import CEILING, TOLERANCE
from lmdsl.optimize.linear.policy_system import of_policy
from lmdsl.optimize.linear.substitution import Peeled
from lmdsl.optimize.policies import bellman
from lmdsl.optimize.policies.screening import Pass, Screen

TIE = 1e-12
"""Relative difference in Q up to which two controls count as tied."""

LEAST_SWEEPS, MOST_SWEEPS = 12, 60

FEW = 500
"""Changes in fewer than one of so many cells: another pass costs less than evaluating them."""


PATIENCE = 200
"""Sweeps in evaluations that did not come to their end before a Krylov method takes their place."""


PROBES = 64
"""Rows looked at before all are."""


def evaluate(
    lp: StabilizationLP,
    pair: Pairs,
    gamma: float | None = None,
    cost: Floats | None = None,
    start: Floats | None = None,
    transient: bool = False,
    stop: Stop = never,
    rows: Peeled | None = None,
) -> Floats | None:
    """Return V = G_u + gamma P_u V, shape (n,); None where the policy has no finite value.

    Parameters
    ----------
    lp, pair
        The model, and one column per cell.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    start
        A guess of V.
    transient
        The policy is known to be gamma-stabilizing, which saves looking whether it reaches A.
    stop
        Ends the work, with :class:`lmdsl.optimize.linear.equations.Stopped`.
    rows
        gamma P_u, where it is at hand.
    """
    gamma = lp.gamma if gamma is None else gamma
    b = (lp.cost if cost is None else cost)[pair]
    if gamma >= 1 and not transient and not reaches_attractor(lp, pair).all():
        return None
    x = np.array(b if start is None else start, dtype=np.float64)
    rows = peeled(lp, pair, gamma) if rows is None else rows
    found = equations.solve_from(rows, b, x, lambda: gamma * lp.rows.matrix(pair), stop=stop)
    return x if found else None


def peeled(lp: StabilizationLP, pair: Pairs, gamma: float) -> Peeled:
    """Return gamma P_u, ready for :func:`evaluate`."""
    return Peeled.of(of_policy(lp, pair, gamma))


@dataclass(frozen=True, eq=False)
class Iteration:
    """The outcome of policy iteration.

    Attributes
    ----------
    pair, value
        The last policy and its value.
    steps
        Improvement steps that changed the policy.
    converged
        False when stopped early.
    screen
        Lower bounds of the rivals of each cell's control at the value.
    """

    pair: Pairs
    value: Floats
    steps: int
    converged: bool
    screen: Screen


def iterate(
    lp: StabilizationLP,
    pair: Pairs,
    value: Floats,
    gamma: float | None = None,
    cost: Floats | None = None,
    stop: Stop = never,
    limit: int | None = None,
) -> Iteration:
    """Policy iteration from a gamma-stabilizing policy until no control is better.

    Parameters
    ----------
    lp, pair
        The model and the first policy.
    value
        Its value, or any V >= T_u V, such as :func:`bound` gives.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    stop, limit
        Asked before every step; largest number of steps.

    Notes
    -----
    Each step changes every control for which another one is better by a relative 1e-12. Then the
    new policy u is evaluated: to the end where few cells lie on cycles, else by sweeps
    V <- T_u V, about as long as the improvement took, or by a leap along the one mode in which they
    stall (:func:`lmdsl.optimize.linear.extrapolation.leap`); not at all after the first step, and every
    second time where few controls changed. V >= T_u V stays true whatever the number of sweeps, so
    V falls and every policy on the way is gamma-stabilizing (docs/mathematics.md, Policy
    iteration); only a policy evaluated to the end is returned as the last.
    """
    screen = Screen(lp, gamma, cost)
    gamma, cost = screen.gamma, screen.cost
    rows: Peeled | None = None  # those of the policy at hand
    V, last, step = value, None, 0  # last: the policy evaluated to the end, and its value
    hasty = False  # the policy at hand was not evaluated at all
    swept = 0  # sweeps that did not reach the end
    stalls = True  # sweeps do, in a single mode, as far as was seen
    while True:
        out = stop() or step == limit
        done = screen.improve(V, pair, TIE) if not out else Pass(V, pair, 0, 0)
        exact = None
        if done.changed:
            step += 1
            x = done.value
            hasty = not hasty and (step == 1 or done.changed * FEW < lp.n)
            if hasty:
                rows = None
            else:
                x = x.copy()
                sweeps = min(max(done.looked // lp.n, LEAST_SWEEPS), MOST_SWEEPS)
                rows = Peeled.of(screen.slots.held)  # the pass copied them
                fall = 0.0 if rows.small else _fall(V, x)
                far, left = 0.0, np.inf
                if stalls and not rows.small:
                    far = extrapolation.leap(rows.system, screen.paid, x)
                    stalls = 2 * far > sweeps
                paid = bool((screen.paid > 0).all())  # else what is free has to become 0
                slow = swept > PATIENCE and paid
                if slow:
                    enough = 0.1 * (fall or _fall(V, x))
                    slow = equations.descend(rows, screen.paid, x, enough, stop)
                    swept = swept if slow else 0
                if far < sweeps and not slow:
                    left = equations.advance(rows, screen.paid, x, sweeps, 0.1 * fall, 0.0)
                    if left > TOLERANCE and left > 0.1 * (fall or _fall(V, x)):
                        swept += sweeps
                exact = x if left <= TOLERANCE and paid else None
                x = np.minimum(x, done.value)
            screen.follow(V, x)
            pair, V = done.pair, x
        elif last is not None and last[0] is pair:
            return Iteration(*last, step, not out, screen)
        else:
            try:
                rows = rows or Peeled.of(screen.slots.system(pair))
                exact = evaluate(lp, pair, gamma, cost, done.value, True, stop, rows)
                if exact is None:
                    exact = evaluate(lp, pair, gamma, cost, stop=stop)
            except Stopped:
                return Iteration(*(last or (pair, V)), step, False, screen)
            if exact is None:
                return Iteration(*(last or (pair, V)), step, last is not None and not out, screen)
            screen.follow(V, np.minimum(exact, V))
            V = exact
        if exact is not None:
            if last is not None and not (exact < last[1]).any():
                # Rounding made a change look better than it is.
                return Iteration(*last, step, not out, screen)
            last = pair, exact
        if out:
            return Iteration(*(last or (pair, V)), step, False, screen)


def _fall(before: Floats, after: Floats) -> float:
    """Return the largest relative decrease."""
    ratio = np.divide(after, before, out=np.ones(len(before)), where=before > 0)
    return 1.0 - float(ratio.min(initial=1.0))


def bound(lp: StabilizationLP, pair: Pairs, w: Floats | None = None) -> Floats | None:
    """Return V >= T_u V of a g-stabilizing policy, close to its value; None where none is found.

    With w >= g P_u w + d, c w serves as soon as c d >= G_u; sweeps then lower it. Where all rows
    lose about as much of what is paid, a constant is close already.
    """
    cost = lp.cost[pair]
    even = _even(lp, pair, lp.gamma, cost)
    if even is not None:
        return even
    w, d = stability_vector(lp, pair, w)
    if w is None or d is None:
        return None
    V = _covering(w, d, cost)
    if V is None or _close(V[0] / w[0], d, cost):
        return V
    x = V.copy()
    equations.advance(peeled(lp, pair, lp.gamma), cost, x, MOST_SWEEPS, 1e-2, 0.0)
    return np.minimum(x, V)


def _even(lp: StabilizationLP, pair: Pairs, gamma: float, cost: Floats) -> Floats | None:
    """Return a constant V >= T_u V within a percent of the policy's value, None where none is."""
    some = np.arange(0, lp.n, lp.n // PROBES + 1)  # few have to be looked at where none is
    rows = lp.rows.take(pair[some])
    stays = np.where(rows.target < lp.n, rows.shares.value[rows.code], 0.0)
    d = 1 - gamma * np.add.reduceat(stays, rows.pointer[:-1])
    if not ((d > 0).all() and _close(float((cost[some] / d).max()), d, cost[some])):
        return None
    ones = np.ones(lp.n)
    lost = bounds.decrease(lp, pair, ones, gamma)
    V = None if lost is None else _covering(ones, lost, cost)
    return V if V is not None and lost is not None and _close(V[0], lost, cost) else None


def _covering(w: Floats, d: Floats, cost: Floats) -> Floats | None:
    """Return the least c w with c d >= cost, None where doubles end."""
    with np.errstate(over="ignore"):
        V: Floats = w * (float((cost / d).max()) * (1 + 1e-12))
    return V if (V < CEILING).all() else None


def _close(factor: float, d: Floats, cost: Floats) -> bool:
    """Return whether c w is within a percent of a policy's value, for w >= g P_u w + d."""
    return bool((d * (factor * (1 - 1e-2)) <= cost).all())


def canonical(
    lp: StabilizationLP,
    pair: Pairs,
    value: Floats,
    screen: Screen | None = None,
    stop: Stop = never,
) -> Pairs:
    """Break ties so that the policy reaches A: the policy that every backend ends with.

    Tied are the columns with Q <= Q_min + 1e-12 |Q_min|. Among them take those optimal for unit
    cost weighted with g, then the smallest control index; cells from which that cost is infinite
    take the smallest tied index. Where there is no memory for that, the policy at hand stays.

    Parameters
    ----------
    lp, pair, value
        The model, an optimal policy and its value.
    screen
        Lower bounds of the rivals of each cell's control at this value, where they are known.
    stop
        Ends the work, with :class:`lmdsl.optimize.linear.equations.Stopped`.
    """
    if screen is None:
        screen = Screen(lp)
    ties, first, several = screen.tied(value, TIE, pair)
    if not several:
        return first
    if not memory.fits(_taken_by_ties(lp, int(ties.sum()))):
        return pair
    if ties.all():  # the whole model, of which no copy is made
        sub, start, columns, inside = lp, pair, None, np.arange(lp.n)
    else:
        found = stabilizable_set.stabilizable(*_columns(lp, ties))
        if not found.inside.any():
            return first
        columns = np.flatnonzero(ties)[found.surviving]
        inside = np.flatnonzero(found.inside)
        sub = lp.part(columns, inside)
        start = np.searchsorted(columns, pair[inside])
        start = np.minimum(start, len(columns) - 1)
        owned = columns[start] == pair[inside]
        if not owned.all():
            start = np.where(owned, start, sub._algorithm_1[1])
    del ties
    unit = np.ones(sub.K)
    w = _even(sub, start, lp.growth, np.ones(sub.n))
    if w is None:
        w = evaluate(sub, start, lp.growth, unit, stop=stop)
    if w is None:
        start = sub._algorithm_1[1]
        w = evaluate(sub, start, lp.growth, unit, stop=stop)
    if w is None:
        return pair
    done = iterate(sub, start, w, lp.growth, unit, stop=stop)
    if stop():
        raise Stopped
    least = bellman.improve(sub, done.value, lp.growth, unit).value
    equal = bellman.tied(replace(sub, gamma=lp.growth, cost=unit), done.value, least, TIE)
    chosen = first.copy()
    column = first_column(sub, equal)
    chosen[inside] = column if columns is None else columns[column]
    return chosen


def _taken_by_ties(lp: StabilizationLP, count: int) -> int:
    """Return the bytes that breaking ties takes: a model of so many columns, and its costs."""
    row = len(lp.rows.target) // max(lp.K, 1) + 1
    copied = 0 if count == lp.K else 60 + row * (8 + lp.rows.code.itemsize)
    return count * (30 + copied)


def first_column(lp: StabilizationLP, allowed: Bools) -> Pairs:
    """Return the first allowed column of every cell (each cell must have one)."""
    columns = np.flatnonzero(allowed)
    return columns[np.searchsorted(columns, lp.pair_pointer[:-1])]


def _columns(lp: StabilizationLP, allowed: Bools):  # type: ignore[no-untyped-def]
    count = np.add.reduceat(allowed, lp.pair_pointer[:-1], dtype=np.int64)
    pointer = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return pointer, lp.rows.take(np.flatnonzero(allowed))


def stability_vector(
    lp: StabilizationLP,
    pair: Pairs,
    guess: Floats | None = None,
    g: float | None = None,
    sharp: bool = False,
    stop: Stop = never,
    rows: Peeled | None = None,
) -> tuple[Floats, Floats] | tuple[None, None]:
    """Return w > 0, d > 0 with w >= g P_u w + d: a proof that the policy is g-stabilizing.

    w is close to the unit-cost value, closer where ``sharp``. Where that spans so many decades that
    1 is lost in rounding, the value at a slightly larger weight leaves a relative slack instead.
    """
    g = lp.growth if g is None else g
    if guess is not None and (d := bounds.decrease(lp, pair, guess, g)) is not None:
        return guess, d
    unit = np.ones(lp.n)
    w = unit.copy()
    rows = peeled(lp, pair, g) if rows is None else rows
    # Sweeps from below leave 1 + g P w - w at most what they still move.
    if equations.advance(rows, unit, w, 128, 0.0, 1e-2 if sharp else 0.25) < np.inf:
        d = bounds.decrease(lp, pair, w, g)
        if d is not None:
            return w, d
    units = np.broadcast_to(1.0, lp.K)  # takes no memory
    for inflation in (0.0, 5e-7, 1e-10):
        w_more = evaluate(lp, pair, g * (1 + inflation), units, guess, stop=stop)
        if w_more is not None and (d := bounds.decrease(lp, pair, w_more, g)) is not None:
            return w_more, d
    return None, None

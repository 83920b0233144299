"""The largest feasible gamma: gamma_bar = 1/rho*, rho* = min over policies of rho(P_u) on C.

Two vectors that anyone can check enclose it (h(w) = min_a P_a w):

low    a policy u and w > 0 with low P_u w <= w: the policy is gamma-stabilizing for gamma < low.
high   w >= 0, w != 0 with w <= high P_a w for every surviving pair: at gamma >= high the cells
       with w > 0 have no policy of finite occupation.

gamma_bar is infinite exactly when C is exhausted by levels "some surviving pair has all
successors in A or in lower levels": then a policy reaches A within a fixed number of steps.

From below: unit-cost policy iteration at some gamma, then gamma is raised to just under the limit
of the policy found, again and again. Close to its limit the value of a policy is dominated by its
slowest class, so improving it shrinks the largest spectral radius. From above: at a gamma slightly
beyond the limit reached, optimal stopping gives the vector, supported where growth wins, zero
elsewhere; plain power iteration would not close the bracket for reducible structures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl import bounds, linear, policy
from lmdsl.errors import BadInput
from lmdsl.graph import CellStatus
from lmdsl.lp import StabilizationLP, compile
from lmdsl.problem import Problem
from lmdsl.transitions import Progress

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]

WIDTH = 1e-6
"""Relative width of the bracket aimed at."""


@dataclass(frozen=True)
class GammaBar:
    """A proved bracket of gamma_bar.

    Attributes
    ----------
    low, high
        gamma_bar lies in [low, high]; both infinite when the graph test says so, high infinite
        alone when no upper bound was found.
    pair
        A policy that is gamma-stabilizing for every gamma < low: a column per cell of C.
    w_low
        w > 0 with low P_u w <= w, shape (n,); None where gamma_bar is infinite.
    w_high
        w >= 0, not 0, with w <= high P_a w for every pair, shape (n,); None where high is infinite.
    note
        Empty, or why the bracket is wider than 1e-6.
    """

    low: float
    high: float
    pair: Pairs
    w_low: Floats | None
    w_high: Floats | None
    note: str = ""


def gamma_max(problem: Problem | StabilizationLP, progress: Progress | None = None) -> GammaBar:
    """Enclose the largest feasible gamma of a problem.

    Parameters
    ----------
    problem
        A problem, or its compiled LP; its own gamma plays no part.
    progress
        Called with (stage, fraction done, or -1).

    Returns
    -------
    GammaBar
        Relative width at most 1e-6, wider only where the vectors leave the range of doubles.

    Raises
    ------
    BadInput
        The problem cannot be compiled, or no cell is stabilizable.
    """
    lp = compile(problem, progress) if isinstance(problem, Problem) else problem
    if not lp.n:
        raise BadInput("no cell is stabilizable, so there is no gamma_bar")
    if progress:
        progress("gamma-max", -1.0)
    return bracket(lp)


def bracket(lp: StabilizationLP, stop: policy.Stop = lambda: False, limit: int = 60) -> GammaBar:
    """Enclose gamma_bar of a model with at least one cell; ``stop`` ends the work early."""
    certain = exhausted_by_levels(lp)
    if certain is not None:
        return GammaBar(math.inf, math.inf, certain, None, None)
    best = _from_below(lp, lp.tree[1], 1.0)
    high, w_high = math.inf, None
    overflow = False
    for _ in range(limit):
        if stop():
            break
        climbed = _climb(lp, best)
        if climbed is not None and climbed.low > best.low:
            best = climbed
        for step in (0.4 * WIDTH, 10 * WIDTH, 1e-3, 0.1, 1.0):
            found = _from_above(lp, best.low * (1 + step))
            if found is not None:
                if found[0] < high:
                    high, w_high = found
                break
        if high <= best.low * (1 + WIDTH):
            break
        if climbed is None or climbed.low <= best.low * (1 + 1e-13):
            between = _between(lp, best, high)
            if between is None:
                overflow = True
                break
            best = between
    note = ""
    if high > best.low * (1 + WIDTH):
        note = "the vectors leave the range of doubles; the bracket is as tight as they allow"
        note = note if overflow else "the work was ended before the bracket closed"
    return GammaBar(best.low, high, best.pair, best.w_low, w_high, note)


def check_low(lp: StabilizationLP, pair: Pairs, w: Floats) -> float | None:
    """Return the largest low (rounded down) with low P_u w <= w, None where w > 0 fails."""
    if not (np.isfinite(w).all() and (w > 0).all()):
        return None
    ahead = bounds.expected_above(lp, pair, w, 1.0)
    with np.errstate(divide="ignore"):
        ratio = w / ahead
    return float(ratio.min()) * (1 - 4 * bounds.UNIT)


def check_high(lp: StabilizationLP, w: Floats) -> float | None:
    """Return the least high (rounded up) with w <= high P_a w for all pairs, None if none is."""
    if not (np.isfinite(w).all() and (w >= 0).all() and (w > 0).any()):
        return None
    ahead = bounds.backup_below(lp, w, 1.0, None)
    on = w > 0
    if (ahead[on] <= 0).any():
        return None
    return float((w[on] / ahead[on]).max()) * (1 + 4 * bounds.UNIT)


def exhausted_by_levels(lp: StabilizationLP) -> Pairs | None:
    """Return a policy that reaches A within n steps surely, None where there is none."""
    before = lp.predecessors
    pair = np.full(lp.n, -1, dtype=np.int64)
    _sure_levels(before.pointer, before.pair, lp.rows.pointer, lp.rows.target, lp.cell, pair)
    return pair if (pair >= 0).all() else None


def _from_below(lp: StabilizationLP, pair: Pairs, gamma: float) -> GammaBar:
    w = policy.evaluate(lp, pair, gamma, np.ones(lp.K))
    low = None if w is None else check_low(lp, pair, w)
    if low is None:  # a transient policy always has a value at gamma = 1 unless doubles end
        return GammaBar(0.0, math.inf, pair, None, None)
    return GammaBar(low, math.inf, pair, w, None)


def _climb(lp: StabilizationLP, start: GammaBar) -> GammaBar | None:
    """Improve the policy under unit cost just below its limit, then find its new limit."""
    unit = np.ones(lp.K)
    at = start.low * (1 - 1e-3)
    value = policy.evaluate(lp, start.pair, at, unit)
    if value is None:
        return None
    done = policy.iterate(lp, start.pair, value, at, unit)
    return _limit(lp, done.pair, max(start.low, at), done.value)


def _limit(lp: StabilizationLP, pair: Pairs, at: float, guess: Floats) -> GammaBar | None:
    """Return a proved low of a policy, close to 1/rho(P_u)."""
    best = _proved(lp, pair, guess)
    gamma = at
    # Inverse iteration: v = (I - gamma P)^-1 v grows by 1/(1 - gamma rho) in the slowest class.
    for _ in range(40):
        v = policy.evaluate(lp, pair, gamma, np.ones(lp.K))
        if v is None:
            break
        found = _proved(lp, pair, v)
        if found is not None and (best is None or found.low > best.low):
            best = found
        growth = _growth(lp, pair, gamma, v)
        if growth is None:
            break
        limit = gamma / (1 - 1 / growth)
        if limit <= gamma * (1 + 2e-7):
            break
        # Aim just below the estimated limit; halve the distance where that overshoots.
        for share in (1 - 1e-1, 0.5, 0.1):
            target = gamma + share * (limit - gamma)
            if limit - gamma < 1e-5 * gamma:
                target = limit * (1 - 1e-7) if share > 0.6 else target
            if target > gamma and policy.evaluate(lp, pair, target, np.ones(lp.K)) is not None:
                gamma = target
                break
        else:
            break
    return best


def _growth(lp: StabilizationLP, pair: Pairs, gamma: float, v: Floats) -> float | None:
    """Return the largest factor by which one more inverse step makes a component grow."""
    M = gamma * lp.rows.matrix(pair)
    top = float(v.max())
    scaled = v / top
    x = linear.solve(M, scaled)
    if x is None or not np.isfinite(x).all():
        return None
    return max(float((x / scaled).max()), 1 + 1e-12)


def _proved(lp: StabilizationLP, pair: Pairs, w: Floats) -> GammaBar | None:
    low = check_low(lp, pair, w)
    return None if low is None else GammaBar(low, math.inf, pair, w, None)


def _from_above(lp: StabilizationLP, gamma: float) -> tuple[float, Floats] | None:
    """Return a proved high close to gamma and its vector, None where gamma is feasible."""
    at = replace(lp, gamma=gamma)
    w = policy.refusal(at)
    if w is None:
        return None
    high = check_high(lp, w)
    return None if high is None or not math.isfinite(high) else (high, w)


def _between(lp: StabilizationLP, best: GammaBar, high: float) -> GammaBar | None:
    """Look for a better policy strictly inside the bracket."""
    top = high if math.isfinite(high) else 4 * best.low
    for share in (0.5, 0.1, 0.01):
        gamma = best.low + share * (top - best.low)
        found = policy.stabilizing(replace(lp, gamma=gamma))
        if isinstance(found, policy.Feasible):
            better = _limit(lp, found.pair, gamma, found.w)
            if better is not None and better.low > best.low:
                return better
    return None


def restricted(lp: StabilizationLP, w: Floats) -> StabilizationLP | None:
    """Leave out the cells a refusal proves infeasible, and the pairs that can lead to them.

    With w the greatest solution of w = min(1, gamma min_a P_a w), every cell with w = 0 keeps a
    pair whose successors all have w = 0: the smaller model is the part on which gamma is feasible.

    Parameters
    ----------
    lp, w
        The model and the vector of its refusal (claim 6), shape (n,).

    Returns
    -------
    StabilizationLP or None
        The model on the cells with w = 0; the others get the status BEYOND_GAMMA. None where no
        cell is left, or one is left without a pair.
    """
    inside = np.flatnonzero(w == 0)
    beyond = np.append(w > 0, False)
    length = np.diff(lp.rows.pointer)
    leads = np.add.reduceat(beyond[lp.rows.target].astype(np.int64), lp.rows.pointer[:-1]) > 0
    columns = np.flatnonzero(~leads & (w[lp.cell] == 0) & (length > 0))
    if not len(inside) or len(np.unique(lp.cell[columns])) < len(inside):
        return None
    smaller = lp.part(columns, inside)
    status = lp.cell_status.copy()
    status[lp.cells[w > 0]] = CellStatus.BEYOND_GAMMA
    total = math.fsum(smaller.weight)
    weight = smaller.weight / total if total > 0 else smaller.weight
    return replace(smaller, cell_status=status, weight=weight)


@njit(cache=True, nogil=True)
def _sure_levels(before_pointer, before_pair, pointer, target, cell, pair):  # type: ignore[no-untyped-def]
    """Peel off cells with a pair all of whose successors are in A or peeled off before."""
    n = len(pair)
    waits = np.empty(len(cell), dtype=np.int32)
    for k in range(len(cell)):
        waits[k] = pointer[k + 1] - pointer[k]
    queue = np.empty(n + 1, dtype=np.int64)
    queue[0] = n  # the attractor
    start, end = 0, 1
    while start < end:
        j = queue[start]
        start += 1
        for e in range(before_pointer[j], before_pointer[j + 1]):
            k = before_pair[e]
            waits[k] -= 1
            if waits[k] == 0 and pair[cell[k]] < 0:
                pair[cell[k]] = k
                queue[end] = cell[k]
                end += 1

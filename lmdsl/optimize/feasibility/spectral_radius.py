"""The spectral radius of one policy by class: an upper bound of rho(P_u) that anyone can check.

rho(P_u) is the largest spectral radius of a strongly connected class. Each class gets a positive
vector close to its Perron vector by Noda's iteration; w is these vectors, each scaled so that what
flows in from the classes it leads to is smaller than the slack: a factor of at most 1/slack for
each slow class on a way to A, and no more. So a chain of tens of equal slow classes, whose values
grow over hundreds of decades, costs one pass.

Howard's iteration raises the limit of a policy: the one of least spectral radius is best.
"""

import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.on_disk import filled
from lmdsl.common.types import Bools, Floats, Indices, Policy, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.machine.forking import cached_property
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.feasibility.perron import FINE, _perron, _scale
from lmdsl.optimize.linear import classes, equations
from lmdsl.optimize.policies import bellman, iteration

TIED = 1e-6  # relative difference of rates above which two classes do not count as equally slow

PASSES = 8  # passes over all pairs towards a policy from which runs last least

HORIZON = 4  # number of times the least possible steps within which a policy should bring runs to A

# Number of improvements above which none is made; how well first rates are known; gain of none.
ROUNDS, COARSE, SLIGHT = 100, 1e-2, 1e-10


@dataclass(frozen=True, eq=False)
class PolicyClasses:
    """A policy class by class."""

    policy: Policy  # A column per cell
    P: Any  # its rows, CSR, shape (n, n)
    # order, ends: its cells by class, every class after all it leads to: see ``linear.classes``
    order: Indices
    ends: Indices
    x: Floats  # A positive vector on every class, close to the Perron vector; shape (n,)
    # upper bound of the spectral radius of the class of every cell, up to rounding, shape (n,)
    rate: Floats
    known: float  # how well the largest rates are known, relative

    @property
    def limit(self) -> float:
        """1/rho(P_u): the policy is gamma-stabilizing below it."""
        rate = float(self.rate.max())
        return 1 / rate if rate > 0 else math.inf

    @property
    def slowest(self) -> Bools:
        """The cells of the classes that set the limit, shape (n,)."""
        slowest: Bools = self.rate >= self.rate.max() * (1 - TIED)
        return slowest

    @cached_property
    def slow_vector(self) -> Floats:
        """The vectors of these classes, 0 elsewhere, shape (n,)."""
        return np.where(self.slowest, self.x, 0.0)


def of_policy(
    lp: StabilizationLP,
    policy: Policy,
    time_up: TimeUp = never,
    start: Floats | None = None,
    enough: float = FINE,
    inside: Bools | None = None,
) -> PolicyClasses:
    """Take a policy apart into classes and estimate the spectral radius of each.

    ``start`` is a guess of x, ``enough`` how well the rates have to be known, relative; where only
    the cells ``inside`` count, runs that leave them end.
    """
    P = lp.rows.matrix(policy)
    if inside is not None:
        P.data[~(inside[P.indices] & np.repeat(inside, np.diff(P.indptr)))] = 0.0
        P.eliminate_zeros()
    order, ends = classes.classes(P)
    x, rate = np.ones(lp.n), P.diagonal()
    lengths = np.diff(ends, prepend=0)
    several = np.flatnonzero(lengths > 1)
    slowest = float(rate[order[ends[lengths == 1] - 1]].max(initial=0.0))
    for k in several[np.argsort(lengths[several], kind="stable")]:
        cells = np.sort(order[ends[k] - lengths[k] : ends[k]])
        directions = lp._directions.among(cells) if len(cells) >= equations.KRYLOV else None
        begin = None if start is None else start[cells]
        x[cells], rate[cells], least = _perron(
            P[cells][:, cells], time_up, slowest, directions, begin, enough
        )
        slowest = max(slowest, least)
    return PolicyClasses(policy, P, order, ends, x, rate, enough)


def short_lived(lp: StabilizationLP, time_up: TimeUp = never) -> PolicyClasses:
    """Return a policy that brings runs to A within a few steps, as far as any is known to do.

    From the levels of Algorithm 1, w <- min_a P_a w weighs what has not arrived by then. Where runs
    last under the policy that comes out, as on long ways, the optimum under unit cost, discounted,
    may be better, or the policy of the levels.
    """
    level, policy = lp._algorithm_1
    horizon = float(HORIZON * level.max())

    def candidates() -> Iterator[tuple[Policy, Floats | None]]:
        w, zero = level.astype(np.float64), filled(lp.cost, 0.0)
        for _ in range(PASSES):
            done = bellman.improve(lp, w, 1.0, zero)
            w = done.value
        yield done.policy, None
        unit, value = filled(lp.cost, 1.0), np.full(lp.n, horizon)
        found = iteration.iterate(lp, policy, value, 1 - 1 / horizon, unit, time_up=time_up)
        yield found.policy, found.value
        yield policy, None

    best: PolicyClasses | None = None
    for candidate, start in candidates():
        one = of_policy(lp, candidate, time_up, start, COARSE)
        if one.limit <= 1 + 1 / horizon:
            one = of_policy(lp, candidate, time_up, one.x, 0.1 / horizon)
        best = one if best is None or one.limit > best.limit else best
        if time_up() or best.limit > 1 + 1 / horizon:
            break
    assert best is not None
    return best


def prove_low(lp: StabilizationLP, found: PolicyClasses) -> tuple[float, Floats] | None:
    """Return a proved low of a policy and its w."""
    w = lifted(found)
    low = None if w is None else check_low(lp, found.policy, w)
    return None if w is None or low is None else (low, w)


def lifted(found: PolicyClasses) -> Floats | None:
    """Return w > 0 with P_u w <= lam w, with the least slack that doubles allow."""
    P, w, rho = found.P, np.empty(len(found.x)), float(found.rate.max())

    def fits(power: float) -> bool:
        bound = rho * (1 + 10.0**power)
        return bool(_scale(P.indptr, P.indices, P.data, found.order, found.ends, found.x, bound, w))

    power, failed = -9.0, -9.0
    if not fits(power):
        power = 3.0  # where the scales do not grow any more
        while power - failed > 0.02:
            middle = (power + failed) / 2
            power, failed = (middle, failed) if fits(middle) else (power, middle)
        if not fits(power):
            return None
    return w


def check_low(lp: StabilizationLP, policy: Policy, w: Floats) -> float | None:
    """Return the largest low (rounded down) with low P_u w <= w, None where w > 0 fails."""
    if not (np.isfinite(w).all() and (w > 0).all()):
        return None
    ahead = bounds.expected_above(lp, policy, w, 1.0)
    with np.errstate(divide="ignore", over="ignore"):
        ratio = np.where(ahead > 0, np.minimum(w / ahead, sys.float_info.max), np.inf)
    return float(ratio.min()) * (1 - 4 * bounds.UNIT)


def improved(
    lp: StabilizationLP,
    found: PolicyClasses,
    time_up: TimeUp = never,
    until: float = math.inf,
    least: float = 1e-2 * TIED,
    inside: Bools | None = None,
) -> PolicyClasses:
    """Raise the limit of a policy by Howard's policy iteration.

    A control a with (P_a w)_i < (P_u w)_i keeps P_u w <= lam w, w > 0 being the vector that proves
    the limit 1/lam: no step lowers it. While the limit still rises fast, the rates need not be
    known well. ``until`` is a limit that is enough; a step of a relative gain below ``least`` is
    the last. ``inside`` as in :func:`of_policy`, of which ``found`` then comes.
    """
    enough = COARSE
    with suppress(Stopped):
        for _ in range(ROUNDS):
            w = lifted(found)
            if w is None or time_up() or found.limit > until:
                break
            new = _greedy(lp, found, w, enough, time_up, inside)
            gain = 0.0 if new is None else new.limit / found.limit - 1
            if new is not None and gain > 0:
                found, enough = new, min(enough, max(FINE, 1e-2 * gain))
            elif found.known <= FINE:
                break
            if gain < least and found.known > FINE:
                found = of_policy(lp, found.policy, time_up, found.x, FINE, inside)
            if 0 < gain < least:
                break
    return found


def _greedy(
    lp: StabilizationLP,
    found: PolicyClasses,
    w: Floats,
    enough: float,
    time_up: TimeUp,
    inside: Bools | None,
) -> PolicyClasses | None:
    """Return the policy that is better for the w of another, None where none is."""
    w = w if inside is None else np.where(inside, w, 0.0)
    best = bellman.improve(lp, w, 1.0, filled(lp.cost, 0.0))
    change = best.value < (found.P @ w) * (1 - SLIGHT)
    if not change.any():
        return None
    policy = np.where(change, best.policy, found.policy)
    new = of_policy(lp, policy, time_up, found.x, enough, inside)
    if new.limit <= found.limit * (1 + enough):
        return of_policy(lp, policy, time_up, new.x, FINE, inside)
    return new

"""Cells from which no policy has finite cost at a gamma: found, confined, checked."""

from contextlib import suppress

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.on_disk import filled
from lmdsl.common.types import Bools, Floats, Policy, TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize import descent
from lmdsl.optimize.feasibility import spectral_radius, stopping
from lmdsl.optimize.feasibility.spectral_radius import PolicyClasses
from lmdsl.optimize.policies import evaluation, iteration

# Relative width of the bracket aimed at, and the least that may be asked for.
WIDTH, LEAST_WIDTH = 1e-6, 1e-8

# Number of steps of optimal stopping above which the cells that limit gamma_bar stay unnamed.
MOST_STEPS_INSIDE = 12


def check_high(lp: StabilizationLP, w: Floats) -> float | None:
    """Return the least high (rounded up) with w <= high P_a w for all pairs, None if none is."""
    if not (np.isfinite(w).all() and (w >= 0).all() and (w > 0).any()):
        return None
    ahead = descent.backup_below(lp, w, 1.0, None)
    on = w > 0
    if (ahead[on] <= 0).any():
        return None
    return float((w[on] / ahead[on]).max()) * (1 + 4 * bounds.UNIT)


def exhausted_by_levels(lp: StabilizationLP) -> Policy | None:
    """Return a policy that reaches A within n steps surely, None where there is none."""
    before = lp._predecessors
    policy = np.full(lp.n, -1, dtype=np.int64)
    _sure_levels(before.pointer, before.pair, lp.rows.pointer, lp.rows.target, lp.cell, policy)
    return policy if (policy >= 0).all() else None


def _climbed(lp: StabilizationLP, start: PolicyClasses, time_up: TimeUp) -> PolicyClasses:
    """Improve a policy under unit cost just below its limit, where its value fits into doubles."""
    unit = filled(lp.cost, 1.0)
    for below in (1e-3, 0.1):
        at = start.limit * (1 - below)
        value = evaluation.evaluate(lp, start.policy, at, unit, time_up=time_up)
        if value is None:
            continue
        done = iteration.iterate(lp, start.policy, value, at, unit, time_up=time_up)
        if not done.steps:
            return start
        found = spectral_radius.of_policy(lp, done.policy, time_up)
        return found if found.limit > start.limit else start
    return start


def _beyond(
    lp: StabilizationLP,
    start: PolicyClasses,
    gamma: float,
    time_up: TimeUp,
    inside: Bools | None = None,
) -> PolicyClasses | tuple[float, Floats] | None:
    """Decide a gamma: a policy that is stabilizing there, or a proved high and its vector.

    Neither where doubles do not decide. The first stopping policy goes on wherever the class of
    ``start`` does not grow. With ``inside`` the vector is 0 in all other cells.
    """
    going = start.rate < (1 - 1e-12) / gamma  # gamma may be infinite
    reward = np.where(going, 1.0, start.x)  # which nothing changes, where no policy is better
    if inside is not None:
        reward, going = np.where(inside, reward, 0.0), going & inside
    limit = 1000 if inside is None else MOST_STEPS_INSIDE
    found = stopping.optimal_stopping(lp, gamma, reward, start.policy, going, time_up, limit)
    if found is None:
        return None
    if not found.refuses:
        better = spectral_radius.of_policy(lp, found.policy, time_up) if found.going.all() else None
        return better if better is not None and better.limit > start.limit else None
    # Small entries may be rounding, or what carries a vector that falls over many decades.
    for w in (found.carried, found.w):
        high = check_high(lp, w)
        if high is not None and high <= gamma * (1 + 1e-9):
            return high, w
    return None


def _core(
    lp: StabilizationLP,
    best: PolicyClasses,
    w_high: Floats,
    high: float,
    most: float,
    time_up: TimeUp,
) -> tuple[Floats, float]:
    """Return an upper vector on the slowest classes alone, and a high that holds for it too.

    Their Perron vectors serve where the best policy is also the least favourable one for them. Else
    stopping is rewarded in these classes only. Where neither closes the bracket (the controls can
    go round one slow class through another), w_high itself serves.
    """
    needed = check_high(lp, best.slow_vector)
    if needed is not None and needed <= most:
        return best.slow_vector, max(high, needed)
    # How far the controls can go round these classes: they limit nothing if far enough.
    alone = spectral_radius.improved(lp, best, time_up, most, inside=best.slowest)
    if alone.limit > most:
        return w_high, high
    answer = None
    with suppress(Stopped):
        answer = _beyond(lp, alone, alone.limit * (1 + 0.1 * WIDTH), time_up, best.slowest)
    if isinstance(answer, tuple) and answer[0] <= most:
        return answer[1], max(high, answer[0])
    return w_high, high


@kernel(allocates=True)
def _sure_levels(before_pointer, before_pair, pointer, target, cell, policy):  # type: ignore[no-untyped-def]
    """Peel off cells with a pair all of whose successors are in A or peeled off before."""
    n = len(policy)
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
            if waits[k] == 0 and policy[cell[k]] < 0:
                policy[cell[k]] = k
                queue[end] = cell[k]
                end += 1

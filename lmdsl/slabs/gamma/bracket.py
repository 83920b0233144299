"""A bracket of gamma_bar over ranks, for models that no rank can hold.

low     the largest gamma at which a policy was proved stabilizing: one that is met while gamma is
        raised, or to which passes w <- min(w, gamma min_a P_a w) lead
high    the least one at which passes leave a vector w >= 0 with w <= high P_a w for every pair

Both are proved, but the bracket is as wide as that; rank 0 alone closes it where it holds the
model (``gamma/whole.py``). A policy is proved at g by its unit cost at some g' > g:
w = 1 + g' P_u w leaves w - g P_u w >= (1 - g / g') w, which no rounding swallows, however large w.
"""

import math
from dataclasses import replace

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.types import Floats, Policy, TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.descent import backup_below
from lmdsl.optimize.policies import bellman
from lmdsl.ranks.reading import Read
from lmdsl.slabs import beginning
from lmdsl.slabs.chains.evaluating import evaluator
from lmdsl.slabs.chains.first import First
from lmdsl.slabs.gamma import refusing

WIDTH, PROBES = 1e-3, 12  # relative width aimed at, and number of gammas asked for it
MISSES = 3  # times that no refusal was found, which takes many passes, before no other is tried
BEYOND = WIDTH / 8  # how far beyond a gamma the cost is worked out that proves a policy there
DESCENTS = 2  # times that passes, as many as before cells are given up, seek a better policy


def bracket(
    lp: StabilizationLP, w: Floats, gathered: int, time_up: TimeUp,
    enough: tuple[float, float] = (math.inf, 0.0),
) -> tuple[float, float]:  # fmt: skip
    """Return proved bounds of gamma_bar from a refusal of the gamma of a model; collective.

    Ends that are as good as those that are ``enough`` are not improved.
    """
    low, last = 0.0, lp._algorithm_1[1]
    for at, policy, V in beginning.climbing(lp, gathered, time_up):
        gain, last = at > low * (1 + WIDTH / 4), policy
        if proves_low(lp, policy, V, at):
            low = max(low, at)
        if (not gain and low > 1) or low >= enough[0]:
            break
    high = min(least_high(lp, w), lp.gamma)
    low = raised(lp, last, gathered, time_up, (low, high), enough[0])
    below, missed = low, 0
    for _ in range(PROBES):
        if high <= max(below * (1 + WIDTH), enough[1]) or low <= 1 or missed > MISSES or time_up():
            break
        between = math.sqrt(below * high)
        asked = replace(lp, gamma=between, _known=lp._algorithm_1)
        found = refusing.refusal(asked, time_up, refusing.SLACKS[:1])
        if found is None:
            below, missed = between, missed + 1
        else:
            high = min(high, least_high(lp, found), between)
    return low, high


def raised(
    lp: StabilizationLP, policy: Policy, gathered: int, time_up: TimeUp,
    within: tuple[float, float], aim: float,
) -> float:  # fmt: skip
    """Return a gamma at which a policy is proved: one that is known, or a better; collective.

    It is halved towards, from low to high; one that is aimed at is tried first, and is enough.
    """
    (low, high), tried = within, 0
    for _ in range(PROBES):
        if high <= low * (1 + WIDTH) or not 1 < low < aim or time_up():
            break
        between = aim if aim < high else math.sqrt(low * high)
        if proved_at(lp, policy, between, gathered, time_up):
            low = between
            continue
        better = None if tried == DESCENTS else descended(lp, between, time_up)
        tried += better is not None
        if better is not None and proved_at(lp, better, between, gathered, time_up):
            low, policy = between, better
        else:
            high = between
    near = 1 < low < aim < within[1] and proved_at(lp, policy, aim, gathered, time_up)
    return aim if near else low


def descended(lp: StabilizationLP, gamma: float, time_up: TimeUp) -> Policy:
    """Return the controls by which passes w <- min(w, gamma min_a P_a w) lower w last; collective.

    Where w falls to nothing from 1 everywhere, they are stabilizing.
    """
    ranks, free = First(lp).mesh.ranks, np.zeros(lp.K)
    w, policy = np.ones(lp.n), lp._algorithm_1[1].copy()
    for _ in range(refusing.PASSES):
        better = bellman.improve(lp, w, gamma, free)
        lower = better.value < w * (1 - bounds.UNIT)
        policy[lower] = better.policy[lower]
        w[lower] = better.value[lower]
        if time_up() or ranks.all(bool((w < refusing.NOTHING).all() or not lower.any())):
            break
    return policy


def proved_at(
    lp: StabilizationLP, policy: Policy, gamma: float, gathered: int, time_up: TimeUp
) -> bool:
    """Return whether a policy is proved at gamma by its unit cost beyond it; collective."""
    unit = beginning.under_unit_cost(lp, gamma * (1 + BEYOND))
    try:
        w = evaluator(unit, gathered, time_up).value(policy, np.ones(lp.n))
    except Stopped:  # on all ranks
        return False
    return proves_low(lp, policy, w, gamma)


def enclosed(
    lp: StabilizationLP, w: Floats | None, gathered: int, time_up: TimeUp, low: float, high: float
) -> tuple[float, float]:
    """Return proved bounds of gamma_bar, within [low, high] where that can be shown; collective.

    ``w`` is a refusal of the gamma of a model, None where there is none. What leads to a bracket of
    other ranks is the same to the bit only for some numbers of ranks: so the ends that are asked
    for are aimed at, too, where that does not prove them.
    """
    if not First(lp).mesh.division.cells:
        return 0.0, 0.0
    found = (0.0, math.inf) if w is None else bracket(lp, w, gathered, time_up, (low, high))
    if found[0] < low < math.inf:
        aimed = replace(lp, gamma=low, _known=lp._algorithm_1)
        for at, policy, V in beginning.climbing(aimed, gathered, time_up):
            if at > found[0] and proves_low(lp, policy, V, at):
                found = at, found[1]
    if 1 < high < found[1]:
        refused = refusing.refusal(replace(lp, gamma=high, _known=lp._algorithm_1), time_up)
        if refused is not None:
            found = found[0], min(found[1], least_high(lp, refused))
    return found


def proves_low(lp: StabilizationLP, policy: Policy, w: Floats, low: float) -> bool:
    """Return whether w > 0 and low P_u w < w for a policy, read by number; collective."""
    ranks = First(lp).mesh.ranks
    if not ranks.all(bool((np.isfinite(w) & (w > 0)).all())):
        return False
    return ranks.all(bounds.decrease(_read(lp), policy, w, low) is not None)


def least_high(lp: StabilizationLP, w: Floats) -> float:
    """Return the least high (rounded up) with w <= high P_a w for all pairs; collective.

    Like a claim it reads values by number, by no plan of those who made w.
    """
    ahead = backup_below(_read(lp), w, 1.0, np.zeros(lp.K))
    on = w > 0
    with np.errstate(divide="ignore"):
        own = float((w[on] / ahead[on]).max(initial=0.0)) if (ahead[on] > 0).all() else math.inf
    return max(First(lp).mesh.ranks.collect(own)) * (1 + 4 * bounds.UNIT)


def _read(lp: StabilizationLP) -> StabilizationLP:
    return replace(lp, mesh=Read.again(First(lp).mesh))

"""A bracket of gamma_bar over ranks, for models that no rank can hold.

low     the largest gamma at which a policy was proved stabilizing while gamma was raised
high    the least one at which passes leave a vector w >= 0 with w <= high P_a w for every pair

Both are proved, but the bracket is as wide as that; rank 0 alone closes it where it holds the model
(``gamma/whole.py``).
"""

import math
from dataclasses import replace

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.types import Floats, Policy, TimeUp
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.descent import backup_below
from lmdsl.ranks.reading import Read
from lmdsl.slabs import beginning
from lmdsl.slabs.chains.first import First
from lmdsl.slabs.gamma import refusing

WIDTH, PROBES = 1e-3, 12  # relative width aimed at, and number of gammas asked for it
MISSES = 3  # times that no refusal was found, which takes many passes, before no other is tried


def bracket(
    lp: StabilizationLP, w: Floats, gathered: int, time_up: TimeUp,
    enough: tuple[float, float] = (math.inf, 0.0),
) -> tuple[float, float]:  # fmt: skip
    """Return proved bounds of gamma_bar from a refusal of the gamma of a model; collective.

    Ends that are as good as those that are ``enough`` are not improved.
    """
    low = 0.0
    for at, policy, V in beginning.climbing(lp, gathered, time_up):
        gain = at > low * (1 + WIDTH / 4)
        if proves_low(lp, policy, V, at):
            low = max(low, at)
        if (not gain and low > 1) or low >= enough[0]:
            break
    high, below, missed = min(least_high(lp, w), lp.gamma), low, 0
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

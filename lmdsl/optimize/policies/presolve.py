"""Columns that no optimal policy uses: left out before a linear program is solved.

With L <= V <= U for the optimal value V, a pair with gamma P_a L + G_a > U_i costs more than the
optimum whatever comes after it. U is the value of a policy a few steps from the first one; L are
value iterates from 0, which stay below V and rise. So the solver gets a smaller linear program with
the same optimum. What it answers is certified over all pairs all the same.
"""

import numpy as np

from lmdsl.common.types import Floats, Indices, Policy, TimeUp, never
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.policies import bellman, iteration

STEPS, PASSES = 3, 60  # number of improvements, and of passes, above which it ends
LEAST_RISE = 1e-3  # relative rise of the lower bound up to which a pass is the last
MARGIN = 1e-9  # relative excess over V above which a column is eliminated


def survivors(
    lp: StabilizationLP, policy: Policy, w: Floats | None = None, time_up: TimeUp = never
) -> Indices:
    """Return the columns that may belong to an optimal policy, and those of a first one, ascending.

    ``policy`` is gamma-stabilizing, w a proof of it where known; ``time_up`` ends the work with
    what is known.
    """
    start = iteration.bound(lp, policy, w)
    if start is None:
        return np.arange(lp.K)
    done = iteration.iterate(lp, policy, start, time_up=time_up, limit=STEPS)
    lower = np.zeros(lp.n)
    for _ in range(PASSES):
        higher = np.maximum(lower, bellman.improve(lp, lower).value)
        risen = float(higher.sum() - lower.sum())
        lower = higher
        if time_up() or risen <= LEAST_RISE * float(lower.sum()):
            break
    kept = bellman.below(lp, lower, done.value * (1 + MARGIN))
    kept[done.policy] = kept[policy] = True  # the first policy leads to A from everywhere
    return np.flatnonzero(kept)

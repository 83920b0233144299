"""A proof over ranks that no policy has finite cost at this gamma (claim 6).

Passes w <- min(w, gamma' min_a P_a w), rounded down, from w = 1 fall to the greatest w <= 1 that
satisfies w <= gamma' P_a w for every pair; gamma' is just below gamma, so that a pass that lowers w
by less than that factor leaves a proof at gamma. Cells that can be left fall for ever: after many
passes those that still fall are set to 0, and passes go on from there. Where w falls to nothing no
cell is beyond gamma, or close to it, and nothing is claimed; nor where passes run out.
"""

from collections.abc import Sequence

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.types import Floats, TimeUp
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.descent import backup_below

SLACKS = (1e-3, 1e-6, 1e-9)  # relative distance of gamma' from gamma, one after the other
PASSES = 500  # number of passes for each before cells are given up, and as many after it
NOTHING = 1e-12  # value below which a cell counts as one that can be left


def refusal(
    lp: StabilizationLP, time_up: TimeUp, slacks: Sequence[float] = SLACKS
) -> Floats | None:
    """Return w >= 0 of own cells, not 0 everywhere, with w <= gamma P_a w; collective."""
    assert lp.mesh is not None
    ranks = lp.mesh.ranks
    if lp.gamma <= 1:  # then every policy of C that reaches A has finite cost
        return None
    free = np.zeros(lp.K)  # with a cost, if 0, each row has a margin of its own, on any rank
    for slack in slacks:
        w, at = np.ones(lp.n), lp.gamma * (1 - slack)
        for k in range(2 * PASSES):
            lower = np.minimum(w, backup_below(lp, w, at, free))
            lower[lower < NOTHING] = 0.0
            still = lower >= w * (1 - slack / 2)
            w = lower
            settled = ranks.all(bool(still.all()))
            if settled or time_up() or not ranks.any(bool(w.any())):
                break
            if k == PASSES:  # what still falls is taken to fall to nothing
                w[~still] = 0.0
        if not ranks.any(bool(w.any())):
            continue
        if ranks.all(bounds.holds_for_all(lp, w, lp.gamma, None)):
            return w
    return None

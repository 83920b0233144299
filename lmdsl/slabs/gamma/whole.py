"""The whole model on rank 0, where it is small: for what is rare, and needs all pairs at once.

Rank 0 then uses the code of one process, and finds what one process finds. No rank may need it: of
a larger model all ranks say together what they can prove.
"""

from dataclasses import replace

import numpy as np

from lmdsl.model.lp import StabilizationLP
from lmdsl.slabs.chains.first import First

MOST_WHOLE = 2 * 10**7  # number of transitions up to which rank 0 holds a model


def fits(lp: StabilizationLP, most: int = MOST_WHOLE) -> bool:
    """Return whether a model has few transitions, on every rank; collective."""
    return sum(First(lp).mesh.ranks.collect(len(lp.rows.target))) <= most


def model(lp: StabilizationLP) -> StabilizationLP | None:
    """Return the whole model on rank 0, as one process compiles it; None on others; collective."""
    first = First(lp)
    gathered = first.model(np.arange(lp.K))
    status = first.gathered(lp.cell_status)
    return None if gathered is None else replace(gathered, cell_status=status)

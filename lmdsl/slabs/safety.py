"""Claim 7 over ranks: all that the pairs of a policy can meet lies in C u A.

Nothing of what compiling found is used: what cells are is asked of their owners, for the window of
the box that own pairs can meet. Which that is shows itself while these are judged: first some of
them, then all; what then leaves the window is judged again in a larger one.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices, Policy, Statuses
from lmdsl.model.grid.windows import Window, joined
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.following import SLACK, WindowSets
from lmdsl.model.successors.inclusion import Inclusion
from lmdsl.ranks.verbs import RankError, Ranks
from lmdsl.slabs.graph.telling import Telling
from lmdsl.systems.named import NotStored

FIRST = 2**8  # number of pairs that are judged to find the window of all


def unproved(ranks: Ranks, lp: StabilizationLP, policy: Policy) -> int:
    """Return of how many cells of all ranks the claim is not proved; collective.

    The work of a rank ends with the first ones. What rests on a function that was not saved is not
    found out.
    """
    starts = _starts(ranks, lp)
    planes = lp.cells[[0, -1] if lp.n else []] // (lp.partition.size // lp.partition.shape[0])
    rest, runs, slack, count = np.ones(lp.n, dtype=np.bool_), planes.reshape(-1, 2), 0, 0
    some = np.unique(np.linspace(0, lp.n - 1, min(lp.n, FIRST)).astype(np.int64))
    while ranks.any(bool(rest.any())):
        window = Window.around(lp.partition, runs, slack)
        told = Telling.agreed(ranks, starts, window.runs if len(some) else [])
        status = told.heard(lp.cell_status)
        found = ranks.agreed(partial(_judged, lp, some, lp.control[policy[some]], window, status))
        count += int((~found.proved & ~found.beyond).sum())
        rest[some] = found.beyond
        some = np.flatnonzero(rest)
        runs = joined(*np.append(runs, found.left, axis=0).T)
        slack = window.planes // SLACK
    return sum(ranks.collect(count))


def _starts(ranks: Ranks, lp: StabilizationLP) -> Indices:
    """Return where the parts of the box begin whose cells ranks have, then its number of cells."""
    ends = np.cumsum(ranks.collect(len(lp.cell_status)))
    if ends[-1] != lp.partition.size:
        raise RankError(f"ranks have {ends[-1]} of {lp.partition.size} cells of the box")
    return np.append(0, ends)


class _Found(NamedTuple):
    """Which pairs are proved, which are not judged, and the planes that these need, as runs."""

    proved: Bools
    beyond: Bools
    left: Indices


def _judged(
    lp: StabilizationLP, some: Indices, control: NDArray[np.int32], window: Window, status: Statuses
) -> _Found:
    """Judge the pairs of some own cells, by the statuses of the cells of a window."""
    none = np.zeros(len(some), dtype=np.bool_)
    nothing = _Found(~none, none, np.empty((0, 2), dtype=np.int64))
    if not len(some):
        return nothing
    sets = WindowSets(status == CellStatus.AVOID, status == CellStatus.ATTRACTOR)
    allowed = sets.attractor | (status == CellStatus.STABILIZED)
    own = window.positions(lp.cells)
    allowed[own[own >= 0]] = True
    try:
        inclusion = Inclusion(lp.problem, lp.partition, sets, allowed, window)
        proved, beyond = inclusion.within(lp.cells[some], control)
    except NotStored:
        return nothing
    return _Found(proved, beyond, inclusion.left)

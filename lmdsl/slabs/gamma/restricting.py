"""What a gamma leaves over ranks: the model without the cells that are proved infeasible."""

import math
from dataclasses import replace

import numpy as np

from lmdsl.common.types import Bools
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.slabs.compiling import exact_sum, kept_part
from lmdsl.slabs.graph import levels
from lmdsl.slabs.graph.levels import OwnRows


def restricted(lp: StabilizationLP, out: Bools, first: int) -> StabilizationLP | None:
    """Leave out own cells that no policy can have, and the pairs that can lead to such of any rank.

    As :func:`lmdsl.optimize.feasibility.restriction.restricted`; ``first`` is the first cell of the
    own part of the box. None where no cell is left, or one is left without a pair. Collective.
    """
    mesh, rows = lp.mesh, lp.rows
    assert mesh is not None
    ranks, cell = mesh.ranks, owner(lp.pair_pointer)
    beyond = mesh.spread(out, False)
    leads = np.zeros(rows.count, dtype=np.bool_)
    length = np.diff(rows.pointer)
    some = np.flatnonzero(length > 0)
    if len(some):
        entries = beyond[rows.target].astype(np.int64)
        leads[some] = np.add.reduceat(entries, rows.pointer[some]) > 0
    surviving = ~leads & ~out[cell] & (length > 0)
    per_cell = np.bincount(cell[surviving], minlength=lp.n)[~out]
    left = ranks.collect((int((~out).sum()), bool((per_cell > 0).all())))
    if not any(count for count, _ in left) or not all(good for _, good in left):
        return None
    smaller, kept, own = kept_part(mesh, rows, ~out, surviving)
    status = lp.cell_status.copy()
    status[lp.cells[out] - first] = CellStatus.BEYOND_GAMMA
    weight = lp.weight[~out]
    total = math.fsum(x for part in ranks.collect(exact_sum(weight)) for x in part)
    pointer = np.append(0, np.cumsum(per_cell)).astype(np.int64)
    known = levels.tree(smaller, OwnRows(pointer, own), np.ones(own.count, dtype=np.bool_))
    return replace(
        lp, cell_status=status, cells=lp.cells[~out], control=lp.control[kept], rows=own,
        pair_pointer=pointer, cost=lp.cost[kept], mesh=smaller, _known=known,
        weight=weight / total if total > 0 else weight,
    )  # fmt: skip

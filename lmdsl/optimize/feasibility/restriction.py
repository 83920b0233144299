"""What gamma leaves out: the cells proved infeasible, and the problem on the others."""

import math
from dataclasses import replace

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.model.grid.boxes import Area
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize.feasibility.gamma_bar import GammaBar
from lmdsl.problem.problem import Problem


def refusal_message(
    lp: StabilizationLP, w: Floats, limits: GammaBar, bracket: tuple[float, float]
) -> str:
    """Return the sentence that refuses a gamma: the bracket, the cells, and what can be done."""
    cells = Area.of(lp.partition, lp.cells[w > 0])
    return refusal_of_cells(lp.problem, lp.n, cells, limits.limiting, bracket)


def refusal_of_cells(
    problem: Problem, inside: int, cells: Area, limiting: Area | None, bracket: tuple[float, float]
) -> str:
    """Return the sentence that refuses a gamma: the bracket, the cells, and what can be done.

    ``inside`` is the number of cells of C, ``cells`` those that are infeasible, ``limiting`` those
    of them that limit gamma_bar, if known.
    """
    left = inside - len(cells)
    parts = [
        f"gamma = {problem.gamma!r} is not below gamma_bar, which lies in "
        f"[{bracket[0]:.9g}, {bracket[1]:.9g}]: proved that no control makes the cost finite from "
        f"{_counted(cells)}"
    ]
    if limiting is not None and len(limiting) != len(cells):
        parts.append(f"gamma_bar is limited by {_counted(limiting)}")
    if left and problem.successors != "enclosed":
        parts.append(
            "this corner limits gamma_bar for all; lower gamma, or solve on the other "
            f"{left} cells with --restrict-to-gamma (restrict_to_gamma=True)"
        )
    else:
        parts.append("lower gamma")
    return "; ".join(parts)


def _counted(area: Area) -> str:
    """Return how many cells an area has, and where, as text."""
    return f"{len(area)} cell{'s' * (len(area) != 1)} ({area})"


def restricted(lp: StabilizationLP, w: Floats) -> StabilizationLP | None:
    """Leave out the cells a refusal proves infeasible, and the pairs that can lead to them.

    With w, the vector of claim 6, the greatest solution of w = min(1, gamma min_a P_a w), every
    cell with w = 0 keeps a pair whose successors all have w = 0: the smaller model is the part on
    which gamma is feasible. The other cells get the status BEYOND_GAMMA. None where no cell is
    left, or one is left without a pair.
    """
    inside, out = np.flatnonzero(w == 0), ~(w == 0)  # also where a file says -1 or NaN
    beyond = np.append(out, False)
    length = np.diff(lp.rows.pointer)
    leads = np.add.reduceat(beyond[lp.rows.target].astype(np.int64), lp.rows.pointer[:-1]) > 0
    columns = np.flatnonzero(~leads & (w[lp.cell] == 0) & (length > 0))
    if not len(inside) or len(np.unique(lp.cell[columns])) < len(inside):
        return None
    smaller = lp.part(columns, inside)
    status = lp.cell_status.copy()
    status[lp.cells[out]] = CellStatus.BEYOND_GAMMA
    total = math.fsum(smaller.weight)
    weight = smaller.weight / total if total > 0 else smaller.weight
    return replace(smaller, cell_status=status, weight=weight)

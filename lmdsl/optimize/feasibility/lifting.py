"""A first policy from an earlier controller, of other cells, controls or another gamma.

On a cell the lifted policy takes the control that the earlier controller has at its centre, or the
nearest of the grid. Where there is none, or A is out of reach under these, Algorithm 1 chooses: its
cells fall level by level until one is met from which the lifted controls lead to A, all of whose
ways there keep them. So A is reached from everywhere; whether the policy is stabilizing at the
gamma asked for is proved, or it is dropped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Policy, TimeUp, never
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.machine.deadline import Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.model.algorithm_1 import reaches_attractor
from lmdsl.model.grid.partition import Partition
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.checkpoints import Unfinished
from lmdsl.optimize.feasibility.first_policy import Feasible, _proved
from lmdsl.optimize.policies import evaluation

COLUMN = 24  # bytes of a column while controls are looked up


@dataclass(frozen=True, eq=False)
class Earlier:
    """An earlier controller.

    Attributes
    ----------
    partition
        Its cells.
    controls
        Names of the controls.
    vectors
        Control vectors, shape (M, p).
    index
        Control index of every cell, -1 where there is none, shape (N,).
    """

    partition: Partition
    controls: tuple[str, ...]
    vectors: Floats
    index: NDArray[np.int32]

    def require_fit(self, lp: StabilizationLP) -> None:
        """Refuse the controller of another system."""
        for own, new, what in (
            (self.partition.names, lp.partition.names, "states"),
            (self.controls, lp.problem.controls, "controls"),
        ):
            if tuple(own) != tuple(new):
                raise BadInput(
                    f"its {what} are {shown(', '.join(own))}, those of the problem "
                    f"{shown(', '.join(new))}; give a result of the same system",
                    "start",
                )


def lifted(lp: StabilizationLP, earlier: Earlier, time_up: TimeUp = never) -> Feasible | None:
    """Return the lifted policy with its proof and its value; None where it is not stabilizing."""
    if not memory.fits(COLUMN * lp.K):
        return None
    return _proved_anew(lp, _column(lp, earlier), None, time_up)


def continued(lp: StabilizationLP, kept: Unfinished, time_up: TimeUp = never) -> Feasible | None:
    """Return the policy of a checkpoint with its proof and value; None where it is no good."""
    guess = kept.value if kept.positive else None
    return _proved_anew(lp, columns_of(lp, kept.control), guess, time_up)


def _proved_anew(
    lp: StabilizationLP, policy: Policy, guess: Floats | None, time_up: TimeUp
) -> Feasible | None:
    """Return a policy, where it serves, with its proof and value; None where it does not."""
    below = lp._algorithm_1[1]
    policy = np.where(policy >= 0, policy, below)
    policy = np.where(reaches_attractor(lp, policy), policy, below)
    try:
        w = None if guess is None else _proved(lp, policy, guess, time_up)
        if w is None:
            w, _ = evaluation.stability_vector(lp, policy, time_up=time_up)
        if w is None:
            return None
        value = evaluation.evaluate(lp, policy, start=guess, transient=True, time_up=time_up)
    except Stopped:
        return None
    return None if value is None else Feasible(policy, w, value)


def columns_of(lp: StabilizationLP, control: NDArray[np.integer]) -> Policy:
    """Return the column of a control of each cell of C, shape (n,); -1 where it has none."""
    column = np.empty(lp.n, dtype=np.int64)
    _find(lp.pair_pointer, lp.control, np.ascontiguousarray(control, dtype=np.int64), column)
    return column


@kernel
def _find(pair_pointer, control, wanted, column):  # type: ignore[no-untyped-def]
    """Look for a control among those of each cell, which ascend."""
    for i in range(len(column)):
        low, high = pair_pointer[i], pair_pointer[i + 1]
        while low < high:
            middle = (low + high) // 2
            if control[middle] < wanted[i]:
                low = middle + 1
            else:
                high = middle
        found = low < pair_pointer[i + 1] and control[low] == wanted[i]
        column[i] = low if found else -1


def _column(lp: StabilizationLP, earlier: Earlier) -> Policy:
    """Return the column of the earlier control of each cell, shape (n,); -1 where none survives."""
    centres = lp.partition.centres(lp.cells)
    _, cell = earlier.partition.enter(centres)
    index = np.where(cell >= 0, earlier.index[np.maximum(cell, 0)], -1)
    wanted = np.where(index >= 0, _nearest(earlier.vectors, lp.controls)[index], -1)
    M = len(lp.controls)
    key = lp.cell.astype(np.int64) * M + lp.control
    at = np.arange(lp.n, dtype=np.int64) * M + wanted
    column = np.minimum(np.searchsorted(key, at), lp.K - 1)
    found: Policy = np.where((wanted >= 0) & (key[column] == at), column, -1)
    return found


def _nearest(old: Floats, new: Floats) -> Indices:
    """Return for each old control vector the nearest new one, in parts of the ranges."""
    if not new.shape[1]:
        return np.zeros(len(old), dtype=np.int64)
    from scipy.spatial import KDTree

    span = np.ptp(new, axis=0)
    scale = np.where(span > 0, span, 1.0)
    return np.asarray(KDTree(new / scale).query(old / scale)[1], dtype=np.int64)

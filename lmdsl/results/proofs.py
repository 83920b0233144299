"""Proofs of the true map for a result: the closed loop that is proved, and what else is known."""

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.types import Progress
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.proving import Loop
from lmdsl.proof.proving import prove as proved
from lmdsl.proof.record import Proof
from lmdsl.results.result import Result


def prove(
    result: Result, target: float, time_limit: float | None, progress: Progress | None = None
) -> Proof:
    """Prove what becomes of C under the controller of a result; see :meth:`Result.prove`."""
    if not (inputs.is_number(target) and 0 < target <= 1):
        raise BadInput(f"{shown(target)} is no share; give a number above 0, at most 1", "target")
    deadline = Deadline.of(time_limit)
    if not (result.control_index >= 0).any():
        raise BadInput(
            "there is no controller of which anything could be proved: " + result.message
        )
    return proved(loop_of(result), target, deadline, holds(result), progress)


def loop_of(result: Result) -> Loop:
    """Return the closed loop of a result."""
    index, inside = result.control_index, result.cell_status == CellStatus.STABILIZED
    if (index[inside] < 0).any():
        raise BadInput("control_index has no control for a cell of C", "solution.npz")
    return Loop(
        result.problem, result.partition, result.cell_status,
        result.control_vectors[np.maximum(index, 0)],
    )  # fmt: skip


def holds(result: Result) -> bool | None:
    """Return whether the attractor cells are kept: proved, refuted by a run, or neither."""
    local = result.local_controller
    if local is None:
        return None
    if local.proved == local.cells:
        return True
    return False if local.kept < local.samples else None

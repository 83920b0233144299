"""What rank 0 holds of an answer to use its controller: two small numbers of every cell."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Statuses
from lmdsl.control.questions import InUse
from lmdsl.control.simulation import Simulation
from lmdsl.distributed.answer import Answer
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Ranks


@dataclass(frozen=True, eq=False)
class WholeLaw(Frozen, InUse):
    """The controller of all cells, and the runs that were made under it."""

    problem: Problem
    partition: Partition
    control_index: NDArray[np.int32]
    control_vectors: Floats
    cell_status: Statuses
    message: str
    simulation: Simulation | None = None

    @property
    def weight(self) -> Floats:
        """The user's m over all cells, shape (N,)."""
        weight = np.zeros(self.partition.size)
        on = np.flatnonzero(self.cell_status == CellStatus.STABILIZED)
        weight[on] = CellSets.of(self.problem, self.partition).weight(on)
        return weight


def in_use(ranks: Ranks, answer: Answer) -> WholeLaw | None:
    """Return the controller of all cells on rank 0, None on the others; collective."""
    index = ranks.gathered(answer.control_index)
    status = ranks.gathered(answer.cell_status)
    if index is None or status is None:
        return None
    return WholeLaw(
        answer.problem, answer.partition, index, answer.control_vectors, status, answer.message
    )

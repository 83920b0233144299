"""Compiling the kernels of a proof before the time of the caller runs.

Where nothing is compiled yet, that takes longer than many a time limit. So a proof under a limit
begins with one of the same problem on two cells an axis: the arrays are of the same kinds.
"""

import numpy as np

from lmdsl.common.types import Progress
from lmdsl.machine import kernels
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.loop import Loop
from lmdsl.proof.proving import prove

CELLS = 2  # an axis
MOMENT = 0.05  # seconds of one proof, in which nothing is compiled
MOST = 8  # proofs, each of which gets to kernels that the one before had no time for

_warm: set[tuple[object, ...]] = set()


def warm(loop: Loop, bracket: bool, progress: Progress | None) -> None:
    """Compile what a proof of a closed loop takes; nothing to do where that was done before."""
    kind = (loop.partition.dimension, loop.noisy, loop.to_stay, bracket, loop.problem.judged)
    if kind in _warm:
        return
    _warm.add(kind)
    if progress:
        progress("compile kernels", -1.0)
    few = small(loop)
    for _ in range(MOST):
        before = kernels.compiled()
        prove(few, 1.0, Deadline(MOMENT), lambda _: None, None, bracket)
        if kernels.compiled() == before:
            break


def small(loop: Loop) -> Loop:
    """Return a closed loop of the same problem with few cells, the last of them the attractor."""
    own = loop.partition
    cells = np.full(own.dimension, CELLS)
    partition = Partition(
        own.names, own.low, own.high, (own.high - own.low) / cells, cells, own.periodic, own.clip,
        own.numbered,
    )  # fmt: skip
    status = np.full(partition.size, CellStatus.STABILIZED, dtype=loop.status.dtype)
    if not loop.to_stay:
        status[-1] = CellStatus.ATTRACTOR
    first = int(np.argmax(loop.status == CellStatus.STABILIZED))
    control = np.repeat(loop.control[first : first + 1], partition.size, axis=0)
    return Loop(loop.problem, partition, status, control)

"""What the images of whole cells can meet, as the compiled model knows it.

The successors of a pair that is kept are enclosed on the states that lie in its cell, from the
first double to the last, while boxes of a proof have margins: an image that ends on an edge of
cells then meets what lies beyond it. Both hold all that the states of a box become, so their common
part does, too. A law that descends the levels of sure arrival is so proved by whole cells.
"""

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Statuses
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.kernels import kernel
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors import ranges
from lmdsl.model.successors.compiled.places import BITS, MAY_ARRIVE, MAY_LEAVE
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem


class CellRanges(NamedTuple):
    """Ranges of the images of the cells of C under their controls.

    Attributes
    ----------
    row
        By cell: its row below; -1 where it may leave, or nothing is known.
    first, last
        First and last index, shape (rows, parts, d), as :class:`lmdsl.model.successors.ranges.Ranges`
        has them.
    circle
        Number of cells by axis, 0 where it is no circle, shape (d,).
    absorbed
        The cell of A that stands for a path that surely enters A on its way, shape (d,); -1 for none.
    """  # noqa: E501

    row: NDArray[np.int32]
    first: NDArray[Any]
    last: NDArray[Any]
    circle: Indices
    absorbed: Indices

    @classmethod
    def of(
        cls, problem: Problem, partition: Partition, status: Statuses, control: Floats,
        deadline: Deadline,
    ) -> Self | None:  # fmt: skip
        """Return what is known; None where successors are not enclosed, or time is up."""
        if problem.successors != "enclosed":
            return None
        cell = np.flatnonzero(status == CellStatus.STABILIZED)
        index = _indices(control_vectors(problem), control[cell])
        cell, index = cell[index >= 0], index[index >= 0]
        attractor, avoid = status == CellStatus.ATTRACTOR, status == CellStatus.AVOID
        sets = CellSets.made(attractor, avoid, np.zeros(partition.size))
        try:
            found = ranges.enclosed(problem, partition, sets, (cell, index), deadline)
        except TimeLimitReached:
            return None
        row = np.full(partition.size, -1, dtype=np.int32)
        row[cell[~found.out]] = np.flatnonzero(~found.out)
        circle = np.where(partition.periodic, partition.cells, 0).astype(np.int64)
        on_way = problem.judged == "path" and absorbed_on_way(problem.local_controller)
        some = partition.multi_index(np.flatnonzero(attractor)[:1])
        absorbed = np.array([k[0] if on_way and len(k) else -1 for k in some], dtype=np.int64)
        return cls(row, found.first, found.last, circle, absorbed)

    def narrow(
        self, cell: NDArray[Any], part: int, image: Indices, flags: NDArray[np.uint8]
    ) -> None:
        """Leave of the images of boxes, with a part of the noise, what both say of them.

        Of boxes in these cells ``image`` has the places, shape (B, d, 2), and ``flags`` what they
        may do besides.
        """
        ends = self.first[:, part], self.last[:, part]
        _narrow(self.row[cell], ends, self.circle, self.absorbed, image, flags)


def _indices(vectors: Floats, control: Floats) -> NDArray[np.int64]:
    """Return the index of each control among all, -1 where it is none of them."""
    place = {vector.tobytes(): k for k, vector in reversed(list(enumerate(vectors + 0.0)))}
    own = np.ascontiguousarray(control + 0.0)  # -0 is 0
    return np.array([place.get(vector.tobytes(), -1) for vector in own], dtype=np.int64)


@kernel
def _narrow(rows, ends, circle, absorbed, image, flags):  # type: ignore[no-untyped-def]
    first, last = ends
    for b in range(len(rows)):
        r = rows[b]
        if r < 0:
            continue
        flags[b] &= ~np.uint8(MAY_LEAVE)
        arrived = True
        for k in range(len(circle)):
            arrived &= (first[r, k] == absorbed[k]) & (last[r, k] == absorbed[k])
        if arrived:  # on its way, or it ends in this cell
            flags[b] |= np.uint8(MAY_ARRIVE)
            image[b, :, 0], image[b, :, 1] = 1, 0
        if image[b, 0, 0] > image[b, 0, 1]:
            continue  # nothing of it is left
        for k in range(len(circle)):
            low, high, n = image[b, k, 0], image[b, k, 1], circle[k]
            found, least, most = 0, low, high
            for turn in range(-1, 2):
                if turn == 0 or n > 0:
                    begin = max(low, (np.int64(first[r, k]) + turn * n) << BITS)
                    end = min(high, ((np.int64(last[r, k]) + turn * n + 1) << BITS) - 1)
                    if begin <= end:
                        found, least, most = found + 1, begin, end
            if found == 1:  # else a circle of which both ends are met
                image[b, k, 0], image[b, k, 1] = least, most

"""The boxes B_i that hold all states, sample points and corners of cells, axis by axis.

A cell is a product, so its box is one of intervals, and an interval depends on the index on its
axis alone. On a circle the first cell has states at both ends of the axis, near ``high`` up to
``high`` itself: it has a second interval there, the *seam*, numbered behind those of the cells.
"""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.formulas.intervals import Interval
from lmdsl.model.grid.axis import AxisCells
from lmdsl.model.grid.partition import Partition


class Domain(NamedTuple):
    """The intervals of an axis.

    Attributes
    ----------
    low, high
        Their ends, shape (cells,), on a circle (cells + 1,): the last is the seam.
    circle
        Whether there is a seam.
    """

    low: Floats
    high: Floats
    circle: bool

    def positions(self, first: int, end: int) -> Indices:
        """Return the intervals of the cells first..end-1; the seam comes last, where there is."""
        index = np.arange(first, end)
        return np.append(index, len(self.low) - 1) if self.circle and first == 0 else index

    def pieces(self, positions: Indices, count: int) -> Interval:
        """Return intervals cut into equal pieces, shape (positions times count,)."""
        low, high = self.low[positions][:, None], self.high[positions][:, None]
        cuts = np.minimum(low + (high - low) * (np.arange(1, count) / count), high)
        ends = np.concatenate([low, cuts, high], axis=1)
        return Interval(ends[:, :-1].ravel(), ends[:, 1:].ravel())


def domains(partition: Partition, offsets: Floats) -> tuple[Domain, ...]:
    """Return the intervals of all axes; ``offsets`` are those of the sample points, (points, d)."""
    return tuple(
        _domain(partition, k, axis, float(offsets[:, k].max()))
        for k, axis in enumerate(partition.axes)
    )


def _domain(partition: Partition, k: int, axis: AxisCells, offset: float) -> Domain:
    index = np.arange(axis.cells)
    low = axis.low + (index - axis.margin) * axis.width
    high = axis.low + (index + 1 + axis.margin) * axis.width
    if axis.periodic or partition.clip:  # no state lies beyond; the last sample may, by rounding
        last = partition.place(k, np.array([int(axis.cells) - 1]), np.array([offset]))
        low, high = np.maximum(low, axis.low), np.minimum(high, max(axis.high, float(last[0])))
    if axis.periodic:
        seam = axis.low + (axis.cells - axis.margin) * axis.width
        low, high = np.append(low, seam), np.append(high, high[-1])
    return Domain(low, high, axis.periodic)

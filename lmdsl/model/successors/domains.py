"""The boxes B_i that hold all states, sample points and corners of cells, axis by axis.

A cell is a product, so its box is one of intervals, and an interval depends on the index on its
axis alone: from the first double that is located there to the last, and the sample points. On a
circle the first cell has states at both ends of the axis, near ``high`` up to ``high`` itself: it
has a second interval there, the *seam*, numbered behind those of the cells.
"""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.formulas.intervals import Interval
from lmdsl.model.grid.axis import EDGE, AxisCells
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
        _domain(partition, k, axis, offsets[:, k]) for k, axis in enumerate(partition.axes)
    )


def _domain(partition: Partition, k: int, axis: AxisCells, offsets: Floats) -> Domain:
    index = np.arange(int(axis.cells))
    first = _firsts(axis, np.arange(int(axis.cells) + 1, dtype=np.float64))
    low, high = first[:-1], np.nextafter(first[1:], -np.inf)
    if axis.periodic or partition.clip:
        low[0], high[-1] = axis.low, min(high[-1], axis.high)
    least, most = (partition.place(k, index, end) for end in (offsets.min(), offsets.max()))
    low, high = np.minimum(low, least), np.maximum(high, most)
    if axis.periodic:
        low, high = np.append(low, first[-1]), np.append(high, max(axis.high, high[-1]))
    return Domain(low, high, axis.periodic)


def _firsts(axis: AxisCells, index: Floats) -> Floats:
    """Return the first doubles that are located at or behind indices; behind the last, outside.

    Locating is monotone; the doubles lie within the margin of a cell around its ends.
    """
    reach = 4 * axis.margin * axis.width
    below = axis.low + index * axis.width - reach
    above = axis.low + index * axis.width + reach
    while True:
        middle = below / 2 + above / 2
        inside = (middle > below) & (middle < above)
        if not inside.any():
            return above
        found = _located(axis, middle)
        behind = found >= index
        above = np.where(inside & behind, middle, above)
        below = np.where(inside & ~behind, middle, below)


def _located(axis: AxisCells, x: Floats) -> Floats:
    """Return the index of states, -1 below the axis and ``cells`` above."""
    if axis.periodic:
        found = np.floor((x - axis.low) / axis.width + EDGE)
        return np.where(x < axis.low, -1.0, np.where(x > axis.high, axis.cells, found))
    found = axis.number(x, False)
    return np.where(
        np.isnan(found), np.where(x < axis.low + axis.width / 2, -1.0, axis.cells), found
    )

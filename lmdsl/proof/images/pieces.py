"""The boxes of nodes: parts of cells, with the margins in which their states may lie."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices
from lmdsl.model.grid.partition import Partition

DEEPEST = 30  # bisections of an axis
Integers = NDArray[Any]  # whole numbers of any kind


class Pieces(NamedTuple):
    """The boxes of nodes: one each, and more where a node lies at both ends of a circle.

    Attributes
    ----------
    owner
        Position of the node of each box.
    low, high
        Ends, shape (B, d).
    start
        Cells before the modulus, shape (B, d).
    """

    owner: Indices
    low: Floats
    high: Floats
    start: Floats


def pieces(partition: Partition, cell: Integers, split: Integers, place: Integers) -> Pieces:
    """Return the boxes of nodes, which hold all states that lie in them, ends rounded outward."""
    index = np.stack(partition.multi_index(cell), axis=-1).astype(np.float64)
    part = 2.0 ** -split.astype(np.float64)
    first, last = index + place * part, index + (place + 1.0) * part
    margin = np.array([axis.margin for axis in partition.axes])
    at_first, at_last = place == 0, place + 1.0 == 2.0**split
    first = np.where(at_first, first - margin, first)
    last = np.where(at_last, last + margin, last)
    owner, start = np.arange(len(index)), index
    for k in np.flatnonzero(partition.periodic):
        seam = np.flatnonzero(at_first[owner, k] & (index[owner, k] == 0))
        first, last, owner, start = (
            np.concatenate([ends, ends[seam]]) for ends in (first, last, owner, start)
        )
        beyond, n = slice(len(owner) - len(seam), None), float(partition.cells[k])
        first[beyond, k], last[beyond, k], start[beyond, k] = n - margin[k], n + margin[k], n
    low, high = _down(first * partition.width), _up(last * partition.width)
    return Pieces(owner, _down(partition.low + low), _up(partition.low + high), start)


def _down(x: Floats) -> Floats:
    return np.asarray(x - (np.abs(x) * 2.0**-52 + 2.0**-1000))


def _up(x: Floats) -> Floats:
    return np.asarray(x + (np.abs(x) * 2.0**-52 + 2.0**-1000))

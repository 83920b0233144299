"""Which centres of cells surround a state, and its barycentric coordinates among them.

The centres around a state span a cube, which Kuhn's simplices divide: from its lowest corner one
goes along the axes in the order of the state's coordinates in the cube, the largest first. Beyond
the outermost centres of an interval the last ones stand for those that are not there.
"""

from collections.abc import Iterator

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.model.grid.partition import Partition


def corners(partition: Partition, x: Floats) -> Iterator[tuple[Indices, Floats]]:
    """Yield the d + 1 corners of the simplices that hold states x, shape (r, d).

    Each as cells, shape (r,), and weights, shape (r,), >= 0; those of a state sum to 1.
    """
    t = (x - partition.low) / partition.width - 0.5
    corner = np.floor(t)
    part = t - corner
    order = np.argsort(-part, axis=1, kind="stable")
    high, low = np.ones((len(x), 1)), np.zeros((len(x), 1))
    parts = np.concatenate([high, np.take_along_axis(part, order, axis=1), low], axis=1)
    rows = np.arange(len(x))
    for k in range(partition.dimension + 1):
        if k:
            corner[rows, order[:, k - 1]] += 1
        yield _cells(partition, corner), parts[:, k] - parts[:, k + 1]


def _cells(partition: Partition, corner: Floats) -> Indices:
    """Return the cells of corners, shape (r,): on a circle counted around, else the last."""
    count = partition.cells
    index = np.where(partition.periodic, np.mod(corner, count), np.clip(corner, 0, count - 1))
    cells: Indices = np.ravel_multi_index(tuple(index.astype(np.int64).T), partition.shape)
    return cells

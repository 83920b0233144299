"""The controller made continuous within branches: barycentric between the centres of cells.

The centres around a state span a cube; Kuhn's simplices divide it, and the d + 1 corners of the
one that holds the state get its barycentric coordinates as weights. Corners of another branch than
the cell of the state, or without control, are left out; the weights of the rest are scaled to sum
1. Two cells are of one branch where no control differs by more than a share of its range. Beyond
the outermost centres of an interval nothing changes any more; on a circle there is no such place.

The certificate speaks of the piecewise constant law, not of this one.
"""

from typing import TYPE_CHECKING

import numpy as np

from lmdsl.common.types import Floats, Indices

if TYPE_CHECKING:
    from lmdsl.control.controller import Controller

JUMP = 0.25  # share of a control's range by which it may differ within a branch


class Interpolated:
    """A controller, interpolated; it is asked as the controller is.

    Parameters
    ----------
    controller
        What is interpolated. A local feedback on attractor cells stays as it is.
    """

    def __init__(self, controller: "Controller") -> None:
        self.controller, self.partition = controller, controller.partition
        self.vectors, self.index, self.local = (
            controller.vectors, controller.index, controller.local,
        )  # fmt: skip
        self.low, self.high = (
            end(controller.vectors, axis=0) if controller.vectors.size else np.zeros(0)
            for end in (np.min, np.max)
        )

    def at(self, cell: Indices, x: Floats | None = None) -> Floats:
        """Return the control at states x, shape (r, d), of given cells, shape (r, p)."""
        u = self.controller.at(cell, x)
        if x is None:
            return u
        cell = np.atleast_1d(cell)
        on = np.flatnonzero((cell >= 0) & (self.index[cell] >= 0))
        u[on] = self._between(np.asarray(x)[on], u[on])
        return u

    def _between(self, x: Floats, own: Floats) -> Floats:
        """Return the control at states whose own cells have one, shape (r, p)."""
        partition = self.partition
        t = (x - partition.low) / partition.width - 0.5
        corner = np.floor(t)
        part = t - corner
        order = np.argsort(-part, axis=1, kind="stable")
        sorted_parts = np.take_along_axis(part, order, axis=1)
        ends = np.ones((len(x), 1)), np.zeros((len(x), 1))
        weights = -np.diff(np.concatenate([ends[0], sorted_parts, ends[1]], axis=1), axis=1)
        moved, total = np.zeros_like(own), np.zeros(len(x))
        rows, reach = np.arange(len(x)), JUMP * (self.high - self.low)
        for k in range(partition.dimension + 1):
            if k:
                corner[rows, order[:, k - 1]] += 1
            index = self.index[self._cells(corner)]
            away = self.vectors[index] - own
            kept = (index >= 0) & (np.abs(away) <= reach).all(axis=1)
            weight = np.where(kept, weights[:, k], 0.0)
            moved += weight[:, None] * away
            total += weight
        some = total > 0
        moved[some] /= total[some, None]
        u: Floats = np.clip(own + np.where(some[:, None], moved, 0.0), self.low, self.high)
        return u

    def _cells(self, corner: Floats) -> Indices:
        """Return the cells of corners, shape (r,): on a circle counted around, else the last."""
        count = self.partition.cells
        wrapped = np.mod(corner, count)
        index = np.where(self.partition.periodic, wrapped, np.clip(corner, 0, count - 1))
        number: Indices = np.ravel_multi_index(
            tuple(index.astype(np.int64).T), self.partition.shape
        )
        return number

"""The feedback controller, and closed-loop simulation of the true map."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lmdsl.common import inputs
from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Indices
from lmdsl.errors import BadInput, shown
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.simplices import corners
from lmdsl.model.local.controller import LocalController

Law = Literal["constant", "interpolated"]
JUMP = 0.25  # share of a control's range by which it may differ within a branch


@dataclass(frozen=True, eq=False, repr=False)
class Controller(Frozen):
    """A feedback law that is constant on each cell.

    Attributes
    ----------
    partition
        The cells.
    vectors
        Control vectors, shape (M, p).
    index
        Control index of every cell, shape (N,), -1 where there is none; on attractor cells that
        of ``hold``.
    local
        Feedback on the attractor cells, None without one.
    """

    partition: Partition
    vectors: Floats
    index: NDArray[np.int32]
    local: LocalController | None = None

    mode: ClassVar[Law] = "constant"

    def __str__(self) -> str:
        covered = int((self.index >= 0).sum())
        inside = "" if self.local is None else ", and a feedback on the attractor cells"
        return (
            f"Controller of {', '.join(self.partition.names)}: constant on each of {covered:,} "
            f"cells (of {len(self.index):,}), one of {len(self.vectors):,} controls{inside}"
        )

    __repr__ = __str__

    @own_arithmetic
    def __call__(self, x: ArrayLike, mode: Law = "constant") -> Floats:
        """Return the control at states.

        Parameters
        ----------
        x
            Shape (..., d), in the order of the axes; or by name, in any order: a mapping from axes
            to arrays, a table with these columns. Periodic axes wrap; under ``on_exit: clip`` a
            state outside the box has the control of the nearest one inside.
        mode
            ``constant`` on cells, as certified; or ``interpolated`` between the centres of cells
            of one branch, see :class:`lmdsl.control.controller.Interpolated`: the certificate does
            not speak of that.

        Returns
        -------
        ndarray, shape (..., p)
            NaN where there is no control: off the stabilizable set, outside the box, and, without
            a local controller, on the attractor cells.
        """
        states = inputs.states(x, self.partition.names)
        flat, cell = self.partition.enter(states.reshape(-1, self.partition.dimension))
        return self.law(mode).at(cell, flat).reshape(*states.shape[:-1], self.vectors.shape[1])

    def law(self, mode: Law) -> "Controller | Interpolated":
        """Return the controller, or what interpolates it."""
        if mode not in ("constant", "interpolated"):
            fix = 'write "constant" or "interpolated"'
            raise BadInput(f"{shown(mode)} is not accepted; {fix}", "mode")
        if mode == "constant":
            return self
        if self.partition.numbered:
            raise BadInput("a finite model has no states between its cells", "mode")
        return Interpolated(self)

    def at(self, cell: Indices, x: Floats | None = None) -> Floats:
        """Return the control of cells, shape (r, p); NaN for -1 and without control.

        The local controller needs the states x, shape (r, d), and not only their cells.
        """
        cell = np.atleast_1d(cell)
        if cell.dtype.kind not in "iu" or cell.ndim != 1:
            raise BadInput(f"{shown(cell)} are no indices of cells, shape (r,)", "cell")
        if cell.size and not (cell.min() >= -1 and cell.max() < len(self.index)):
            raise BadInput(f"cells are 0..{len(self.index) - 1}, or -1 for none", "cell")
        index = np.where(cell >= 0, self.index[cell], -1)
        u = np.where(index[:, None] >= 0, self.vectors[index], np.nan)
        if self.local is not None and x is not None:
            if np.shape(x) != (len(cell), self.partition.dimension):
                raise BadInput(f"{len(cell)} cells, but states of shape {np.shape(x)}", "x")
            inside = (cell >= 0) & self.local.attractor[cell]
            u[inside] = self.local(x[inside], cell[inside])
        return u


class Interpolated:
    """The controller made continuous within branches: barycentric between the centres of cells.

    Centres of another branch than the cell of the state, or without control, are left out; the
    weights of the rest are scaled to sum 1. Two cells are of one branch where no control differs by
    more than JUMP of its range. It is asked as the controller is; the local feedback stays.
    """

    mode: Law = "interpolated"

    def __init__(self, controller: Controller) -> None:
        self.controller, self.partition = controller, controller.partition
        self.vectors, self.index = controller.vectors, controller.index
        self.local = controller.local
        self.low, self.high = self.vectors.min(axis=0), self.vectors.max(axis=0)

    def law(self, mode: Law) -> "Controller | Interpolated":
        """See :meth:`Controller.law`."""
        return self if mode == self.mode else self.controller.law(mode)

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
        moved, total = np.zeros_like(own), np.zeros(len(x))
        for cells, weight in corners(self.partition, x):
            index = self.index[cells]
            away = self.vectors[index] - own
            near = (np.abs(away) <= JUMP * (self.high - self.low)).all(axis=1)
            kept = np.where((index >= 0) & near, weight, 0.0)
            moved += kept[:, None] * away
            total += kept
        moved /= np.where(total > 0, total, 1.0)[:, None]
        u: Floats = np.clip(own + moved, self.low, self.high)
        return u

"""The feedback controller, and closed-loop simulation of the true map."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lmdsl.common import inputs
from lmdsl.common.records import Frozen
from lmdsl.common.types import Floats, Indices
from lmdsl.control.interpolated import Interpolated
from lmdsl.errors import BadInput, shown
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController

Law = Literal["constant", "interpolated"]


@dataclass(frozen=True, eq=False)
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
            of one branch, see :mod:`lmdsl.control.interpolated`: the certificate does not speak
            of that.

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

"""Orders in which sweeps visit the cells: along every axis of the box, in both directions.

A Gauss-Seidel sweep carries values all the way in the direction in which it visits the cells, and a
cell or two in others. What it costs to get to A, in a controlled system, goes against its flow,
which turns: a pendulum swings through all four quadrants of its plane. Sweeps in every combination
of directions, one after the other, follow it ("fast sweeping", Zhao, Math. Comp. 74, 2005).
From one sweep to the next a single axis turns, the first axis first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.machine.forking import cached_property

# Number of axes besides the first above which only the last ones are visited in both directions.
# More directions take more memory, and each sweep longer: cells are read less in a row.
MOST_FLIPPED = 2

# Share of the cells, one in so many, above which they are picked from the orders of all cells.
FEW = 4


@dataclass(frozen=True, eq=False)
class Directions:
    """The orders of some cells of a box."""

    cells: NDArray[np.integer[Any]]  # their indices in the box, ascending, shape (n,)
    shape: tuple[int, ...]  # cells per axis
    # the combinations follow each other the other way round, as transposed systems want it
    against: bool = False
    # whole, chosen: the cells of which these are some, and their positions there
    whole: Directions | None = None
    chosen: NDArray[np.integer[Any]] | None = None

    @classmethod
    def line(cls, n: int) -> Directions:
        """Return the orders of n cells of which nothing more is known: up and down."""
        return cls(np.arange(n), (n,))

    def among(self, chosen: NDArray[np.integer[Any]]) -> Directions:
        """Return the orders of some of the cells, given by ascending positions."""
        return Directions(self.cells[chosen], self.shape, self.against, self, chosen)

    def reversed(self) -> Directions:
        """Return the same orders, following each other the other way round."""
        other = replace(self, against=not self.against)
        if "orders" in vars(self):
            vars(other)["orders"] = self.orders
        return other

    @cached_property
    def orders(self) -> NDArray[np.uint32]:
        """Positions of the cells, one row per combination of the axes after the first.

        Downwards, an order is that of the opposite combination with the first axis turned too.
        """
        n, axes = len(self.cells), self._flipped
        orders = np.empty((2 ** len(axes), n), dtype=np.uint32)
        if self.whole is not None and self.chosen is not None and FEW * n > len(self.whole.cells):
            number = np.full(len(self.whole.cells), n, dtype=np.uint32)
            number[self.chosen] = np.arange(n, dtype=np.uint32)
            for k, order in enumerate(self.whole.orders):
                found = number[order]
                orders[k] = found[found < n]
            return orders
        orders[0] = np.arange(n)
        for k in range(1, len(orders)):
            index, stride = self.cells.copy(), 1
            for axis in reversed(range(len(self.shape))):
                count = self.shape[axis]
                if axis in axes and k >> axes.index(axis) & 1:
                    index += (count - 1 - 2 * (self.cells // stride % count)) * stride
                stride *= count
            orders[k] = np.argsort(index, kind="stable")  # lines of cells, turned: nearly sorted
        return orders

    @cached_property
    def in_halves(self) -> NDArray[np.uint32]:
        """The same orders of the first half of the cells, then of the second."""
        middle = len(self.cells) // 2
        return np.array([
            np.concatenate([order[order < middle], order[order >= middle]])
            for order in self.orders
        ])  # fmt: skip

    @cached_property
    def cycle(self) -> Indices:
        """Order and whether it is taken downwards, for every sweep of a cycle, shape (2 m, 2)."""
        m = 2 ** len(self._flipped)
        steps = np.arange(2 * m)
        if self.against:
            steps = -steps % (2 * m)
        gray = steps ^ (steps >> 1)
        down, turned = gray & 1, gray >> 1
        return np.stack([np.where(down == 1, m - 1 - turned, turned), down], axis=1)

    @property
    def _flipped(self) -> range:
        axes = len(self.shape)
        return range(max(1, axes - MOST_FLIPPED), axes)

"""The system of a policy, x = b + gamma P_u x: rows of the model made ready for sweeps."""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices, Policy
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.grid.directions import Directions
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.rows import RowArrays, Rows, over_rows
from lmdsl.optimize.linear.gauss_seidel import NEVER, SplitArrays, SplitMatrix


class SlotArrays(NamedTuple):
    """The row copied for each cell, all rows, and the system, as compiled loops use them."""

    copied: NDArray[np.uint64]
    rows: RowArrays
    columns: np.uint32
    gamma: float
    system: SplitArrays


class Slots:
    """Arrays for the system of a policy: as it changes, only the rows that differ are copied.

    Parameters
    ----------
    rows
        The rows of all pairs.
    capacity
        Largest number of entries that the row of each cell may have, shape (n,).
    gamma
        Weight of the rows.
    directions
        Orders in which sweeps visit the cells.
    """

    def __init__(self, rows: Rows, capacity: Indices, gamma: float, directions: Directions) -> None:
        self.rows, self.gamma = rows, gamma
        ends = np.cumsum(capacity)
        count, entries = len(capacity), int(ends[-1]) if len(capacity) else 0
        self.chosen = np.full(count, rows.count, dtype=np.uint64)  # none
        self.current = SplitMatrix(
            (ends - capacity).view(np.uint64),
            np.empty(count, dtype=np.uint64),
            np.empty(entries, dtype=np.uint32),
            np.empty(entries),
            np.empty(count),
            directions,
        )

    @classmethod
    def of(cls, rows: Rows, pair_pointer: Indices, gamma: float, directions: Directions) -> Self:
        """Allocate for any policy, a pair of each cell's own."""
        capacity = np.empty(len(pair_pointer) - 1, dtype=np.int64)
        pairs = pair_pointer.view(np.uint64)
        over_rows(len(capacity), _longest, pairs, rows.kernel.pointer, capacity)
        return cls(rows, capacity, gamma, directions)

    def system(self, chosen: Indices) -> SplitMatrix:
        """Return gamma P for one row of each cell; it holds until the next call."""
        over_rows(len(chosen), _fill, chosen.view(np.uint64), self.kernel)
        return self.current

    @property
    def kernel(self) -> SlotArrays:
        """The arrays as compiled loops use them."""
        columns = np.uint32(self.rows.columns)
        return SlotArrays(self.chosen, self.rows.kernel, columns, self.gamma, self.current.kernel)


@kernel
def _longest(first, last, pair_pointer, pointer, capacity):  # type: ignore[no-untyped-def]
    """Find the largest number of entries among the rows of each cell."""
    for i in range(np.uint64(first), np.uint64(last)):
        most = np.uint64(0)
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            length = pointer[k + ONE] - pointer[k]
            most = length if length > most else most
        capacity[i] = most


@kernel
def _fill(first, last, chosen, slots):  # type: ignore[no-untyped-def]
    for r in range(np.uint64(first), np.uint64(last)):
        if chosen[r] != slots.copied[r]:
            copy_row(r, chosen[r], slots)


@kernel
def copy_row(r, k, slots):  # type: ignore[no-untyped-def]
    """Copy row k as row r of the system: the diagonal apart, without the attractor's share."""
    copied, (pointer, target, code, share), columns, gamma, system = slots
    begin, end, indices, data, inverse = system
    copied[r] = k
    own, used = 0.0, begin[r]
    for e in range(pointer[k], pointer[k + ONE]):
        j = target[e]
        if j == r:
            own += gamma * share[code[e]]
        elif j < columns:
            indices[used] = j
            data[used] = gamma * share[code[e]]
            used += ONE
    inverse[r] = 1.0 / (1.0 - own) if own < 1.0 else NEVER
    end[r] = used


def of_policy(lp: StabilizationLP, policy: Policy, gamma: float) -> SplitMatrix:
    """Return gamma P_u for a policy, ready for sweeps."""
    rows = lp.rows
    capacity = rows.pointer[policy + 1] - rows.pointer[policy]
    return Slots(rows, capacity, gamma, lp._directions).system(policy)

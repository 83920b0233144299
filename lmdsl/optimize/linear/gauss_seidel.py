"""Gauss-Seidel sweeps on x = b + M x for a nonnegative sparse M.

Staying put is summed up at once: x_i = (b_i + sum over j != i of M_ij x_j) / (1 - M_ii).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats
from lmdsl.machine import threads
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.grid.directions import Directions

TOLERANCE = 2e-15  # relative change up to which a sweep counts as none
CEILING = 1e305  # value above which a component counts as infinite
NEVER = 1e308  # in place of 1 / (1 - M_ii) where M_ii >= 1
PARALLEL_FROM = 100_000  # number of components from which on two threads sweep


class SplitArrays(NamedTuple):
    """The arrays of a :class:`SplitMatrix`, as compiled loops take them."""

    begin: NDArray[np.uint64]
    end: NDArray[np.uint64]
    indices: NDArray[np.uint32]
    data: Floats
    inverse: Floats


@dataclass(frozen=True, eq=False)
class SplitMatrix:
    """A matrix M with its diagonal apart."""

    # begin, end, indices, data: the rows of M without its diagonal: row i is ``begin[i]:end[i]``
    begin: NDArray[np.uint64]
    end: NDArray[np.uint64]
    indices: NDArray[np.uint32]
    data: Floats
    inverse: Floats  # 1 / (1 - M_ii), huge where M_ii >= 1: no finite x_i > 0 satisfies such a row
    directions: Directions  # orders in which sweeps visit the components

    @property
    def kernel(self) -> SplitArrays:
        """The arrays as compiled loops take them."""
        return SplitArrays(self.begin, self.end, self.indices, self.data, self.inverse)

    @classmethod
    def of(cls, M: Any) -> Self:
        """Split a CSR array."""
        n, entries = M.shape[0], len(M.data)
        end = np.empty(n, dtype=np.uint64)
        indices, data = np.empty(entries, dtype=np.uint32), np.empty(entries)
        inverse = np.empty(n)
        begin = M.indptr[:-1].astype(np.uint64)
        _split(M.indptr, M.indices, M.data, end, indices, data, inverse)
        return cls(begin, end, indices, data, inverse, Directions.line(n))

    def transposed(self) -> "SplitMatrix":
        """Return the transposed matrix."""
        count = np.zeros(len(self.begin) + 1, dtype=np.uint64)
        _count(self.begin, self.end, self.indices, count)
        start = np.cumsum(count)
        entries = int(start[-1])
        indices, data = np.empty(entries, dtype=np.uint32), np.empty(entries)
        end = start[:-1].copy()
        _turn(self.begin, self.end, self.indices, self.data, end, indices, data)
        return SplitMatrix(start[:-1], end, indices, data, self.inverse, self.directions.reversed())

    def residual(self, b: Floats, x: Floats) -> Floats:
        """Return (b + M x - x) / (1 - own), own the diagonal of M."""
        return self.inverse * (b + self.times(x)) - x

    def times(self, x: Floats) -> Floats:
        """Return M x without the diagonal of M."""
        out = np.empty(len(x))
        _times(self.begin, self.end, self.indices, self.data, x, out)
        return out

    def sweep(
        self, b: Floats, x: Floats, count: int, enough: float = TOLERANCE, flat: float = 0.0
    ) -> tuple[float, float]:
        """Make Gauss-Seidel sweeps for x = b + M x in place; see :func:`_gauss_seidel`."""
        if len(x) >= PARALLEL_FROM:  # by size alone: the result does not depend on the threads
            return _in_halves(self, b, x, count, enough, flat)
        orders, cycle = self.directions.orders, self.directions.cycle
        halfway, last = _gauss_seidel(self.kernel, orders, cycle, b, x, count, enough, flat)
        return float(halfway), float(last)


@kernel
def _split(indptr, indices, data, end, out_indices, out_data, inverse):  # type: ignore[no-untyped-def]
    for i in range(len(inverse)):
        own, used = 0.0, indptr[i]
        for e in range(indptr[i], indptr[i + 1]):
            if indices[e] == i:
                own += data[e]
            else:
                out_indices[used] = indices[e]
                out_data[used] = data[e]
                used += 1
        inverse[i] = 1.0 / (1.0 - own) if own < 1.0 else NEVER
        end[i] = used


@kernel
def _count(begin, end, indices, count):  # type: ignore[no-untyped-def]
    for i in range(len(begin)):
        for e in range(begin[i], end[i]):
            count[indices[e] + ONE] += ONE


@kernel
def _turn(begin, end, indices, data, used, out_indices, out_data):  # type: ignore[no-untyped-def]
    """Write every entry of row i and column j into row j; ``used`` is where each row goes on."""
    for i in range(np.uint64(len(begin))):
        for e in range(begin[i], end[i]):
            j = indices[e]
            out_indices[used[j]] = i
            out_data[used[j]] = data[e]
            used[j] += ONE


@kernel
def _times(begin, end, indices, data, x, out):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(len(begin))):
        y = 0.0
        for e in range(begin[i], end[i]):
            y += data[e] * x[indices[e]]
        out[i] = y


@kernel
def _gauss_seidel(system, orders, cycle, b, x, count, enough, flat):  # type: ignore[no-untyped-def]
    """Sweep over the components, in all directions in turn, using each as soon as known.

    Staying put is summed up at once, so a chain of slow cells takes one sweep in its direction.
    From x >= b + M x every sweep lowers x, from below it raises it. Returns the largest relative
    change of the sweep halfway and of the last one; ends early where that is at most ``enough``,
    where no component moved by more than ``flat`` (and calls the change 0), or where x is no longer
    finite.
    """
    halfway, change, top = np.inf, np.inf, 0.0
    for sweep in range(count):
        measured = sweep % 4 == 3 or sweep == count // 2 or sweep == count - 1
        turn = sweep % len(cycle)
        order, downwards = orders[cycle[turn, 0]], cycle[turn, 1] == 1
        moved, most, highest = _sweep(
            0, len(b), system, b, x, x, order, downwards, measured, top
        )  # fmt: skip
        if measured:
            change, top = moved, highest
            if not top < CEILING:
                return halfway, np.inf
            if sweep == count // 2:
                halfway = change
            if change <= enough:
                break
            if most <= flat:
                return halfway, 0.0
    return halfway, change


@kernel
def _sweep(first, last, system, b, old, x, order, downwards, measured, top):  # type: ignore[no-untyped-def]
    """Sweep over a range, in some order: ``x`` inside it, ``old`` outside; ``top`` was the largest.

    Returns the largest relative change, the largest absolute one, and the largest component.
    """
    begin, end, indices, data, inverse = system
    floor, change, most, highest = 1e-14 * top + 1e-300, 0.0, 0.0, 0.0
    first, last = np.uint64(first), np.uint64(last)
    alone = first == np.uint64(0) and last == np.uint64(len(b))
    for t in range(last - first):
        i = np.uint64(order[last - first - ONE - t if downwards else t])
        y = b[i]
        if alone:
            for e in range(begin[i], end[i]):
                y += data[e] * x[indices[e]]
        else:
            for e in range(begin[i], end[i]):
                j = indices[e]
                y += data[e] * (x[j] if first <= j < last else old[j])
        y *= inverse[i]
        if measured:
            moved = abs(y - x[i])
            size = floor if floor > y else y
            if moved > change * size:
                change = moved / size
            most = moved if moved > most else most
            highest = y if y > highest else highest
        x[i] = y
    return change, most, highest


def _in_halves(
    system: SplitMatrix, b: Floats, x: Floats, count: int, enough: float, flat: float
) -> tuple[float, float]:
    """Make the same sweeps in two halves at a time, each with the other's last values."""
    n = len(x)
    cycle, orders = system.directions.cycle, system.directions.in_halves
    halves = (0, n // 2), (n // 2, n)
    halfway, change, top = np.inf, np.inf, 0.0
    now, then = x.copy(), x

    def half(task: tuple[int, int, bool, float, Floats, Floats]) -> Any:
        part, sweep, measured, highest, old, new = task
        first, last = halves[part]
        new[first:last] = old[first:last]
        order, downwards = cycle[sweep % len(cycle)]
        return _sweep(
            first, last, system.kernel, b, old, new,
            orders[order, first:last], downwards == 1, measured, highest,
        )  # fmt: skip

    for sweep in range(count):
        measured = sweep % 4 == 3 or sweep == count // 2 or sweep == count - 1
        now, then = then, now
        tasks = [(part, sweep, measured, top, now, then) for part in range(2)]
        found = threads.each(half, tasks)
        if not measured:
            continue
        change, most, top = (max(part[k] for part in found) for k in range(3))
        if not top < CEILING:
            change = np.inf
            break
        if sweep == count // 2:
            halfway = change
        if change <= enough:
            break
        if most <= flat:
            change = 0.0
            break
    x[:] = then
    return halfway, change

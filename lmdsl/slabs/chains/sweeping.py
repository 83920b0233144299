"""The system of a policy over ranks: x = b + M x by sweeps and a Krylov method, no rank has it all.

A sweep visits the cells of every range of the model in the orders of one process; within a range
new values are used at once, of other ranges those from before the sweep. So a sweep is the same to
the bit for every number of ranks that divides the ranges. It needs the ghosts that the policy's
rows name, and these are the halo. Sums over cells are folded range by range.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.directions import Directions
from lmdsl.optimize.linear import extrapolation
from lmdsl.optimize.linear.equations import (
    FEW_SWEEPS,
    KRYLOV_STEPS,
    KRYLOV_SWEEPS,
    MAX_SWEEPS,
    TRIAL_SWEEPS,
    _soon,
)
from lmdsl.optimize.linear.gauss_seidel import CEILING, NEVER, TOLERANCE, SplitMatrix, _sweep
from lmdsl.ranks.mesh import Halo, Mesh
from lmdsl.ranks.verbs import Ranks

MOST_RISING = 2  # trials in a row in which sweeps do not come closer, after which none is in sight


@dataclass(frozen=True, eq=False)
class SpreadSystem:
    """The rows of own cells of a nonnegative M, in local numbers.

    Attributes
    ----------
    mesh, halo
        Own cells and ghosts, and the plan of those that the rows name.
    system
        The rows, as they are swept.
    orders
        Of every own range: first cell, the one after the last, and the orders of its cells.
    cycle
        Order and direction of every sweep of a cycle.
    """

    mesh: Mesh
    halo: Halo
    system: SplitMatrix
    orders: list[tuple[int, int, NDArray[np.uint32]]]
    cycle: Indices

    @classmethod
    def of(
        cls, mesh: Mesh, system: SplitMatrix, cells: Indices, shape: tuple[int, ...],
        against: bool = False,
    ) -> Self:  # fmt: skip
        """Make a system ready; ``cells`` are the own ones by their index in a box. Collective."""
        first, _ = mesh.division.own(mesh.ranks.rank)
        orders = []
        for a, b in mesh.division.own_ranges(mesh.ranks.rank):
            own = Directions(cells[a - first : b - first], shape).orders
            orders.append((a - first, b - first, own + np.uint32(a - first)))
        cycle = Directions(cells[:0], shape, against).cycle
        used = np.zeros(mesh.columns, dtype=np.bool_)
        _mark(system.kernel, used)
        return cls(mesh, mesh.narrowed(used), system, orders, cycle)

    @property
    def ranks(self) -> Ranks:
        """Who talks."""
        return self.mesh.ranks

    def sweep(
        self, b: Floats, x: Floats, count: int, enough: float = TOLERANCE, flat: float = 0.0
    ) -> tuple[float, float]:
        """Make Gauss-Seidel sweeps on own values in place; see :meth:`SplitMatrix.sweep`.

        They are not measured where ``enough`` is negative.
        """
        now = self.mesh.spread(x, 0.0, self.halo)
        then, halfway, change, top = now.copy(), np.inf, np.inf, 0.0
        for sweep in range(count):
            measured = enough >= 0 and (sweep % 4 == 3 or sweep == count // 2 or sweep == count - 1)
            order, downwards = self.cycle[sweep % len(self.cycle)]
            found = [(0.0, 0.0, 0.0)]
            then[len(x) :] = now[len(x) :]  # the ghosts: a range that is alone reads them there
            for first, last, orders in self.orders:
                then[first:last] = now[first:last]
                found.append(
                    _sweep(first, last, self.system.kernel, b, now, then, orders[order],
                           downwards == 1, measured, top)
                )  # fmt: skip
            self.halo.fill(then)
            now, then = then, now
            if not measured:
                then[: len(x)] = now[: len(x)]
                continue
            every = self.ranks.collect([max(part[k] for part in found) for k in range(3)])
            change, most, top = (max(own[k] for own in every) for k in range(3))
            if not top < CEILING:
                change = np.inf
                break
            halfway = change if sweep == count // 2 else halfway
            if change <= enough or most <= flat:
                change = change if change <= enough else 0.0
                break
        x[:] = now[: len(x)]
        return float(halfway), float(change)

    def solve(self, b: Floats, x: Floats, time_up: TimeUp, flat: float = 0.0) -> Floats | None:
        """Return x >= 0 with x = b + M x from a guess, None where none is in sight; collective."""
        x = np.where(self.positive(b), x, 0.0)
        change, rate = self._trial(b, x, flat)
        if change > TOLERANCE and rate < 1 and not _soon(change, rate, FEW_SWEEPS):
            guess = self.krylov(b, x, time_up)
            if guess is not None:
                x = np.where(self.positive(b), guess, 0.0)
                change, rate = self._trial(b, x, flat)
        rising = 0
        for _ in range(MAX_SWEEPS // TRIAL_SWEEPS):
            if change <= TOLERANCE:
                return x
            rising = rising + 1 if rate >= 1 else 0
            if not change < np.inf or rising > MOST_RISING:
                return None
            if time_up():
                raise Stopped
            change, rate = self._trial(b, x, flat)
        return None

    def _trial(self, b: Floats, x: Floats, flat: float) -> tuple[float, float]:
        halfway, last = self.sweep(b, x, TRIAL_SWEEPS, TOLERANCE, flat)
        return last, (last / halfway) ** (2 / TRIAL_SWEEPS) if 0 < halfway < np.inf else 0.0

    def positive(self, b: Floats) -> Bools:
        """Return where x > 0: the cells from which some b > 0 can be reached. Collective."""
        found = b > 0
        if self.ranks.all(bool(found.all())):
            return found
        begin, end, indices, _, _ = self.system.kernel
        entry = np.repeat(np.arange(len(b)), (end - begin).astype(np.int64))
        at = np.repeat((begin - np.append(0, np.cumsum(end - begin))[:-1]).astype(np.int64),
                       (end - begin).astype(np.int64)) + np.arange(len(entry))  # fmt: skip
        target = indices[at]
        while True:
            known = self.mesh.spread(found, False, self.halo)
            more = found | (np.bincount(entry, known[target], len(b)) > 0)
            news, found = bool((more != found).any()), more
            if not self.ranks.any(news):
                return found

    def krylov(self, b: Floats, x: Floats, time_up: TimeUp) -> Floats | None:
        """Return a better guess by BiCGSTAB on cycles of sweeps, None where it breaks down."""
        ranks, count, zero = self.ranks, len(self.cycle), np.zeros(len(b))

        def swept(c: Floats, v: Floats) -> Floats:
            v = v.copy()
            self.sweep(c, v, count, enough=-1.0, flat=-1.0)
            return v

        inverse = self.system.inverse
        if ranks.any(bool((inverse >= NEVER).any())):
            return None
        with np.errstate(all="ignore"):
            unit = max(ranks.collect(float((inverse * b).max(initial=0.0))))
            if not 0 < unit < CEILING:
                return None
            known, steps = swept(b / unit, zero), min(KRYLOV_STEPS, KRYLOV_SWEEPS // (2 * count))
            y = extrapolation.bicgstab(
                lambda v: v - swept(zero, v), known, x / unit, steps, time_up, 1e-13,
                self.dot, ranks.any,
            )  # fmt: skip
            guess = np.maximum(unit * y, b)
            ends = ranks.collect((float(y.min(initial=0.0)), float(y.max(initial=0.0))))
            low, high = min(a for a, _ in ends), max(b for _, b in ends)
            bad = not (guess < CEILING).all() or low < -1e-9 * high
        return None if ranks.any(bad) else guess

    def dot(self, u: Floats, v: Floats) -> Any:
        """Return u'v over all cells, folded range by range."""
        parts = [float((u[a:b] * v[a:b]).sum()) for a, b, _ in self.orders]
        return np.float64(self.ranks.reduce(parts, lambda p, q: p + q, 0.0))

    def transposed(self, cells: Indices, shape: tuple[int, ...]) -> "SpreadSystem":
        """Return the system of M': every rank sends its entries to the owners of their columns."""
        mesh, (begin, end, indices, data, inverse) = self.mesh, self.system.kernel
        length = (end - begin).astype(np.int64)
        row = np.repeat(np.arange(len(length)), length)
        at = np.arange(len(row)) + np.repeat(
            begin.astype(np.int64) - np.append(0, np.cumsum(length))[:-1], length
        )
        source, column = mesh.numbers[row], mesh.numbers[indices[at]]
        owner = mesh.division.owner(column)
        to = [int(k) for k in np.unique(owner)]
        came = [
            self.ranks.exchange({k: array[owner == k] for k in to})
            for array in (column, source, data[at])
        ]
        column, source, value = (np.concatenate([*each.values(), []]) for each in came)
        column, source = column.astype(np.int64), source.astype(np.int64)
        order = np.lexsort((source, column))
        column, source, value = column[order], source[order], value[order]
        turned = Mesh.of(self.ranks, mesh.division, source)
        first, last = mesh.division.own(self.ranks.rank)
        pointer = np.searchsorted(column, np.arange(first, last + 1)).astype(np.uint64)
        rows = SplitMatrix(
            pointer[:-1].copy(), pointer[1:].copy(), turned.local(source).astype(np.uint32), value,
            inverse, self.system.directions.reversed(),
        )  # fmt: skip
        return SpreadSystem.of(turned, rows, cells, shape, against=True)


@kernel
def _mark(system, used):  # type: ignore[no-untyped-def]
    """Mark the cells that rows name."""
    begin, end, indices = system.begin, system.end, system.indices
    for i in range(np.uint64(len(begin))):
        for e in range(begin[i], end[i]):
            used[indices[e]] = True

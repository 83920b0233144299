"""The core of a chain over ranks: what has cycles, as a rule a small part of all cells.

Up to some size rank 0 gets its rows and solves it with the code of one process, whatever the number
of ranks to the same bits. Beyond, all ranks sweep it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, TimeUp, never
from lmdsl.model.grid.directions import Directions
from lmdsl.optimize.linear import equations
from lmdsl.optimize.linear.gauss_seidel import NEVER, SplitMatrix
from lmdsl.optimize.linear.substitution import _take
from lmdsl.ranks.mesh import Halo, Mesh
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import Ranks, Together
from lmdsl.slabs.chains.sweeping import SpreadSystem


class Core(Protocol):
    """A system of which each rank has some cells; every method is collective."""

    def solve(self, b: Floats, x: Floats, time_up: TimeUp) -> Floats | None:
        """Return x >= 0 with x = b + M x from a guess; None where none is in sight."""

    def solve_transposed(self, b: Floats, time_up: TimeUp, flat: float) -> Floats | None:
        """Return x >= 0 with x = b + M'x; None where none is in sight."""

    def advance(self, b: Floats, x: Floats, count: int, flat: float) -> float:
        """Come closer to x = b + M x in place, by about the work of some sweeps of all cells."""


@dataclass(frozen=True, eq=False)
class CoreRows:
    """The rows of the own cells of a core, its cells numbered over all ranks."""

    division: Division
    pointer: NDArray[np.uint64]
    indices: NDArray[np.uint32]
    data: Floats
    inverse: Floats
    cells: Indices  # by their index in a box

    @classmethod
    def of(
        cls, mesh: Mesh, system: SplitMatrix, core: Bools, crossing: Halo, cells: Indices
    ) -> Self:
        """Take them from a system; ``crossing`` is the plan of core cells. Collective."""
        division = mesh.division.within(mesh.ranks, core)
        rows = np.flatnonzero(core).astype(np.uint32)
        number = np.zeros(mesh.columns, dtype=np.uint32)
        number[rows] = division.own(mesh.ranks.rank)[0] + np.arange(len(rows))
        crossing.fill(number)
        length = system.end[rows] - system.begin[rows]
        pointer = np.append(0, np.cumsum(length)).astype(np.uint64)
        indices, data = np.empty(int(pointer[-1]), dtype=np.uint32), np.empty(int(pointer[-1]))
        _take(rows, system.begin, system.end, system.indices, system.data, number, indices, data)
        return cls(division, pointer, indices, data, system.inverse[rows], cells[core])

    def system(self, cells: Indices, shape: tuple[int, ...]) -> SplitMatrix:
        """Return them ready for sweeps."""
        return SplitMatrix(
            self.pointer[:-1].copy(), self.pointer[1:].copy(), self.indices, self.data,
            self.inverse, Directions(cells, shape),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class GatheredCore:
    """A core that rank 0 has, and solves."""

    ranks: Ranks
    division: Division
    system: SplitMatrix | None  # on rank 0
    share: int  # number of all cells for each of the core

    @classmethod
    def of(cls, ranks: Ranks, rows: CoreRows, shape: tuple[int, ...], among: int) -> Self:
        """Gather the rows on rank 0; ``among`` is the number of all cells. Collective."""
        length = np.diff(rows.pointer).astype(np.uint32)
        whole = ranks.exchange({0: np.concatenate([length, rows.indices])})
        values = ranks.exchange({0: np.concatenate([rows.inverse, rows.cells, rows.data])})
        division = rows.division
        share = among // max(division.cells, 1)
        if ranks.rank:
            return cls(ranks, division, None, share)
        own = np.diff(division.starts).tolist()
        lengths = np.concatenate([whole[k][:n] for k, n in enumerate(own)])
        gathered = CoreRows(
            division,
            np.append(0, np.cumsum(lengths, dtype=np.int64)).astype(np.uint64),
            np.concatenate([whole[k][n:] for k, n in enumerate(own)]),
            np.concatenate([values[k][2 * n :] for k, n in enumerate(own)]),
            np.concatenate([values[k][:n] for k, n in enumerate(own)]),
            np.concatenate([values[k][n : 2 * n] for k, n in enumerate(own)]).astype(np.int64),
        )
        return cls(ranks, division, gathered.system(gathered.cells, shape), share)

    def solve(self, b: Floats, x: Floats, time_up: TimeUp) -> Floats | None:
        """Return x >= 0 with x = b + M x from a guess; None where none is in sight."""
        alone = time_up.own if isinstance(time_up, Together) else never

        def work(system: SplitMatrix, b: Floats, x: Floats) -> tuple[Floats | None, float]:
            return equations._solve(system, b, x, lambda: _matrix(system), 0.0, alone), 0.0

        return self._asked([b, x], work)[0]

    def solve_transposed(self, b: Floats, time_up: TimeUp, flat: float) -> Floats | None:
        """Return x >= 0 with x = b + M'x; None where none is in sight."""
        alone = time_up.own if isinstance(time_up, Together) else never

        def work(system: SplitMatrix, b: Floats) -> tuple[Floats | None, float]:
            turned = system.transposed()
            found = equations._solve(turned, b, b.copy(), lambda: _matrix(turned), flat, alone)
            return found, 0.0

        return self._asked([b], work)[0]

    def advance(self, b: Floats, x: Floats, count: int, flat: float) -> float:
        """Come closer to x = b + M x in place, by about the work of some sweeps of all cells."""
        sweeps = count * min(max(self.share, 1), equations.PER_CORE)

        def work(system: SplitMatrix, b: Floats, x: Floats) -> tuple[Floats | None, float]:
            change = system.sweep(b, x, sweeps, flat=flat)[1]
            return (x, change) if change < np.inf else (None, change)

        found, change = self._asked([b, x], work)
        if found is None:
            return np.inf
        x[:] = found
        return change

    def _asked(
        self, arrays: list[Floats], work: Callable[..., tuple[Floats | None, float]]
    ) -> tuple[Floats | None, float]:
        """Let rank 0 work on vectors, and return the own part of what it finds, and a number."""
        ranks = self.ranks
        came = ranks.exchange({0: np.concatenate(arrays)})

        def here() -> tuple[Floats | None, float]:
            parts = [came[k].reshape(len(arrays), -1) for k in range(ranks.count)]
            assert self.system is not None
            return work(self.system, *np.concatenate(parts, axis=1))

        found = ranks.agreed(lambda: None if ranks.rank else here())
        told = None
        if found is not None:
            y, change = found
            cuts = self.division.starts[1:-1]
            own = [np.empty(0)] * ranks.count if y is None else np.split(y, cuts)
            told = [np.append(part, [change] * (y is not None)) for part in own]
        mine = ranks.scatter(told)
        return (mine[:-1], float(mine[-1])) if len(mine) else (None, np.inf)


@dataclass(frozen=True, eq=False)
class SweptCore:
    """A core that all ranks sweep."""

    system: SpreadSystem
    cells: Indices
    shape: tuple[int, ...]

    @classmethod
    def of(cls, ranks: Ranks, rows: CoreRows, shape: tuple[int, ...]) -> Self:
        """Return a core for sweeps; collective."""
        mesh = Mesh.of(ranks, rows.division, rows.indices)
        local = mesh.local(rows.indices).astype(np.uint32)
        own = CoreRows(rows.division, rows.pointer, local, rows.data, rows.inverse, rows.cells)
        system = SpreadSystem.of(mesh, own.system(rows.cells, shape), rows.cells, shape)
        return cls(system, rows.cells, shape)

    def solve(self, b: Floats, x: Floats, time_up: TimeUp) -> Floats | None:
        """Return x >= 0 with x = b + M x from a guess; None where none is in sight."""
        found = self.system.solve(b, x, time_up)
        if found is not None:  # sweeps end where they hardly change it, which is not the end
            self.system.sweep(b, found, equations.TRIAL_SWEEPS, 0.0)
        return found

    def solve_transposed(self, b: Floats, time_up: TimeUp, flat: float) -> Floats | None:
        """Return x >= 0 with x = b + M'x; None where none is in sight."""
        turned = self.system.transposed(self.cells, self.shape)
        return turned.solve(b, b.copy(), time_up, flat)

    def advance(self, b: Floats, x: Floats, count: int, flat: float) -> float:
        """Come closer to x = b + M x in place, by some sweeps."""
        return self.system.sweep(b, x, count, 0.0, flat)[1]


def _matrix(system: SplitMatrix) -> Any:
    """Return M of a system whose rows follow each other."""
    from scipy.sparse import csr_array, diags_array

    n = len(system.begin)
    pointer = np.append(system.begin, system.end[-1:]).astype(np.int64)
    own = np.where(system.inverse >= NEVER, 1.0, 1 - 1 / system.inverse)
    others = csr_array((system.data, system.indices.astype(np.int64), pointer), shape=(n, n))
    return (others + diags_array(own)).tocsr()

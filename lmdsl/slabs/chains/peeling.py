"""The part of a system without cycles over ranks: by substitution, in few rounds of messages.

As in ``optimize/linear/substitution.py`` cells to which none leads are taken away, then those to
which only these lead, and so on; what is left is the core. Which cells these are does not depend on
the order, so each rank goes as far as it can with what it knows, and then all tell each other: a
*round* for each time that a way crosses from rank to rank, not one for each level. An owner is told
of its cell once by every rank whose cells lead to it, when the last of these is gone.

Values come the other way. A cell of a round leads to own cells that are later in the order, and to
cells of others that are of later rounds, or to the core: so with one message between two rounds, of
the values of the cells of a round, each is made once, in the order of the rounds turned round. It
is the same formula of the values that a cell leads to whenever it is made: the same bits. Of the
transposed system values flow with the rounds, what flows to cells of others is added by them, and
the core comes last.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, TimeUp
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.linear.gauss_seidel import SplitMatrix
from lmdsl.optimize.linear.policy_system import of_policy
from lmdsl.optimize.linear.substitution import BYTE, FAR, WORD, CellNumbers, _back, _down
from lmdsl.ranks.mesh import Halo, Mesh
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs.chains.core import Core, CoreRows, GatheredCore, SweptCore

MOST_CORE = 10**6  # cells of a core up to which rank 0 solves it


@dataclass(frozen=True, eq=False)
class SpreadPeeled:
    """A system over ranks and its core.

    Attributes
    ----------
    mesh, system
        Own cells and ghosts, and the rows of own cells.
    order, ends
        Own cells outside the core, each before all it leads to; where each round ends.
    crossing
        The plan of the ghosts of every round, and that of those in the core.
    core
        Which own cells are the core, shape (own,).
    inner
        The system of the core; None where no rank has any of it.
    """

    mesh: Mesh
    system: SplitMatrix
    order: CellNumbers
    ends: list[int]
    crossing: list[Halo]
    core: Bools
    inner: Core | None

    @classmethod
    def of(cls, mesh: Mesh, system: SplitMatrix, cells: Indices, shape: tuple[int, ...]) -> Self:
        """Find the core; ``cells`` are the own ones by their index in a box. Collective."""
        order, ends, crossing = _rounds(mesh, system)
        core = np.ones(mesh.own, dtype=np.bool_)
        core[order] = False
        rows = CoreRows.of(mesh, system, core, crossing[-1], cells)
        inner: Core | None = None
        size = rows.division.cells
        if 0 < size <= MOST_CORE:
            inner = GatheredCore.of(mesh.ranks, rows, shape, mesh.division.cells)
        elif size:
            inner = SweptCore.of(mesh.ranks, rows, shape)
        return cls(mesh, system, order, ends, crossing, core, inner)

    @classmethod
    def of_chain(
        cls, lp: StabilizationLP, policy: Indices, gamma: float, system: SplitMatrix | None = None
    ) -> Self:
        """Return gamma P_u for a policy of own columns, made where it is not given; collective."""
        assert lp.mesh is not None
        system = of_policy(lp, policy, gamma) if system is None else system
        return cls.of(lp.mesh, system, lp.cells, lp.partition.shape)

    @property
    def _parts(self) -> list[CellNumbers]:
        """The cells of each round."""
        return np.split(self.order, self.ends[:-1])

    def solve(self, b: Floats, x: Floats, time_up: TimeUp) -> Floats | None:
        """Return x >= 0 with x = b + M x from a guess; None where none is in sight. Collective."""
        found = np.empty(len(b))
        if self.inner is not None:
            y = self.inner.solve(b[self.core], x[self.core], time_up)
            if y is None:  # on all ranks
                return None
            found[self.core] = y
        return found if self._substituted(b, found) else None

    def solve_transposed(self, b: Floats, time_up: TimeUp, flat: float) -> Floats | None:
        """Return x >= 0 with x = b + M'x; None where none is in sight. Collective."""
        x = np.zeros(self.mesh.columns + 1)
        x[: len(b)], good = b, True
        for k, part in enumerate(self._parts):
            if k:
                self.crossing[k].add(x)
            good &= bool(_down(part, self.system.kernel, x))
        self.crossing[-1].add(x)
        if not self.mesh.ranks.all(good):
            return None
        if self.inner is not None:
            y = self.inner.solve_transposed(x[: len(b)][self.core], time_up, flat)
            if y is None:
                return None
            x[: len(b)][self.core] = y
        return x[: len(b)].copy()

    def advance(self, b: Floats, x: Floats, count: int, flat: float) -> float:
        """Come closer to x = b + M x in place by sweeps of the core, exactly outside. Collective.

        Returns the largest relative change of the last sweep, infinite where none is in sight.
        """
        change = 0.0
        if self.inner is not None:
            y = x[self.core]
            change = self.inner.advance(b[self.core], y, count, flat)
            if not change < np.inf:
                return np.inf
            x[self.core] = y
        return change if self._substituted(b, x) else np.inf

    def _substituted(self, b: Floats, x: Floats) -> bool:
        """Make the values outside the core from those in it; False where one is infinite."""
        values, good = np.full(self.mesh.columns + 1, np.nan), True
        values[: len(x)][self.core], values[-1] = x[self.core], 0.0
        self.crossing[-1].fill(values)
        for k, part in reversed([*enumerate(self._parts)]):
            good &= bool(_back(part, self.system.kernel, b, values))
            if k:
                self.crossing[k].fill(values)
        x[:] = values[: len(x)]
        return self.mesh.ranks.all(good)


def _rounds(mesh: Mesh, system: SplitMatrix) -> tuple[CellNumbers, list[int], list[Halo]]:
    """Return the order of the own cells outside the core, its rounds, and what crosses in each."""
    own, columns = mesh.own, mesh.columns
    ways = np.zeros(columns, dtype=np.uint32)
    _count(system.kernel, ways)
    halo = mesh.narrowed(ways > 0)
    for cells in halo.send.values():
        ways[cells] += np.uint32(1)  # one more for each rank whose cells lead to it
    order, lost = np.empty(columns + int(BYTE), dtype=np.uint32), np.empty(columns - own, np.uint32)
    marks = np.zeros(columns // int(WORD) + 1, dtype=np.uint64)
    place = _places(halo, columns)
    free = np.flatnonzero(ways[:own] == 0)
    order[: len(free)], end, start = free, len(free), 0
    ends: list[int] = []
    while True:
        end, gone = _cascade(order, start, end, system.kernel, ways, marks, lost)
        ends.append(int(end))
        came, more = mesh.ranks.exchange_news(_news(halo, np.sort(lost[:gone]), place))
        if not more:
            break
        start = int(end)
        free = _freed(halo, came, ways)
        order[start : start + len(free)], end = free, start + len(free)
    kind: Any = np.uint16 if len(ends) < 2**16 - 1 else np.uint32
    of = np.full(columns, np.iinfo(kind).max, dtype=kind)
    for k, (a, b) in enumerate(zip([0, *ends], ends, strict=False)):
        of[order[a:b]] = k
    halo.fill(of)
    return order[: ends[-1]].copy(), ends, halo.parted(of, len(ends))


def _places(halo: Halo, columns: int) -> CellNumbers:
    """Return the place in its message of each ghost in the plan, by local numbers of all cells."""
    place = np.zeros(columns, dtype=np.uint32)
    for slots in halo.slots.values():
        place[slots] = np.arange(len(slots))
    return place


def _news(halo: Halo, lost: CellNumbers, place: CellNumbers) -> dict[int, CellNumbers]:
    """Return which ghosts their owners are told of, by their places in the plan."""
    parcels = {}
    for of, slots in halo.slots.items():
        ends = np.array([slots[0], slots[-1] + 1], dtype=lost.dtype)  # of one kind: no copy of all
        first, last = np.searchsorted(lost, ends)
        if first < last:
            parcels[of] = place[lost[first:last]]
    return parcels


def _freed(halo: Halo, came: dict[int, NDArray[Any]], ways: NDArray[np.uint32]) -> Indices:
    """Return the own cells to which none leads any more, now that others have told of theirs."""
    free = []
    for other, places in came.items():
        known = halo.send.get(other, np.empty(0, dtype=np.int64))
        if len(places) and not places.max() < len(known):
            raise RankError(f"rank {other} tells of cells that rank {halo.ranks.rank} has not")
        cells = known[places]
        left = ways[cells] - np.uint32(1)
        ways[cells] = left
        free.append(cells[left == 0])
    return free[0] if len(free) == 1 else np.sort(np.concatenate([*free, np.empty(0, np.int64)]))


@kernel
def _count(system, ways):  # type: ignore[no-untyped-def]
    """Count the entries that lead to each cell."""
    begin, end, indices = system.begin, system.end, system.indices
    for i in range(np.uint64(len(begin))):
        for e in range(begin[i], end[i]):
            ways[indices[e]] += np.uint32(1)


@kernel
def _cascade(order, at, count, system, ways, marks, lost):  # type: ignore[no-untyped-def]
    """Take away own cells ``order[at:count]``, those to which only they lead, and so on.

    As :func:`lmdsl.optimize.linear.substitution._peel` does, level by level, each ascending. The
    ghosts to which no own cell leads any more are ``lost``. Returns where the order ends, and the
    number of these.
    """
    begin, stop, indices = system.begin, system.end, system.indices
    own, at, count, gone = np.uint64(len(begin)), np.uint64(at), np.uint64(count), np.uint64(0)
    while at < count:
        last = count
        low, high = np.uint64(len(marks)), np.uint64(0)
        for t in range(at, last):
            i = order[t]
            for e in range(begin[i], stop[i]):
                j = np.uint64(indices[e])
                left = ways[j] - np.uint32(1)
                ways[j] = left
                word = j // WORD
                marks[word] |= np.uint64(left == 0) << (j % WORD)
                low = word if word < low else low
                high = word if word > high else high
                order[count] = j
                count += np.uint64(left == 0)
        if low <= high and high - low > FAR * (count - last):  # few, far apart: as they came
            for t in range(last, count):
                marks[order[t] // WORD] = np.uint64(0)
            low, high = np.uint64(1), np.uint64(0)
        else:
            count = last
        for w in range(low, high + ONE):
            bits, first = marks[w], np.uint64(w) * WORD
            marks[w] = np.uint64(0)
            while bits != np.uint64(0):
                for d in range(BYTE):
                    order[count] = first + d
                    count += (bits >> d) & ONE
                bits, first = bits >> BYTE, first + BYTE
        kept = last
        for t in range(last, count):
            j = order[t]
            if j < own:
                order[kept] = j
                kept += ONE
            else:
                lost[gone] = j
                gone += ONE
        at, count = last, kept
    return count, gone

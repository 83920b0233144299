"""The part of a system without cycles over ranks: by substitution, in few rounds of messages.

As in ``optimize/linear/substitution.py`` cells to which none leads are taken away, then those to
which only these lead, and so on; what is left is the core. Which cells these are does not depend on
the order, so each rank goes as far as it can with what it knows, and then all tell each other: a
round for each time that a way crosses from rank to rank, not one for each level. The value of a
cell is the same formula of the values that it leads to whenever it is made: the same bits.

Of the transposed system the values of the cells outside are known first, from those that lead to
them; then the core follows.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, TimeUp
from lmdsl.machine.kernels import kernel
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.linear.gauss_seidel import CEILING, NEVER, SplitMatrix
from lmdsl.optimize.linear.policy_system import of_policy
from lmdsl.ranks.mesh import Mesh
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs.chains.sweeping import SpreadSystem


@dataclass(frozen=True, eq=False)
class SpreadPeeled:
    """A system over ranks and its core.

    Attributes
    ----------
    whole
        The system of all cells.
    order
        Own cells outside the core, in an order in which each stands before all it leads to.
    core
        Which own cells are the core, shape (own,).
    inner
        The system of the core, its cells numbered anew.
    """

    whole: SpreadSystem
    order: NDArray[np.uint32]
    core: Bools
    inner: SpreadSystem

    @classmethod
    def of(cls, whole: SpreadSystem, cells: Indices, shape: tuple[int, ...]) -> Self:
        """Find the core; ``cells`` are the own ones by their index in a box. Collective."""
        order = _outside(whole)
        core = np.ones(whole.mesh.own, dtype=np.bool_)
        core[order] = False
        return cls(whole, order, core, _among(whole, core, cells, shape))

    def solve(self, b: Floats, x: Floats, time_up: TimeUp) -> Floats | None:
        """Return x >= 0 with x = b + M x from a guess; None where none is in sight. Collective."""
        y = self.inner.solve(b[self.core], x[self.core], time_up)
        if y is None:  # on all ranks
            return None
        found = np.full(len(b), np.nan)
        found[self.core] = y
        return found if _substituted(self.whole, self.order[::-1].copy(), b, found) else None

    def advance(self, b: Floats, x: Floats, count: int, flat: float) -> float:
        """Come closer to x = b + M x in place by sweeps of the core, exactly outside. Collective.

        Returns the largest relative change of the last sweep, infinite where none is in sight.
        """
        y = x[self.core]
        change = self.inner.sweep(b[self.core], y, count, 0.0, flat)[1]
        if not change < np.inf:
            return np.inf
        x[:] = np.nan
        x[self.core] = y
        return change if _substituted(self.whole, self.order[::-1].copy(), b, x) else np.inf


def _substituted(whole: SpreadSystem, order: NDArray[np.uint32], b: Floats, x: Floats) -> bool:
    """Fill in the cells of an order, NaN where not known yet; False where one is infinite."""
    mesh, ranks = whole.mesh, whole.ranks
    values = np.full(mesh.columns + 1, np.nan)
    values[: len(x)], values[mesh.columns] = x, 0.0
    told: dict[int, Bools] = {}
    while True:
        mesh.tell(values, whole.halo, told)
        left, finite = _fill(order, whole.system.kernel, b, values)
        x[:] = values[: len(x)]
        every = ranks.collect((int(left), bool(finite)))
        if not all(good for _, good in every):
            return False
        if not any(count for count, _ in every):
            return True


def transposed(peeled: SpreadPeeled, cells: Indices, shape: tuple[int, ...]) -> SpreadPeeled:
    """Return M' with the same core; :func:`solve_transposed` solves it. Collective."""
    whole = peeled.whole.transposed(cells, shape)
    return replace(
        peeled, whole=whole, inner=_among(whole, peeled.core, cells, shape, against=True)
    )


def solve_transposed(
    turned: SpreadPeeled, b: Floats, time_up: TimeUp, flat: float
) -> Floats | None:
    """Return x >= 0 with x = b + M'x, None where none is in sight; ``turned`` is M'. Collective."""
    x = np.full(len(b), np.nan)
    if not _substituted(turned.whole, turned.order, b, x):
        return None
    outside = np.where(turned.core, 0.0, x)
    known = turned.whole.mesh.spread(outside, 0.0, turned.whole.halo)
    flow = np.zeros(len(b))
    _times(turned.whole.system.kernel, known, flow)
    start = b[turned.core] + flow[turned.core]
    y = turned.inner.solve(start, start.copy(), time_up, flat)
    if y is None:
        return None
    x[turned.core] = y
    return x


def of_chain(lp: StabilizationLP, policy: Indices, gamma: float) -> SpreadPeeled:
    """Return gamma P_u for a policy of own columns, its core found; collective."""
    assert lp.mesh is not None
    whole = SpreadSystem.of(lp.mesh, of_policy(lp, policy, gamma), lp.cells, lp.partition.shape)
    return SpreadPeeled.of(whole, lp.cells, lp.partition.shape)


def _outside(whole: SpreadSystem) -> NDArray[np.uint32]:
    """Return the own cells outside the core, each before all it leads to on this rank."""
    mesh, system = whole.mesh, whole.system
    own = mesh.own
    ways = np.zeros(mesh.columns, dtype=np.int64)
    _count(system.kernel, ways)
    ways[:own] = _told(mesh, ways)
    ways[own:] = 0
    order, end = np.empty(own, dtype=np.uint32), 0
    free = np.flatnonzero(ways[:own] == 0).astype(np.uint32)
    order[: len(free)], start, end = free, 0, len(free)
    while True:
        end = int(_cascade(order, start, end, system.kernel, ways))
        before = ways[:own].copy()
        ways[:own] = _told(mesh, ways)  # ghosts lost ways: their owners are told
        ways[own:] = 0
        news = np.flatnonzero((ways[:own] == 0) & (before > 0)).astype(np.uint32)
        start = end
        order[end : end + len(news)], end = news, end + len(news)
        if not mesh.ranks.any(len(news) > 0):
            return order[:end].copy()


def _told(mesh: Mesh, ways: Indices) -> Indices:
    """Return the numbers of own cells with what other ranks have to add to them; collective."""
    own, named = ways[: mesh.own].copy(), np.flatnonzero(ways[mesh.own :])
    cells, more = mesh.ghosts[named], ways[mesh.own + named]
    owner = mesh.division.owner(cells)
    parcels = {
        int(k): np.concatenate(
            [(cells - mesh.division.starts[k])[owner == k], more[owner == k]],
            dtype=np.int32,
            casting="same_kind",
        )
        for k in np.unique(owner)
    }
    for other, came in mesh.ranks.exchange(parcels).items():
        at, ways_there = np.split(came, 2)
        if len(at) and not (at.min() >= 0 and at.max() < len(own)):
            raise RankError(
                f"rank {other} counts ways to cells that rank {mesh.ranks.rank} has not"
            )
        np.add.at(own, at, ways_there)
    return own


def _among(
    whole: SpreadSystem, core: Bools, cells: Indices, shape: tuple[int, ...], against: bool = False
) -> SpreadSystem:
    """Return the system of some cells alone, numbered anew; what leads elsewhere is left out."""
    mesh = whole.mesh
    division = mesh.division.within(mesh.ranks, core)
    number = np.full(mesh.own, -1, dtype=np.int64)
    number[core] = division.own(mesh.ranks.rank)[0] + np.arange(int(core.sum()))
    numbers = mesh.spread(number, -1, whole.halo)
    begin, end, indices, data, inverse = whole.system.kernel
    rows = np.flatnonzero(core)
    length = (end - begin)[rows].astype(np.int64)
    at = np.repeat(begin[rows].astype(np.int64) - np.append(0, np.cumsum(length))[:-1], length)
    at += np.arange(len(at))
    target = numbers[indices[at]]
    row = np.repeat(np.arange(len(rows)), length)[target >= 0]
    pointer = np.append(0, np.cumsum(np.bincount(row, minlength=len(rows)))).astype(np.uint64)
    named = target[target >= 0]
    inner = Mesh.of(mesh.ranks, division, named)
    system = SplitMatrix(
        pointer[:-1].copy(), pointer[1:].copy(), inner.local(named).astype(np.uint32),
        data[at][target >= 0], inverse[rows], whole.system.directions.among(rows),
    )  # fmt: skip
    return SpreadSystem.of(inner, system, cells[core], shape, against)


@kernel
def _count(system, ways):  # type: ignore[no-untyped-def]
    """Count the entries that lead to each cell."""
    begin, end, indices = system.begin, system.end, system.indices
    for i in range(np.uint64(len(begin))):
        for e in range(begin[i], end[i]):
            ways[indices[e]] += 1


@kernel
def _cascade(order, start, end, system, ways):  # type: ignore[no-untyped-def]
    """Take away own cells, and those to which only they lead; return where ``order`` ends.

    Ghosts count down from 0.
    """
    begin, stop, indices = system.begin, system.end, system.indices
    own = len(order)
    while start < end:
        i = order[start]
        start += 1
        for e in range(begin[i], stop[i]):
            j = indices[e]
            ways[j] -= 1
            if ways[j] == 0 and j < own:
                order[end] = j
                end += 1
    return end


@kernel
def _fill(order, system, b, x):  # type: ignore[no-untyped-def]
    """Make the values of cells that lead to known ones only; NaN is not known.

    Returns how many are left, and whether all that were made are finite.
    """
    begin, end, indices, data, inverse = system
    left = 0
    for t in range(np.uint64(len(order))):
        i = order[t]
        if x[i] == x[i]:
            continue
        y = b[i]
        for e in range(begin[i], end[i]):
            y += data[e] * x[indices[e]]
        if y != y:
            left += 1
            continue
        if y != 0.0:
            y *= inverse[i]
            if inverse[i] >= NEVER or not y < CEILING:
                return left, False
        x[i] = y
    return left, True


@kernel
def _times(system, x, out):  # type: ignore[no-untyped-def]
    """Write M x, without the diagonal of M."""
    begin, end, indices, data = system.begin, system.end, system.indices, system.data
    for i in range(np.uint64(len(begin))):
        y = 0.0
        for e in range(begin[i], end[i]):
            y += data[e] * x[indices[e]]
        out[i] = y

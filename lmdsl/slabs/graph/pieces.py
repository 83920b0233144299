"""The sets of cells, of which a rank makes the pieces that it looks at.

What must hold: of the cells that are known, a rank says what :class:`lmdsl.model.sets.CellSets`
does, their numbers among all included; a cell is known before it is looked at. Every rank finds the
same of a cell, as each finds it by itself: only how many cells of each piece are free is told.

A piece is ``PIECE`` consecutive cells. Arrays over the box are addresses: only pages that pieces
were written to take memory.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import (
    PART,
    CellSets,
    Mass,
    always_whole,
    attractor_of,
    avoid_of,
    no_cell,
    require_apart,
    weightless,
)
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Alone, Ranks
from lmdsl.slabs.graph.planes import Planes, untouched

PIECE = 2**10  # cells, a power of two
AT_ONCE = 2**8  # pieces that are made at a time

Kinds = Callable[[Indices], tuple[Bools, Bools]]  # see BoxPieces


class BoxPieces:
    """What the cells of a box are, piece by piece; several threads may ask at once.

    Attributes
    ----------
    partition
        The cells.
    kinds
        Says which of some cells, ascending ones, are free, and which are in the attractor.
    number
        As of :class:`CellSets`, of cells that are known.
    before
        How many cells before each piece are free, then of all, shape (pieces + 1,).
    known
        Which pieces are known.
    """

    def __init__(self, partition: Partition, kinds: Kinds) -> None:
        self.partition, self.kinds = partition, kinds
        count = -(-partition.size // PIECE)
        self.number = untouched(partition.size, np.int32)
        self.known = np.zeros(count, dtype=np.bool_)
        self.before: Indices = np.zeros(count + 1, dtype=np.int64)
        self._lock = threading.Lock()

    @classmethod
    def of(cls, ranks: Ranks, partition: Partition, kinds: Kinds) -> Self:
        """Return the pieces of a box, none known yet; collective: each looks at its share."""
        made = ranks.agreed(lambda: cls(partition, kinds))
        share = _share(ranks, len(made.known))
        free = np.concatenate(ranks.told(lambda: made._count(share)))
        made.before = np.append(0, np.cumsum(free)).astype(np.int64)
        return made

    @property
    def free(self) -> int:
        """Number of free cells F."""
        return int(self.before[-1])

    def meet(self, cells: NDArray[Any]) -> None:
        """Make known what cells are, given in any order, NaN for none."""
        if self.known.all():
            return
        cells = np.ascontiguousarray(cells).reshape(-1)
        bits = PIECE.bit_length() - 1
        first = first_unknown(cells, bits, self.known)
        if first < len(cells):
            wanted = np.zeros(len(self.known), dtype=np.bool_)
            touch(cells[first:], bits, self.known, wanted)
            self.make(np.flatnonzero(wanted))

    def meet_range(self, first: int, last: int) -> None:
        """Make known what the cells first..last-1 are."""
        self._require(np.arange(first // PIECE, -(-last // PIECE)))

    def _require(self, pieces: Indices) -> None:
        unknown = pieces[~self.known[pieces]]
        if len(unknown):
            self.make(unknown)

    def make(self, pieces: Indices) -> None:
        """Make some pieces known, ascending ones."""
        with self._lock:
            pieces = pieces[~self.known[pieces]]
            for at in range(0, len(pieces), AT_ONCE):
                some = pieces[at : at + AT_ONCE]
                cells = self._cells(some)
                free, attractor = self.kinds(cells)
                of_piece = np.repeat(np.arange(len(some)), PIECE)[: len(cells)]
                within = np.cumsum(free)
                starts = np.arange(0, len(cells), PIECE)
                begins: Indices = within[starts] - free[starts]
                number = (self.before[some] - begins)[of_piece] + within - 1
                number[~free] = np.where(attractor[~free], self.free, -1)
                self.number[cells] = number
                self.known[some] = True

    def chosen(self, positions: Indices) -> Indices:
        """Return free cells by their positions among all, ascending ones."""
        piece = np.searchsorted(self.before, positions, side="right") - 1
        pieces, which = np.unique(piece, return_inverse=True)
        self._require(pieces)
        cells = self._cells(pieces)
        number = self.number[cells]
        cells = cells[(number >= 0) & (number < self.free)]
        starts = np.append(0, np.cumsum(self.before[pieces + 1] - self.before[pieces]))
        at: Indices = starts[which] + positions - self.before[piece]
        return cells[at]

    def chosen_range(self, first: int, last: int) -> Indices:
        """Return the free cells at the positions first..last-1 among all."""
        if first >= last:
            return np.empty(0, dtype=np.int64)
        ends = np.searchsorted(self.before, (first, last - 1), side="right").tolist()
        pieces, at = np.arange(ends[0] - 1, ends[1]), first - int(self.before[ends[0] - 1])
        self._require(pieces)
        begin = int(pieces[0]) * PIECE
        number = self.number[begin : (int(pieces[-1]) + 1) * PIECE]
        cells = np.flatnonzero((number >= 0) & (number < self.free))
        return cells[at : at + last - first] + begin

    def _cells(self, pieces: Indices) -> Indices:
        cells = (pieces[:, None] * PIECE + np.arange(PIECE)).ravel()
        return cells[: np.searchsorted(cells, self.partition.size)]

    def _count(self, share: range) -> Indices:
        """Return how many cells of each piece of a share are free."""
        found = [np.zeros(0, dtype=np.int64)]
        for at in range(share.start, share.stop, AT_ONCE):
            some = np.arange(at, min(at + AT_ONCE, share.stop))
            free, _ = self.kinds(self._cells(some))
            found.append(np.add.reduceat(free, np.arange(0, len(free), PIECE), dtype=np.int64))
        return np.concatenate(found)


class _Seen:
    """An array over cells of which pieces are made once they are looked at."""

    def __init__(
        self, size: int, read: Callable[[Indices], NDArray[Any]],
        run: Callable[[int, int], NDArray[Any]] | None = None,
    ) -> None:  # fmt: skip
        self.size, self.read = size, read
        self.run = run or (lambda first, last: read(np.arange(first, last)))  # of neighbours

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, at: Any) -> NDArray[Any]:
        if isinstance(at, slice):
            first, last, step = at.indices(self.size)
            return self.run(first, last) if step == 1 else self.read(np.arange(first, last, step))
        cells = np.atleast_1d(at)
        if cells.dtype == np.bool_:
            raise TypeError("cells are chosen by their numbers, not by bool marks of all")
        found = self.read(cells.astype(np.int64))
        return found if np.ndim(at) else found[0]


@dataclass(frozen=True, eq=False)
class PieceSets(CellSets):
    """The sets of a problem of which a rank knows the pieces that it has met."""

    pieces: BoxPieces
    planes: Planes

    @classmethod
    def over(cls, ranks: Ranks, problem: Problem, partition: Partition, deadline: Deadline) -> Self:
        """Return the sets of a problem over ranks; collective. Raises as :meth:`CellSets.of`."""
        guard = partial(deadline.raise_if_over, "compiling")
        kinds = ranks.agreed(lambda: _declared(problem, partition, guard))
        mass = Mass(problem, partition, guard)
        made = cls.of_kinds(ranks, partition, kinds, cast(Any, _Seen(partition.size, mass.on)))
        share = _share(ranks, partition.size)
        if problem.measure is not None and not any(ranks.told(lambda: _weighed(mass, share))):
            ranks.agreed(lambda: _refuse(weightless()))
        return made

    @classmethod
    def of_kinds(cls, ranks: Ranks, partition: Partition, kinds: Kinds, mass: Floats) -> Self:
        """Return the sets of which some cells are free, some the attractor; collective."""
        pieces = BoxPieces.of(ranks, partition, kinds)

        def numbers(cells: Indices) -> NDArray[np.int32]:
            pieces.meet(cells)
            return pieces.number[cells]

        N, F = partition.size, pieces.free
        views = (
            _Seen(N, lambda cells: numbers(cells) == F),
            _Seen(N, lambda cells: numbers(cells) < 0),
            _Seen(F, pieces.chosen, pieces.chosen_range),
        )
        attractor, avoid, free = (cast(Any, view) for view in views)
        planes = Planes(partition, pieces.number, F, pieces.meet_range)
        return cls(attractor, avoid, mass, free, pieces.number, pieces, planes)

    @classmethod
    def alone(cls, problem: Problem, deadline: Deadline) -> CellSets:
        """Return the sets of a problem for one rank that looks at a few cells all over the box."""
        partition = Partition.of(problem)
        if always_whole(problem):
            return CellSets.of(problem, partition, deadline)
        return cls.over(Alone(), problem, partition, deadline)

    def meet(self, index: Floats | Indices) -> None:
        """See :meth:`CellSets.meet`."""
        self.pieces.meet(index)

    def free_before(self, cell: int) -> int:
        """See :meth:`CellSets.free_before`."""
        piece = cell // PIECE
        known = self.avoid[piece * PIECE : cell] | self.attractor[piece * PIECE : cell]
        return int(self.pieces.before[piece]) + int(len(known) - known.sum())

    def meet_paths(self, state: Floats, slope: Floats) -> None:
        """See :meth:`CellSets.meet_paths`."""
        self.planes.meet(state, slope)

    def room(self, partition: Partition) -> NDArray[np.uint8]:
        """Return the room of the cells that paths have met: see :meth:`CellSets.room`."""
        return self.planes.room


@kernel
def first_unknown(cells, bits, known):  # type: ignore[no-untyped-def]
    """Return the place of the first cell whose piece of 2**bits is not known, or the end."""
    for k in range(len(cells)):
        if cells[k] >= 0 and not known[np.int64(cells[k]) >> bits]:  # not NaN
            return k
    return len(cells)


@kernel
def touch(cells, bits, known, wanted):  # type: ignore[no-untyped-def]
    """Mark the pieces that some cells are in, and that are not known."""
    for k in range(len(cells)):
        if cells[k] >= 0:  # not NaN
            piece = np.int64(cells[k]) >> bits
            if not known[piece]:
                wanted[piece] = True


def _declared(problem: Problem, partition: Partition, guard: Guard) -> Kinds:
    """Return what cells are as a problem declares them; BadInput: they cannot be so."""
    attractor = attractor_of(problem, partition, guard)
    if attractor.empty and not problem.attractor.empty:
        raise no_cell(problem.attractor, partition, "attractor")
    avoid = avoid_of(problem, partition, guard)

    def kinds(cells: Indices) -> tuple[Bools, Bools]:
        index = partition.multi_index(cells)
        inside, avoided = attractor.on(cells, index), avoid.on(cells, index)
        require_apart(partition, cells[inside & avoided])
        return ~(inside | avoided), inside

    return kinds


def _weighed(mass: Mass, share: range) -> bool:
    """Return whether a cell of a share carries weight; BadInput: a density is wrong there."""
    found = False
    for start in range(share.start, share.stop, PART):
        found |= bool(mass.on(np.arange(start, min(start + PART, share.stop))).any())
    return found


def _share(ranks: Ranks, count: int) -> range:
    """Return which of so many things a rank looks at for all."""
    return range(count * ranks.rank // ranks.count, count * (ranks.rank + 1) // ranks.count)


def _refuse(error: Exception) -> None:
    raise error

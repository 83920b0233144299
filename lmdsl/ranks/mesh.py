"""Own cells and ghosts of a rank: local numbers, and who sends what to whom.

A rank numbers the cells that its rows name: first its own in order, then its *ghosts*, the cells of
other ranks, ascending, then the attractor. Rows that are numbered so keep the order of their
entries, so that every sum over a row is the same to the bit as in one process. Vectors for such
rows have the values of own cells, ghosts and the attractor, as :meth:`Mesh.spread` makes them.

The certificate does not see a wrong ghost: claims about wrong numbers hold too. So:

1. when a plan is made, every ghost confirms its number with its owner by the very messages that
   carry values afterwards: a ghost that is swapped, missing or one too many is refused;
2. every message bears the plan it belongs to and its place in the series: old values are refused;
3. of ghosts that a plan leaves out the value is NaN, and a plan is asked whether it covers rows;
4. an owner is asked for its own cells only, and all ranks agree beforehand on what is whose.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.machine.kernels import kernel
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import RankError, Ranks

LocalNumbers = NDArray[np.int64]


@dataclass(eq=False)
class Halo:
    """A plan: the values of which own cells go to whom, and which ghosts those that come are.

    Attributes
    ----------
    ranks, number
        Whose plan it is, and a number that it has on every rank.
    send
        Own cells (local numbers) whose values go to a rank, by rank.
    slots
        Ghosts (local numbers) whose values come from a rank, by rank.
    spread
        How often values were sent by it.
    """

    ranks: Ranks
    number: int
    send: dict[int, LocalNumbers]
    slots: dict[int, LocalNumbers]
    spreads: int = 0

    def fill(self, x: NDArray[Any]) -> None:
        """Write the values of other ranks' cells into the ghosts of x; collective.

        Every message ends with the plan and how often it was used, in bytes of the same kind.
        """
        self.spreads += 1
        stamp = _stamp(self.number, self.spreads, x.dtype)
        parcels = {to: np.concatenate([x[cells], stamp]) for to, cells in self.send.items()}
        sizes = {of: len(slots) + len(stamp) for of, slots in self.slots.items()}
        for of, came in self.ranks.exchange(parcels, sizes, x.dtype).items():
            end = len(self.slots[of])
            if came[end:].tobytes() != stamp.tobytes():
                raise RankError(
                    f"rank {of} sent rank {self.ranks.rank} values of another time or plan"
                )
            x[self.slots[of]] = came[:end]

    @property
    def size(self) -> int:
        """Number of ghosts that it fills."""
        return sum(map(len, self.slots.values()))


@dataclass(eq=False)
class Mesh:
    """The cells of a rank in local numbers.

    Attributes
    ----------
    ranks, division
        Who talks, and which cells are whose, by global numbers.
    ghosts
        Global numbers of the ghosts, ascending, shape (ghosts,).
    halo
        The plan of all ghosts.
    """

    ranks: Ranks
    division: Division
    ghosts: Indices
    halo: Halo = field(init=False)
    plans: int = 0

    @classmethod
    def of(cls, ranks: Ranks, division: Division, named: NDArray[np.integer]) -> "Mesh":
        """Return the mesh of rows that name these cells, by global numbers; collective.

        Numbers of own cells, and of the attractor (``division.cells``), are passed over.
        """
        division.confirm(ranks)
        seen = np.zeros(division.cells // 8 + 1, dtype=np.uint8)  # a bit for each cell
        known = bool(_see(np.asarray(named), *division.own(ranks.rank), division.cells, seen))
        ghosts = _seen(seen)
        if not ranks.all(known):
            raise RankError(f"rows of a rank name cells outside 0..{division.cells - 1}")
        mesh = cls(ranks, division, ghosts)
        mesh.halo = mesh.plan(np.arange(len(ghosts)))
        return mesh

    @property
    def own(self) -> int:
        """Number of own cells."""
        first, last = self.division.own(self.ranks.rank)
        return last - first

    @property
    def columns(self) -> int:
        """Number of own cells and ghosts: the local number of the attractor."""
        return self.own + len(self.ghosts)

    @property
    def numbers(self) -> Indices:
        """Global numbers of own cells, ghosts and the attractor, by local number."""
        own = np.arange(*self.division.own(self.ranks.rank), dtype=np.int64)
        return np.concatenate([own, self.ghosts, [self.division.cells]])

    def local(
        self, cells: NDArray[np.integer], into: NDArray[np.int32] | None = None
    ) -> NDArray[np.int32]:
        """Return the local numbers of cells given by global ones; each is looked up and back.

        They are written ``into`` an array where one is given, which may be that of the cells.
        """
        first, last = self.division.own(self.ranks.rank)
        cells = np.asarray(cells)
        found = np.empty(len(cells), dtype=np.int32) if into is None else into
        places = _Places(first, last, self.division.cells, self.ghosts, *_buckets(self.ghosts))
        if not _localise(cells, places, found):
            raise RankError(f"rank {self.ranks.rank} has no ghost for a cell that its rows name")
        return found

    def plan(self, chosen: NDArray[np.integer]) -> Halo:
        """Return the plan of some ghosts, by their places among all, and confirm it; collective.

        The owner of every ghost is asked for it by its global number, and answers for its own.
        """
        self.plans += 1
        chosen = np.unique(np.asarray(chosen, dtype=np.int64))
        wanted, slots = self.ghosts[chosen], chosen + self.own
        owner = self.division.owner(wanted)
        asked = {int(k): wanted[owner == k] for k in np.unique(owner)}
        first, last = self.division.own(self.ranks.rank)
        send: dict[int, LocalNumbers] = {}
        for other, cells in self.ranks.exchange(asked).items():
            if len(cells) and not (first <= cells.min() and cells.max() < last):
                raise RankError(
                    f"rank {other} asks rank {self.ranks.rank}, which has the cells {first} to "
                    f"{last - 1}, for others"
                )
            send[other] = cells - first
        halo = Halo(self.ranks, self.plans, send, {k: slots[owner == k] for k in asked})
        self.confirm(halo, slots)
        return halo

    def confirm(self, halo: Halo, slots: NDArray[np.integer]) -> None:
        """Refuse a plan by which some ghost does not get the number of its own cell; collective."""
        numbers = self.numbers
        told = numbers.copy()
        told[self.own : -1] = -1
        halo.fill(told)
        wrong = np.flatnonzero(told[slots] != numbers[slots])
        if len(wrong):
            k = int(slots[wrong[0]])
            raise RankError(
                f"rank {self.ranks.rank} waits for cell {numbers[k]} and gets "
                f"{told[k] if told[k] >= 0 else 'nothing'}"
            )
        self.ranks.collect(None)  # nobody goes on before all are sure

    def for_rows(self, targets: NDArray[np.integer]) -> Halo:
        """Return the plan of the ghosts that some rows name, by local numbers; collective."""
        named = np.unique(np.asarray(targets, dtype=np.int64)) - self.own
        return self.plan(named[(named >= 0) & (named < len(self.ghosts))])

    def require_covered(self, halo: Halo, targets: NDArray[np.integer]) -> None:
        """Refuse a plan that leaves out a ghost that rows name, by local numbers."""
        known = np.ones(self.columns + 1, dtype=np.bool_)
        known[self.own : -1] = False
        for slots in halo.slots.values():
            known[slots] = True
        bad = np.flatnonzero(~known[targets])
        if len(bad):
            cell = self.numbers[targets[bad[0]]]
            raise RankError(f"rank {self.ranks.rank} reads cell {cell}, which nobody sends")

    def tell(self, x: NDArray[np.float64], halo: Halo, told: dict[int, NDArray[np.bool_]]) -> None:
        """Tell others the values that are known by now, not NaN, each once; collective.

        x has the values of own cells and ghosts; ``told`` is who knows which, nothing at first.
        Values come with the numbers of their cells.
        """
        first, _ = self.division.own(self.ranks.rank)
        parcels = {}
        for to, cells in halo.send.items():
            known = ~np.isnan(x[cells])
            news = cells[known & ~told.get(to, np.zeros(len(cells), dtype=np.bool_))]
            told[to] = known
            if len(news):
                parcels[to] = np.concatenate([(news + first).astype(np.float64), x[news]])
        for came in self.ranks.exchange(parcels).values():
            numbers, values = np.split(came, 2)
            x[self.local(numbers.astype(np.int64))] = values

    def spread(
        self, own: NDArray[Any], attractor: Any = 0.0, halo: Halo | None = None
    ) -> NDArray[Any]:
        """Return own values, those of the ghosts and the attractor's; collective.

        Ghosts that ``halo`` leaves out are NaN; of whole numbers every bit is set.
        """
        x = np.empty(self.columns + 1, dtype=own.dtype)
        x[: self.own], x[self.columns] = own, attractor
        x[self.own : self.columns] = _nothing(own.dtype)
        (halo or self.halo).fill(x)
        return x


@kernel
def _see(named, first, last, end, seen):  # type: ignore[no-untyped-def]
    """Set the bits of cells that are not own; False where one is no cell and not the attractor."""
    for e in range(len(named)):
        cell = named[e]
        if (cell < first or cell >= last) and cell != end:
            if cell < 0 or cell > end:
                return False
            seen[cell >> 3] |= np.uint8(1 << (cell & 7))
    return True


def _seen(seen: NDArray[np.uint8]) -> Indices:
    """Return the numbers of bits that are set, ascending."""
    some = np.flatnonzero(seen)
    place, bit = np.nonzero(np.unpackbits(seen[some, None], axis=1, bitorder="little"))
    return some[place].astype(np.int64) * 8 + bit


class _Places(NamedTuple):
    """Own cells and ghosts; of every bucket of 2^shift cells from ``low`` its first ghost."""

    first: int
    last: int
    end: int  # the attractor
    ghosts: Indices
    low: int
    shift: int
    start: Indices


def _buckets(ghosts: Indices) -> tuple[int, int, Indices]:
    """Return where to look for ghosts: about as many buckets as there are ghosts."""
    if not len(ghosts):
        return 0, 0, np.zeros(1, dtype=np.int64)
    low, span = int(ghosts[0]), int(ghosts[-1] - ghosts[0]) + 1
    shift = max(0, (span // (2 * len(ghosts))).bit_length())
    starts = low + (np.arange((span >> shift) + 2, dtype=np.int64) << shift)
    return low, shift, np.searchsorted(ghosts, starts).astype(np.int64)


@kernel
def _localise(cells, places, found):  # type: ignore[no-untyped-def]
    """Write local numbers; False where a cell is not own, no ghost and not the attractor."""
    first, last, end, ghosts, least, shift, start = places
    own = last - first
    for e in range(len(cells)):
        cell = np.int64(cells[e])
        if first <= cell < last:
            found[e] = cell - first
        elif cell == end:
            found[e] = own + len(ghosts)
        else:
            bucket = (cell - least) >> shift
            if bucket < 0 or bucket + 1 >= len(start):
                return False
            low, high = start[bucket], start[bucket + 1]
            while low < high:
                middle = (low + high) // 2
                if ghosts[middle] < cell:
                    low = middle + 1
                else:
                    high = middle
            if low == len(ghosts) or ghosts[low] != cell:
                return False
            found[e] = own + low
    return True


def _nothing(kind: np.dtype[Any]) -> Any:
    """Return what stands for no value."""
    if kind.kind == "u":
        return np.iinfo(kind).max
    return np.nan if kind.kind == "f" else -1


def _stamp(plan: int, spread: int, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return eight bytes that tell a plan and its use, as numbers of a kind."""
    word = np.array([plan << 40 | spread], dtype=np.uint64)
    if kind == np.bool_:  # whose bytes are 0 or 1
        return np.unpackbits(word.view(np.uint8)).view(np.bool_)
    return word.view(kind)

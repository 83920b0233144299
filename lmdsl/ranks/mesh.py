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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices
from lmdsl.ranks.numbering import localised, seen
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
        for of, came in self._carried(x, self.send, self.slots).items():
            x[self.slots[of]] = came

    def add(self, x: NDArray[Any]) -> None:
        """Add the values of the ghosts of x to those of their own cells, the other way; collective.

        They are added in the order of ranks.
        """
        for to, came in self._carried(x, self.slots, self.send).items():
            x[self.send[to]] += came

    def _carried(
        self, x: NDArray[Any], out: dict[int, LocalNumbers], into: dict[int, LocalNumbers]
    ) -> dict[int, NDArray[Any]]:
        """Send parts of x, and return what comes for others, by rank."""
        self.spreads += 1
        stamp = _stamp(self.number, self.spreads, x.dtype)
        parcels = {to: np.concatenate([x[cells], stamp]) for to, cells in out.items()}
        sizes = {of: len(slots) + len(stamp) for of, slots in into.items()}
        found = {}
        for of, came in self.ranks.exchange(parcels, sizes, x.dtype).items():
            end = len(into[of])
            if came[end:].tobytes() != stamp.tobytes():
                raise RankError(
                    f"rank {of} sent rank {self.ranks.rank} values of another time or plan"
                )
            found[of] = came[:end]
        return found

    def parted(self, kind: NDArray[np.unsignedinteger], count: int) -> "list[Halo]":
        """Return ``count + 1`` plans: of cells of each kind, 0 to count - 1, then of the others.

        ``kind`` is that of own cells and ghosts, and known on both sides.
        """
        parts = [
            Halo(self.ranks, self.number, {}, {}, (k + 1) << 20)  # so that stamps differ
            for k in range(count + 1)
        ]
        for to in self.send:
            for part, cells in zip(parts, _parted(self.send[to], kind, count), strict=True):
                if len(cells):
                    part.send[to] = cells
        for of in self.slots:
            for part, cells in zip(parts, _parted(self.slots[of], kind, count), strict=True):
                if len(cells):
                    part.slots[of] = cells
        return parts

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
        ghosts = seen(named, *division.own(ranks.rank), division.cells)
        if not ranks.all(ghosts is not None) or ghosts is None:
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
        found = np.empty(len(cells), dtype=np.int32) if into is None else into
        own = self.division.own(self.ranks.rank)
        if not localised(cells, *own, self.division.cells, self.ghosts, found):
            raise RankError(f"rank {self.ranks.rank} has no ghost for a cell that its rows name")
        return found

    def plan(self, chosen: NDArray[np.integer]) -> Halo:
        """Return the plan of some ghosts, by their places among all, and confirm it; collective.

        The owner of every ghost is asked for it by its global number, and answers for its own.
        """
        self.plans += 1
        marked = np.zeros(len(self.ghosts), dtype=np.bool_)
        marked[chosen] = True
        chosen = np.flatnonzero(marked)
        wanted = self.ghosts[chosen]
        slots = (chosen + self.own).astype(np.int64, copy=False)
        owned = self.division.by_owner(wanted)
        asked = {k: wanted[own] for k, own in owned.items()}
        first, last = self.division.own(self.ranks.rank)
        send: dict[int, LocalNumbers] = {}
        for other, cells in self.ranks.exchange(asked).items():
            if len(cells) and not (first <= cells.min() and cells.max() < last):
                raise RankError(
                    f"rank {other} asks rank {self.ranks.rank}, which has the cells {first} to "
                    f"{last - 1}, for others"
                )
            send[other] = (cells - first).astype(np.int64, copy=False)
        halo = Halo(self.ranks, self.plans, send, {k: slots[own] for k, own in owned.items()})
        self.confirm(halo, slots)
        return halo

    def confirm(self, halo: Halo, slots: NDArray[np.integer]) -> None:
        """Refuse a plan by which some ghost does not get the number of its own cell; collective."""
        small = self.division.cells < 2**31
        numbers = self.numbers.astype(np.int32 if small else np.int64, copy=False)
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
        named = np.asarray(targets, dtype=np.int64)
        wanted = np.zeros(self.columns + 1, dtype=np.bool_)
        wanted[named] = True
        return self.narrowed(wanted[:-1])

    def narrowed(self, wanted: Bools) -> Halo:
        """Return the plan of some ghosts, marked by local numbers, and confirm it; collective.

        Owners are told by a bit for each ghost of the plan of all.
        """
        self.plans += 1
        whole = self.halo
        asked = {of: np.packbits(wanted[slots]) for of, slots in whole.slots.items()}
        sizes = {to: (len(cells) + 7) // 8 for to, cells in whole.send.items()}
        send = {}
        for to, bits in self.ranks.exchange(asked, sizes, np.uint8).items():
            cells = whole.send[to]
            send[to] = cells[np.unpackbits(bits, count=len(cells)).view(np.bool_)]
        slots = {of: slots[wanted[slots]] for of, slots in whole.slots.items()}
        halo = Halo(
            self.ranks, self.plans, {to: cells for to, cells in send.items() if len(cells)},
            {of: ghosts for of, ghosts in slots.items() if len(ghosts)},
        )  # fmt: skip
        self.confirm(halo, self.own + np.flatnonzero(wanted[self.own :]))
        return halo

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


def _parted(
    cells: LocalNumbers, kind: NDArray[np.unsignedinteger], count: int
) -> list[LocalNumbers]:
    """Return the cells of each kind, in order, then those of none."""
    own = kind[cells]
    order = np.argsort(own, kind="stable")
    return np.split(cells[order], np.searchsorted(own[order], np.arange(1, count + 1)))


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

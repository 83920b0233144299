"""Ranges of cells in C order: fixed by the model, whole consecutive ones to a rank.

What must hold: the ranges cover 0..cells-1 without gap or overlap; they depend on the model and,
where the ranks do not divide ``RANGES``, on their number, on nothing else; a rank has whole ranges
one after the other, and ranks ascend with them. What is computed a range at a time is then the same
to the bit for 1, 2 and 4 ranks.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices
from lmdsl.ranks.verbs import RankError, Ranks

RANGES = 4  # ranges of a model where the number of ranks divides it


@dataclass(frozen=True, eq=False)
class Division:
    """Ranges of cells, and whose they are."""

    bounds: Indices  # where each range begins, then the number of cells, shape (ranges + 1,)
    firsts: Indices  # the first range of every rank, then the number of ranges, shape (ranks + 1,)

    @property
    def starts(self) -> Indices:
        """The first cell of every rank, then the number of cells, shape (ranks + 1,)."""
        return self.bounds[self.firsts]

    @property
    def cells(self) -> int:
        """Number of all cells."""
        return int(self.bounds[-1])

    def own(self, rank: int) -> tuple[int, int]:
        """Return the first cell of a rank, and the one after its last."""
        starts = self.starts
        return int(starts[rank]), int(starts[rank + 1])

    def own_ranges(self, rank: int) -> list[tuple[int, int]]:
        """Return the ranges of a rank: of each the first cell, and the one after its last."""
        bounds = self.bounds[self.firsts[rank] : self.firsts[rank + 1] + 1].tolist()
        return list(itertools.pairwise(bounds))

    def owner(self, cells: NDArray[np.integer]) -> Indices:
        """Return the rank of every cell."""
        return (np.searchsorted(self.starts[1:], cells, side="right")).astype(np.int64)

    def by_owner(self, cells: NDArray[np.integer]) -> dict[int, Bools]:
        """Return which cells a rank owns, of every rank that owns any."""
        owner = self.owner(cells)
        some = np.flatnonzero(np.bincount(owner, minlength=1)).tolist()
        return {k: owner == k for k in some}

    @classmethod
    def cut(
        cls, pairs: NDArray[np.integer], count: int, cells: NDArray[np.integer] | None = None
    ) -> "Division":
        """Divide cells that have so many pairs each, for ``count`` ranks.

        ``cells`` are so many cells, one after the other, of each entry of ``pairs``; default one.

        The ranges have about equal numbers of pairs: range r begins with the first cell up to
        which a share of r in all of the pairs lies before it. (A cell without a pair counts as one,
        so that cells without any are shared as well.)
        """
        ranges = RANGES if RANGES % count == 0 else count
        weight = np.maximum(np.asarray(pairs, dtype=np.int64), 1)
        every = weight if cells is None else weight * cells
        before = np.concatenate([[0], np.cumsum(every)])  # whole numbers: the same everywhere
        wanted = np.arange(ranges + 1, dtype=np.int64)
        share = (before[-1] // ranges) * wanted + (before[-1] % ranges) * wanted // ranges
        bounds = np.searchsorted(before, share).astype(np.int64)
        if cells is not None and len(weight):  # within equal cells by division, rounded up
            at = np.maximum(bounds - 1, 0)
            first = np.concatenate([[0], np.cumsum(cells)])[at]
            bounds = first - (before[at] - share) // weight[at]
        return cls(bounds, np.arange(count + 1, dtype=np.int64) * (ranges // count))

    def within(self, ranks: Ranks, kept: NDArray[np.bool_]) -> "Division":
        """Return the division of the cells that are kept, numbered anew; ranges stay together.

        ``kept`` tells of the own cells, shape (own,).
        """
        first, _ = self.own(ranks.rank)
        counts = [int(kept[a - first : b - first].sum()) for a, b in self.own_ranges(ranks.rank)]
        every = [count for own in ranks.collect(counts) for count in own]
        bounds = np.concatenate([[0], np.cumsum(every)]).astype(np.int64)
        return Division(bounds, self.firsts)

    def confirm(self, ranks: Ranks) -> None:
        """Refuse ranks that do not all divide the cells alike, or lie about what is theirs."""
        mine = self.bounds.tolist(), self.firsts.tolist(), self.own(ranks.rank)
        found = ranks.collect(mine)
        at = 0
        for rank, (bounds, firsts, (first, last)) in enumerate(found):
            if bounds != mine[0] or firsts != mine[1]:
                raise RankError(f"rank {rank} divides the cells unlike rank {ranks.rank}")
            if first != at or last < first:
                raise RankError(f"rank {rank} says that cells {first} to {last} are its own")
            at = last
        if at != self.cells or len(self.firsts) != ranks.count + 1:
            raise RankError(f"{ranks.count} ranks have {at} of {self.cells} cells")

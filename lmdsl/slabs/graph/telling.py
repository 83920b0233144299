"""What owners tell of their items, to those ranks that ask for them: runs of consecutive numbers.

Who asks for what is agreed once, so that every rank knows what is due from each other one. A
message bears how often was told, and which numbers it is of: a rank that sends another part, of
another size, or of another time is refused.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.ranks.verbs import RankError, Ranks

NumberRuns = list[tuple[int, int]]  # of numbers: the first, and the one after the last


@dataclass(eq=False)
class Telling:
    """What all ranks ask for, of items that each owns a part of.

    Attributes
    ----------
    ranks
        Who talks.
    starts
        The first item of every rank, then the number of items, shape (ranks + 1,).
    asked
        The runs that each rank asks for, in the order in which it wants them.
    told
        How often was told.
    """

    ranks: Ranks
    starts: Indices
    asked: list[NumberRuns]
    told: int = 0

    @classmethod
    def agreed(cls, ranks: Ranks, starts: Indices, runs: NumberRuns) -> Self:
        """Agree who asks for what; collective."""
        return cls(ranks, starts, ranks.collect(runs))

    def heard(self, own: NDArray[Any]) -> NDArray[Any]:
        """Return the items that this rank asks for, of own ones: marks or bytes; collective."""
        ranks, rank = self.ranks, self.ranks.rank
        self.told += 1
        first, last = self.starts[rank : rank + 2].tolist()
        if len(own) != last - first:
            raise RankError(f"rank {rank} tells of {len(own)} items, which are not its own")
        due = {k: parts for k in range(ranks.count) if (parts := self._parts(rank, k))}
        parcels = {}
        for k in range(ranks.count):
            if parts := self._parts(k, rank):
                some = np.concatenate([own[a - first : b - first] for a, b in parts])
                parcels[k] = np.concatenate([_packed(some), self._stamp(parts)])
        marks = own.dtype == np.bool_
        sizes = {k: _size(parts, marks) + 8 + 16 * len(parts) for k, parts in due.items()}
        came = ranks.exchange(parcels, sizes, np.uint8)
        found = {k: self._read(k, came[k], parts, own.dtype) for k, parts in due.items()}
        pieces = [own[:0]]
        for a, b in self.asked[rank]:
            for told in found.values():
                pieces += [items for (c, _), items in told if a <= c < b]
        return np.concatenate(pieces)

    def _parts(self, to: int, of: int) -> NumberRuns:
        """Return the parts of what a rank asks for that another one owns."""
        first, last = self.starts[of : of + 2].tolist()
        cut = ((max(a, first), min(b, last)) for a, b in self.asked[to])
        return [(a, b) for a, b in cut if a < b]

    def _stamp(self, parts: NumberRuns) -> NDArray[np.uint8]:
        """Return the end of a message: how often was told, and of what."""
        numbers = [self.told, *(end for part in parts for end in part)]
        return np.array(numbers, dtype=np.uint64).view(np.uint8)

    def _read(
        self, of: int, message: NDArray[np.uint8], parts: NumberRuns, kind: np.dtype[Any]
    ) -> list[tuple[tuple[int, int], NDArray[Any]]]:
        """Return the items of each part of a message."""
        stamp, marks = self._stamp(parts), kind == np.bool_
        body, end = np.split(message, [len(message) - len(stamp)])
        if not np.array_equal(end[:8], stamp[:8]):
            raise RankError(f"rank {of} tells rank {self.ranks.rank} of another time")
        if not np.array_equal(end, stamp):
            raise RankError(f"rank {of} tells rank {self.ranks.rank} of other items than asked")
        lengths = [b - a for a, b in parts]
        items = np.unpackbits(body, count=sum(lengths)).view(kind) if marks else body.view(kind)
        return [*zip(parts, np.split(items, np.cumsum(lengths)[:-1]), strict=True)]


def _packed(items: NDArray[Any]) -> NDArray[np.uint8]:
    return np.packbits(items) if items.dtype == np.bool_ else items.view(np.uint8)


def _size(parts: NumberRuns, marks: bool) -> int:
    """Return the bytes of the items of parts."""
    count = sum(b - a for a, b in parts)
    return (count + 7) // 8 if marks else count

"""Numbers of cells: which are ghosts, and what they are called on a rank.

Rows have many entries, so that both are a pass over them, with a bit for each cell, or a bucket for
about each ghost.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Indices
from lmdsl.machine.kernels import kernel


def seen(named: NDArray[np.integer], first: int, last: int, end: int) -> Indices | None:
    """Return the cells that are named, ascending, but own ones, first..last-1, and ``end``.

    None where one is no cell 0..end.
    """
    bits = np.zeros(end // 8 + 1, dtype=np.uint8)
    return _set(bits) if _see(np.asarray(named), first, last, end, bits) else None


def localised(
    cells: NDArray[np.integer], first: int, last: int, end: int, ghosts: Indices,
    found: NDArray[np.int32],
) -> bool:  # fmt: skip
    """Write the local numbers of cells; False where one is not own, no ghost and not ``end``."""
    places = _Places(first, last, end, ghosts, *_buckets(ghosts))
    return bool(_localise(np.asarray(cells), places, found))


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


def _set(bits: NDArray[np.uint8]) -> Indices:
    """Return the numbers of bits that are set, ascending."""
    some = np.flatnonzero(bits)
    place, bit = np.nonzero(np.unpackbits(bits[some, None], axis=1, bitorder="little"))
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

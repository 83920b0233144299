"""Where the successors of each cell lie, and how far V fell there.

In a system that moves little in a step, all controls of a cell lead to a few tiles of cells near
it; then what V lost elsewhere does not matter for it. In a system that leads everywhere in one step
tiles say nothing, which a few cells show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl import bellman
from lmdsl.lp import StabilizationLP
from lmdsl.sweeps import ONE

Floats = NDArray[np.float64]

TILES = 1_000
"""Number of tiles, about: few enough to stay in cache."""

ROOM = 24
"""Most tiles that are noted of a cell; one that leads to more may lead anywhere."""

FEW, TRIED = 1_000, 64
"""Cells below which it does not pay, and cells that are looked at first."""


@dataclass(frozen=True)
class Neighbourhoods:
    """The tiles that the pairs of each cell lead to.

    Attributes
    ----------
    tile
        The tile of every cell, shape (n,).
    near
        Tiles that the cell leads to, shape (n, ROOM), of which ``count`` are used.
    count
        Shape (n,); ROOM + 1 stands for all tiles.
    """

    tile: NDArray[np.uint16]
    near: NDArray[np.uint16]
    count: NDArray[np.uint8]

    @classmethod
    def of(cls, lp: StabilizationLP) -> Neighbourhoods | None:
        """Find the tiles; None where cells are few, or most of them lead to many tiles."""
        if lp.n < FEW:
            return None
        tile, attractor = _tiles(lp), np.uint32(lp.n)
        near = np.empty((lp.n, ROOM), dtype=np.uint16)
        count = np.empty(lp.n, dtype=np.uint8)

        def part(cells: tuple[Any, Any]) -> None:
            _note(*cells, *lp.kernel[:3], attractor, tile, near, count)

        tried = np.linspace(0, lp.n - 1, TRIED).astype(np.int64)
        for i in tried:
            part((i, i + 1))
        if np.median(count[tried]) > ROOM:
            return None
        bellman.over_cells(lp, part)
        return cls(tile, near, count)

    def least_ratio(self, before: Floats, after: Floats) -> Floats:
        """Return the least after / before where each cell leads to, at most 1, shape (n,)."""
        least = np.ones(int(self.tile.max()) + 1)
        _least(self.tile, before, after, least)
        ratio = np.empty(len(before))
        _near(self.near, self.count, least, float(least.min()), ratio)
        return ratio


def _tiles(lp: StabilizationLP) -> NDArray[np.uint16]:
    """Cut all axes into as many parts and number the tiles, shape (n,)."""
    partition = lp.partition
    parts = max(1, round(TILES ** (1 / partition.dimension)))
    tile = np.zeros(lp.n, dtype=np.int64)
    for index, cells in zip(partition.multi_index(lp.cells), partition.shape, strict=True):
        tile = tile * parts + index * parts // cells
    return tile.astype(np.uint16)


@njit(cache=True, nogil=True)
def _note(first, last, pair_pointer, pointer, target, attractor, tile, near, count):  # type: ignore[no-untyped-def]
    """Note the tiles of all targets of a range of cells, each once."""
    room = near.shape[1]
    for i in range(np.uint64(first), np.uint64(last)):
        used, before = 0, attractor
        for e in range(pointer[pair_pointer[i]], pointer[pair_pointer[i + ONE]]):
            if target[e] == attractor or tile[target[e]] == before:
                continue
            before = tile[target[e]]
            known = False
            for k in range(used):
                known |= near[i, k] == before
            if not known:
                if used < room:
                    near[i, used] = before
                used += 1
                if used > room:
                    break
        count[i] = used


@njit(cache=True, nogil=True)
def _least(tile, before, after, least):  # type: ignore[no-untyped-def]
    """The least after / before of every tile."""
    for i in range(len(tile)):
        if after[i] < least[tile[i]] * before[i]:
            least[tile[i]] = after[i] / before[i]


@njit(cache=True, nogil=True)
def _near(near, count, least, all_tiles, ratio):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(len(count))):
        r = 1.0
        if count[i] > near.shape[1]:
            r = all_tiles
        else:
            for k in range(np.uint64(count[i])):
                r = min(r, least[near[i, k]])
        ratio[i] = r

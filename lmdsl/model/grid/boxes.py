"""A set of cells as a few boxes: disjoint, axis-aligned, largest first, as far as a count allows.

A box is grown from the cell that is farthest inside the set: face by face, one layer of cells at
a time, until no face can move. Its cells are then taken out and the next box is grown in what is
left, so every box holds cells of the set only and no cell is counted twice. A pass costs one visit
per cell and axis. On a periodic axis boxes grow across the seam.
"""

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, Indices
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.grid.partition import Partition

Ends = dict[str, tuple[float, float]]


class ByNumber(Ends):
    """The ends of cells of a finite model, which are called by number."""


@dataclass(frozen=True, eq=False)
class Region(Frozen):
    """A box of cells.

    Attributes
    ----------
    box
        Its ends on every axis, in the units of the state. Across the seam of a periodic axis the
        second end lies beyond the axis: [0.9, 1.1] on [0, 1] is 0.9 to 1 and 0 to 0.1.
    cells
        Number of cells.
    cell
        Index of a cell in its middle.
    """

    box: Ends
    cells: int
    cell: int

    def __str__(self) -> str:
        return shown(self.box)

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data."""
        return {"box": {name: list(ends) for name, ends in self.box.items()}, "cells": self.cells}


MOST_REGIONS = 8  # number of boxes above which a set of cells is named in part


@dataclass(frozen=True, eq=False)
class Area(Frozen):
    """A set of cells, by region.

    Attributes
    ----------
    cells
        Indices of its cells in the box, ascending.
    regions
        Disjoint boxes of such cells only, largest first.
    elsewhere
        Number of the cells in none of these boxes.
    """

    cells: Indices
    regions: tuple[Region, ...]
    elsewhere: int

    @classmethod
    def of(cls, partition: Partition, cells: Indices, limit: int = MOST_REGIONS) -> Self:
        """Describe cells, given by their indices, with at most ``limit`` boxes."""
        mask = np.zeros(partition.size, dtype=np.bool_)
        mask[cells] = True
        found = regions(partition, mask, limit)
        inside = sum(region.cells for region in found)
        return cls(np.flatnonzero(mask), found, int(mask.sum()) - inside)

    def __len__(self) -> int:
        return len(self.cells)

    def text(self, most: int = 3) -> str:
        """Return the largest boxes, and how many cells lie elsewhere, as text."""
        named = self.regions[:most]
        parts = [f"{region.cells} in {region}" for region in named]
        elsewhere = len(self) - sum(region.cells for region in named)
        return "; ".join([*parts, f"{elsewhere} elsewhere"] if elsewhere else parts)

    __str__ = text

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data: the number of cells and the regions."""
        return {
            "cells": len(self.cells),
            "regions": [region.to_dict() for region in self.regions],
            "elsewhere": self.elsewhere,
        }


def shown(box: Ends) -> str:
    """Return a box as text, such as "x in [0, 1], y in [2, 3]"."""
    if isinstance(box, ByNumber):
        first = {name: (math.ceil(a), math.floor(b)) for name, (a, b) in box.items()}
        return ", ".join(f"{x} {a}" if a == b else f"{x} {a} to {b}" for x, (a, b) in first.items())
    return ", ".join(f"{name} in [{a + 0.0:.6g}, {b + 0.0:.6g}]" for name, (a, b) in box.items())


def regions(partition: Partition, mask: Bools, limit: int) -> tuple[Region, ...]:
    """Return at most ``limit`` disjoint boxes of cells of a mask (N,), largest first."""
    left = mask.copy()
    d = partition.dimension
    shape = partition.cells
    stride = np.ones(d, dtype=np.int64)
    stride[:-1] = np.cumprod(shape[:0:-1])[::-1]
    found: list[Region] = []
    while len(found) < limit and left.any():
        clearance = np.ones(len(left))
        _widest(left, clearance, shape, stride, partition.periodic)
        seed = int(np.argmax(clearance))
        first = seed // stride % shape
        count = np.ones(d, dtype=np.int64)
        _grow(left, shape, stride, partition.periodic, first, count)
        found.append(_region(partition, first, count, stride))
    return tuple(sorted(found, key=lambda region: (-region.cells, region.cell)))


def ends(partition: Partition, first: Indices, count: Indices) -> Ends:
    """Return the ends of ``count`` cells from ``first`` on every axis."""
    box: Ends = ByNumber() if partition.numbered else {}
    for k, name in enumerate(partition.names):
        a, n = int(first[k]), int(count[k])
        low, high, width = (float(v[k]) for v in (partition.low, partition.high, partition.width))
        if n == partition.cells[k]:
            box[name] = (low, high)
            continue
        last = high if a + n == partition.cells[k] else low + (a + n) * width
        first_end = low + a * width
        near = EDGE * width  # so that 0 is shown as 0
        box[name] = (0.0 if abs(first_end) < near else first_end, 0.0 if abs(last) < near else last)
    return box


def of_cell(partition: Partition, cell: int) -> Ends:
    """Return the ends of one cell."""
    first = np.array([int(i) for i in np.unravel_index(cell, partition.shape)])
    return ends(partition, first, np.ones_like(first))


def named(partition: Partition, cell: int) -> str:
    """Return a cell by its index on every axis and its ends, for a message."""
    if partition.numbered:
        return shown(of_cell(partition, cell))
    index = [int(i) for i in np.unravel_index(cell, partition.shape)]
    return f"cell {index} ({shown(of_cell(partition, cell))})"


def _region(partition: Partition, first: Indices, count: Indices, stride: Indices) -> Region:
    middle = int((((first + count // 2) % partition.cells) * stride).sum())
    return Region(ends(partition, first, count), int(np.prod(count)), middle)


@kernel(allocates=True)
def _widest(left, out, shape, stride, periodic):  # type: ignore[no-untyped-def]
    """Multiply ``out`` by the width, on every axis, of the widest symmetric run around a cell."""
    N = len(left)
    for k in range(len(shape)):
        n, s = shape[k], stride[k]
        behind = np.zeros(n, dtype=np.int64)
        for base in range(N // n):
            start = base // s * (n * s) + base % s
            run = 0
            for _ in range(2 if periodic[k] else 1):
                for i in range(n):
                    run = min(run + 1, n) if left[start + i * s] else 0
                    behind[i] = run
            run = 0
            for turn in range(2 if periodic[k] else 1):
                for i in range(n - 1, -1, -1):
                    run = min(run + 1, n) if left[start + i * s] else 0
                    if turn == (1 if periodic[k] else 0):
                        width = 2 * min(run, behind[i]) - 1
                        out[start + i * s] *= max(min(width, n), 0)


@kernel(allocates=True)
def _grow(left, shape, stride, periodic, first, count):  # type: ignore[no-untyped-def]
    """Grow a box until every face is blocked, and take its cells out of ``left``.

    A blocked face stays blocked: the layer beyond it only grows.
    """
    d = len(shape)
    blocked = np.zeros((d, 2), dtype=np.bool_)
    moving = True
    while moving:
        moving = False
        for k in range(d):
            for side in range(2):
                if blocked[k, side] or count[k] == shape[k]:
                    continue
                at = first[k] - 1 if side == 0 else first[k] + count[k]
                if periodic[k]:
                    at %= shape[k]
                if at < 0 or at >= shape[k] or not _layer(left, shape, stride, first, count, k, at):
                    blocked[k, side] = True
                    continue
                if side == 0:
                    first[k] = at
                count[k] += 1
                moving = True
    for at in range(first[0], first[0] + count[0]):
        _layer(left, shape, stride, first, count, 0, at % shape[0], True)


@kernel
def _layer(left, shape, stride, first, count, axis, at, take=False):  # type: ignore[no-untyped-def]
    """Say whether a layer of the box at a place of an axis is all there; or take it out."""
    d = len(shape)
    total = 1
    for k in range(d):
        if k != axis:
            total *= count[k]
    for number in range(total):
        rest, cell = number, at * stride[axis]
        for k in range(d - 1, -1, -1):
            if k != axis:
                cell += (first[k] + rest % count[k]) % shape[k] * stride[k]
                rest //= count[k]
        if take:
            left[cell] = False
        elif not left[cell]:
            return False
    return True

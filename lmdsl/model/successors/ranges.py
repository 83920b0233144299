"""Index ranges: the cells that the image of a whole cell can meet, for every pair.

Of a pair, and of every part of the noise, a range on each axis: first and last index, on a circle
before the modulus. The cells that the image can meet are their product.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices, Progress
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.asked import Asked
from lmdsl.model.assembly.estimates import Outlook
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import counting
from lmdsl.model.successors.following import judging
from lmdsl.model.successors.slabs import Slab, Slabs, Span, blocks
from lmdsl.problem.problem import Problem

PAIRS = 2**18  # number of pairs whose ranges are worked on at a time


@dataclass(frozen=True, eq=False)
class Ranges:
    """The cells that images can meet.

    Attributes
    ----------
    first, last
        Shape (pairs, parts, d), of a small integer type: on each axis the first and the last index;
        on a circle first in 0..cells-1 and last below 2 cells. Of a step that surely enters the
        attractor on its way, some cell of it.
    out
        Which pairs can leave the box or enter avoid, on the way or at the end, or be undefined,
        shape (pairs,); their ranges mean nothing.
    """

    first: NDArray[Any]
    last: NDArray[Any]
    out: Bools


def enclosed(
    problem: Problem,
    partition: Partition,
    sets: CellSets,
    pairs: tuple[Indices, NDArray[np.integer]],
    deadline: Deadline,
    progress: Progress | None = None,
    windowed: bool = False,
) -> Ranges:
    """Return the ranges of pairs.

    Parameters
    ----------
    problem, partition, sets
        What is enclosed, and what decides.
    pairs
        Cells of the box and controls, ordered by cell, then control.
    deadline, progress
        As for :func:`lmdsl.compile`.
    windowed
        Whether sums are made of those cells only that the pairs can meet: of a part of the box.
    """
    grid = Slabs(problem, partition, deadline)
    cell, control = pairs
    followed = judging(problem, partition, sets, cell, grid.guard, windowed)
    count, parts, d = len(cell), grid.encloser.parts, partition.dimension
    kind = number_type(partition)
    memory.require(2 * count * parts * d * kind.itemsize, "the successors of all pairs")
    found = Ranges(
        np.zeros((count, parts, d), dtype=kind),
        np.zeros((count, parts, d), dtype=kind),
        np.zeros(count, dtype=np.bool_),
    )
    work = list(_with_pairs(grid, cell, control))

    def fill(part: tuple[Slab, int, int]) -> None:
        block, start, end = part
        every = list(grid.stretches(block))
        admitted = grid.admits(block)
        for begin in range(start, end, PAIRS):
            some = slice(begin, min(begin + PAIRS, end))
            at = _place(partition, block, cell[some], control[some])
            lost, judge = np.zeros((len(at[0]), parts), dtype=np.uint8), followed()
            for spans, seen in every:
                first, last, out = taken(spans, at, partition, parts)
                way = pairwise(seen, at, parts)
                judge(first, last, out, way, lost)
            found.first[some], found.last[some] = first, last
            found.out[some] = (lost == counting.LOST).any(axis=1)
            if admitted is not None:
                found.out[some] |= ~admitted.reshape(-1)[_offset(admitted.shape[:-1], at)]

    asked = Asked(grid.encloser.true_map.map)  # a user's function, which threads may not share
    outlook = Outlook("enclosing the images of whole cells takes")
    with asked.helped():
        for (_, _, end), _ in zip(work, asked.in_order(fill, work, deadline.cancel), strict=True):
            outlook.done(end / max(count, 1))
            if progress:
                progress("enclose", end / max(count, 1))
    return found


def pairwise(holds: Bools | None, at: list[Indices], parts: int) -> Bools:
    """Return what holds of pairs, shape (pairs, parts)."""
    if holds is None:
        return np.zeros((len(at[0]), parts), dtype=np.bool_)
    found = holds.reshape(-1, holds.shape[-1])[_offset(holds.shape[:-1], at)]
    return np.ascontiguousarray(np.broadcast_to(found, (len(at[0]), parts)))


def taken(
    spans: list[Span], at: list[Indices], partition: Partition, parts: int
) -> tuple[NDArray[Any], NDArray[Any], Bools]:
    """Return first and last index of pairs, shape (pairs, parts, d), and which are out."""
    count, kind = len(at[0]), number_type(partition)
    first, last = (np.zeros((count, parts, len(spans)), dtype=kind) for _ in range(2))
    out = np.zeros((count, parts), dtype=np.bool_)
    for k, (low, high) in enumerate(spans):
        place = _offset(low.shape[:-1], at)
        least, most = (x.reshape(-1, x.shape[-1])[place] for x in (low, high))
        missing = np.isnan(least)
        out |= missing
        least, most = np.where(missing, 0.0, least), np.where(missing, 0.0, most)
        if partition.periodic[k]:
            n = float(partition.cells[k])
            whole = most - least >= n - 1
            turn = np.where(whole, least, np.floor(least / n) * n)
            least, most = least - turn, np.where(whole, n - 1, most - turn)
        first[:, :, k], last[:, :, k] = least, most
    return first, last, out


def number_type(partition: Partition) -> Any:
    """Return the type of indices up to twice the cells of an axis."""
    return np.dtype(np.int16 if partition.cells.max() < 2**14 else np.int32)


def _place(
    partition: Partition, block: Slab, cell: Indices, control: NDArray[np.integer]
) -> list[Indices]:
    """Return the place of pairs in a block, axis by axis."""
    index = partition.multi_index(cell)
    at = [k - span[0] for k, span in zip(index, block.spans, strict=True)]
    return [*at, control.astype(np.int64) - block.controls[0]]


def _offset(shape: tuple[int, ...], at: list[Indices]) -> Indices:
    """Return where places lie in a flat array of which some axes are 1 long."""
    place = np.zeros(len(at[0]), dtype=np.int64)
    for length, index in zip(shape, at, strict=False):
        place = place * length + (index if length > 1 else 0)
    return place


def _with_pairs(
    grid: Slabs, cell: Indices, control: NDArray[np.integer]
) -> Iterator[tuple[Slab, int, int]]:
    """Yield blocks that hold pairs, and which: from the one to before the other."""
    M, at = grid.controls.shape[1], 0
    lane = cell.astype(np.int64) * M + control
    for block, beyond in blocks(grid):
        last = beyond * M if block.controls[1] == M else (beyond - 1) * M + block.controls[1]
        end = int(np.searchsorted(lane, last))
        if end > at:
            yield block, at, end
        at = end

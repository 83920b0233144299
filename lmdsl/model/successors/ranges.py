"""Index ranges: the cells that the image of a whole cell can meet, for every pair.

Of a pair, and of every part of the noise, a range on each axis: first and last index, on a circle
before the modulus. The cells that the image can meet are their product. Boxes are enclosed for
whole blocks of cells, controls and parts at a time, each axis in the shape of what it depends on;
where the enclosure is too wide all cells are cut along an axis, and the ranges of the pieces are
joined.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, Progress
from lmdsl.formulas.intervals import Interval
from lmdsl.machine import memory, threads
from lmdsl.machine.deadline import Deadline
from lmdsl.model.discretization import control_vectors, offsets
from lmdsl.model.grid.axis import AxisCells
from lmdsl.model.grid.partition import Partition
from lmdsl.model.successors.domains import Domain, domains
from lmdsl.model.successors.enclosing import Boxes, Encloser
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem

LANES = 2**19  # number of boxes, each with its control, that are enclosed at a time
PROBED = 2**10  # number of pairs on which it is found out how far to cut
PIECES = 32  # most pieces of a cell
TARGET = 0.01  # excess of an enclosure, in cells, up to which cells are not cut any further
SHARE = 0.95  # share of the pairs for which that must hold


@dataclass(frozen=True, eq=False)
class Ranges:
    """The cells that images can meet.

    Attributes
    ----------
    first, last
        Shape (pairs, parts, d), of a small integer type: on each axis the first and the last index;
        on a circle first in 0..cells-1 and last below 2 cells.
    out
        Which pairs can leave the box or be undefined, shape (pairs,); their ranges mean nothing.
    """

    first: NDArray[Any]
    last: NDArray[Any]
    out: Bools


class Block(NamedTuple):
    """A product of cells with all controls from ``controls[0]`` to before ``controls[1]``.

    Attributes
    ----------
    spans
        On each axis the first cell and the one after the last.
    controls
        The same of the controls.
    """

    spans: tuple[tuple[int, int], ...]
    controls: tuple[int, int]


class Grid:
    """Encloses blocks of cells.

    Attributes
    ----------
    pieces
        Number of pieces into which cells are cut along each axis.
    """

    def __init__(self, problem: Problem, partition: Partition, deadline: Deadline) -> None:
        self.partition = partition
        self.guard = partial(deadline.raise_if_over, "enclosing images")
        self.encloser = Encloser(TrueMap(problem, partition))
        self.domains: tuple[Domain, ...] = domains(partition, offsets(problem))
        self.controls = np.ascontiguousarray(control_vectors(problem).T)
        self.pieces = self._cut()

    @property
    def axes(self) -> int:
        """Number of axes of arrays: those of the states, the controls, the parts of the noise."""
        return self.partition.dimension + 2

    def _cut(self) -> tuple[int, ...]:
        """Find out on some pairs how far cells have to be cut."""
        partition, rng = self.partition, np.random.default_rng(0)
        cell = rng.integers(partition.size, size=PROBED)
        index = partition.multi_index(cell)
        control = self.controls[:, rng.integers(self.controls.shape[1], size=PROBED)]
        part = rng.integers(self.encloser.parts, size=PROBED)
        noise = [Interval(w.low[part], w.high[part]) for w in self.encloser.noise]
        pieces = [1] * partition.dimension
        while True:
            where = rng.random((partition.dimension, PROBED))
            states = []
            for k, domain in enumerate(self.domains):
                low, high = domain.low[index[k]], domain.high[index[k]]
                step = (high - low) / pieces[k]
                start = low + np.floor(where[k] * pieces[k]) * step
                states.append(Interval(start, start + step))
            excess = self.encloser.excess(Boxes(states, [*control], noise), self.guard)
            worst = [float(np.quantile(e, SHARE)) for e in excess[: partition.dimension]]
            if sum(worst) <= TARGET or math.prod(pieces) >= PIECES or not np.isfinite(worst).all():
                return tuple(pieces)
            pieces[int(np.argmax(worst))] *= 2

    def ranges(self, block: Block) -> tuple[list[tuple[Floats, Floats]], tuple[int, ...]]:
        """Return first and last index on every axis, NaN where out, and the shape of the block.

        Each array has the axes of the block (cells by axis, controls, parts), 1 long where the
        image does not depend on it.
        """
        partition, d = self.partition, self.partition.dimension

        def along(array: Floats, axis: int) -> Floats:
            return array.reshape([-1 if k == axis else 1 for k in range(self.axes)])

        states, positions = [], []
        for k, domain in enumerate(self.domains):
            positions.append(domain.positions(*block.spans[k]))
            ends = domain.pieces(positions[k], self.pieces[k])
            states.append(Interval(*(along(end, k) for end in ends)))
        controls = [along(u[slice(*block.controls)], d) for u in self.controls]
        noise = [Interval(*(along(end, d + 1) for end in w)) for w in self.encloser.noise]
        images = self.encloser(Boxes(states, controls, noise), self.guard)
        found = []
        for image, axis in zip(images, partition.axes, strict=True):
            span = numbers(axis, image, partition.clip)
            for k in range(d):
                span = self._joined(span, k, len(positions[k]), block.spans[k], axis)
            found.append(span)
        sizes = [end - start for start, end in block.spans]
        return found, (*sizes, controls_of(block), self.encloser.parts)

    def _joined(
        self,
        span: tuple[Floats, Floats],
        k: int,
        positions: int,
        cells: tuple[int, int],
        axis: AxisCells,
    ) -> tuple[Floats, Floats]:
        """Join the ranges of the pieces of cells along axis k, and that of the seam to the first.

        ``axis`` is that on which the ranges lie.
        """
        first, last = span
        if first.shape[k] == 1 and positions * self.pieces[k] > 1:
            return span  # it does not depend on the place
        shape = (*first.shape[:k], positions, self.pieces[k], *first.shape[k + 1 :])
        first, last = first.reshape(shape), last.reshape(shape)
        here = (slice(None),) * (k + 1)
        ends = first[(*here, 0)], last[(*here, 0)]
        for piece in range(1, self.pieces[k]):
            ends = union(ends, (first[(*here, piece)], last[(*here, piece)]), axis)
        if positions == cells[1] - cells[0]:
            return ends
        before = (slice(None),) * k  # the seam is the first cell's too
        seam = tuple(end[(*before, slice(-1, None))] for end in ends)
        first, last = (end[(*before, slice(0, -1))].copy() for end in ends)
        start = (*before, slice(0, 1))
        first[start], last[start] = union((first[start], last[start]), seam, axis)
        return first, last


def controls_of(block: Block) -> int:
    """Return the number of controls of a block."""
    return block.controls[1] - block.controls[0]


def numbers(axis: AxisCells, image: Interval, clip: bool) -> tuple[Floats, Floats]:
    """Return first and last index that an interval meets; both are NaN where it can be out."""
    first, last = axis.number(image.low, clip), axis.number(image.high, clip)
    return np.where(np.isnan(last), np.nan, first), np.where(np.isnan(first), np.nan, last)


def union(
    a: tuple[Floats, Floats], b: tuple[Floats, Floats], axis: AxisCells
) -> tuple[Floats, Floats]:
    """Return a range that holds both: on a circle the second is turned next to the first."""
    first, last = b
    if axis.periodic:
        turn = np.round((a[0] + a[1] - first - last) / (2 * axis.cells)) * axis.cells
        first, last = first + turn, last + turn
    return np.minimum(a[0], first), np.maximum(a[1], last)


def enclosed(
    problem: Problem,
    partition: Partition,
    cell: Indices,
    control: Indices,
    deadline: Deadline,
    progress: Progress | None = None,
) -> Ranges:
    """Return the ranges of pairs.

    Parameters
    ----------
    problem, partition
        What is enclosed.
    cell, control
        The pairs: cells of the box and controls, ordered by cell, then control.
    deadline, progress
        As for :func:`lmdsl.compile`.
    """
    grid = Grid(problem, partition, deadline)
    pairs, parts, d = len(cell), grid.encloser.parts, partition.dimension
    kind = np.min_scalar_type(-2 * int(partition.cells.max()))
    memory.require(2 * pairs * parts * d * kind.itemsize, "the successors of all pairs")
    first, last = (np.zeros((pairs, parts, d), dtype=kind) for _ in range(2))
    out = np.zeros(pairs, dtype=np.bool_)

    def fill(work: tuple[Block, int, int]) -> None:
        block, start, end = work
        some = slice(start, end)
        spans, shape = grid.ranges(block)
        at = [
            index - span[0]
            for index, span in zip(partition.multi_index(cell[some]), block.spans, strict=True)
        ]
        at.append(control[some] - block.controls[0])
        for k, (low, high) in enumerate(spans):
            place = np.zeros(end - start, dtype=np.int64)
            for j, index in enumerate(at):
                place = place * low.shape[j] + (index if low.shape[j] > 1 else 0)
            for number, (least, most) in enumerate(zip(*(
                x.reshape(-1, x.shape[-1]).T for x in (low, high)), strict=True)):  # fmt: skip
                parts_of = slice(None) if low.shape[-1] == 1 else number
                a, b = least[place], most[place]
                missing = np.isnan(a)
                out[some] |= missing
                a, b = np.where(missing, 0.0, a), np.where(missing, 0.0, b)
                if partition.periodic[k]:
                    n = float(partition.cells[k])
                    around = b - a >= n - 1
                    turn = np.where(around, a, np.floor(a / n) * n)
                    a, b = a - turn, np.where(around, n - 1, b - turn)
                first[some, parts_of, k] = a[:, None] if low.shape[-1] == 1 else a
                last[some, parts_of, k] = b[:, None] if low.shape[-1] == 1 else b

    blocks = list(_with_pairs(grid, cell, control))
    done = 0
    for (_, _, end), _ in zip(blocks, threads.in_order(fill, blocks, deadline.cancel), strict=True):
        done = end
        if progress:
            progress("enclose", done / max(pairs, 1))
    return Ranges(first, last, out)


def _with_pairs(
    grid: Grid, cell: Indices, control: Indices
) -> Iterator[tuple[Block, int, int]]:
    """Yield blocks that hold pairs, and which: from the one to before the other."""
    M, at = grid.controls.shape[1], 0
    for block, cells_end in _blocks(grid):
        lane = cells_end * M if block.controls[1] == M else (cells_end - 1) * M + block.controls[1]
        end = int(_search(cell, control, M, lane, at))
        if end > at:
            yield block, at, end
        at = end


def _search(cell: Indices, control: Indices, M: int, lane: int, start: int) -> int:
    """Return the first pair at or behind a lane (cell times M plus control)."""
    low, high = start, len(cell)
    while low < high:
        middle = (low + high) // 2
        if int(cell[middle]) * M + int(control[middle]) < lane:
            low = middle + 1
        else:
            high = middle
    return low


def _blocks(grid: Grid) -> Iterator[tuple[Block, int]]:
    """Yield blocks in the order of the cells, and the cell after their last.

    They are the largest products of consecutive cells that take no more than LANES boxes.
    """
    shape, M = grid.partition.shape, grid.controls.shape[1]
    depends = _dependence(grid)

    def fits(spans: list[int], controls: int) -> bool:
        lengths = [n * q for n, q in zip(spans, grid.pieces, strict=True)]
        lengths += [controls, grid.encloser.parts]
        most = (math.prod(n for n, on in zip(lengths, row, strict=True) if on) for row in depends)
        return max(most) <= LANES

    sizes = ((k, n) for k in range(len(shape)) for n in _halved(shape[k]))
    k, length = next(
        ((k, n) for k, n in sizes if fits([1] * k + [n, *shape[k + 1 :]], M)), (len(shape) - 1, 1)
    )
    width = next((n for n in _halved(M) if length > 1 or fits([1] * len(shape), n)), 1)
    inner, rest = math.prod(shape[k + 1 :]), tuple((0, n) for n in shape[k + 1 :])
    for number, outer in enumerate(np.ndindex(*shape[:k])):
        for start in range(0, shape[k], length):
            end = min(start + length, shape[k])
            spans = (*((i, i + 1) for i in outer), (start, end), *rest)
            for a in range(0, M, width):
                yield Block(spans, (a, min(a + width, M))), (number * shape[k] + end) * inner


def _halved(n: int) -> Iterator[int]:
    """Yield n, its half and so on, rounded up, to 1."""
    while n > 1:
        yield n
        n = (n + 1) // 2
    yield 1


def _dependence(grid: Grid) -> list[list[bool]]:
    """Return for every axis of the image on which axes of a block it depends."""
    spans = tuple((0, min(2, int(n))) for n in grid.partition.cells)
    found, _ = grid.ranges(Block(spans, (0, min(2, grid.controls.shape[1]))))
    return [[n > 1 for n in low.shape] for low, _ in found]

"""Enclosures of blocks of cells under all controls: index ranges, each in its own small shape.

Of a block, and of every part of the noise, the image and the stretches of the path meet a range of
cells on each axis. Where enclosures are too wide all cells are cut along an axis, and the ranges
of the pieces are joined: their hull, on a circle turned next to each other.
"""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.program import Program
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import fixed
from lmdsl.model.discretization import control_vectors, offsets
from lmdsl.model.grid.axis import AxisCells
from lmdsl.model.grid.partition import Partition
from lmdsl.model.successors import counting
from lmdsl.model.successors.assumed import encloser_of
from lmdsl.model.successors.compiled.stretches import CompiledEncloser
from lmdsl.model.successors.domains import Domain, domains
from lmdsl.model.successors.enclosing import MOST_PARTS, StepBoxes, Stretch
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem

# Number of boxes, each with its control, that are enclosed at a time: that stay in cache; and up to
# the other number where these stand for many more.
LANES, MOST_LANES, SHARED = 2**14, 2**19, 8
MOST_DOUBLES = 2**23  # of stretches that are kept at a time
PROBED = 2**10  # number of pairs on which it is found out how far to cut
PIECES = 16  # most pieces of a cell
TARGET = 0.03  # excess of an enclosure, in cells, up to which cells are not cut any further
SHARE = 0.95  # share of the pairs for which that must hold

Span = tuple[Floats, Floats]  # first and last index, before the modulus; NaN where it can be out


class Slab(NamedTuple):
    """A product of cells with some of the controls.

    Attributes
    ----------
    spans
        On each axis the first cell and the one after the last.
    controls
        The first control and the one after the last.
    parts
        How many parts of the noise at most; None: all.
    """

    spans: tuple[tuple[int, int], ...]
    controls: tuple[int, int]
    parts: int | None = None


class Slabs:
    """Encloses blocks of cells.

    Attributes
    ----------
    encloser
        Of the map.
    path
        Whether the way of a step is judged, too.
    pieces
        Number of pieces into which cells are cut along each axis.
    """

    def __init__(self, problem: Problem, partition: Partition, deadline: Deadline) -> None:
        self.partition = partition
        self.guard = partial(deadline.raise_if_over, "enclosing images")
        self.encloser = encloser_of(TrueMap(problem, partition))
        self.path = problem.judged == "path"
        self.domains: tuple[Domain, ...] = domains(partition, offsets(problem))
        self.controls = np.ascontiguousarray(control_vectors(problem).T)
        self.admitted: Program | None = problem.admitted()
        self.names = (*problem.states, *problem.controls)
        self.pieces = self._cut()
        self.fast = CompiledEncloser.of(self.encloser, self.path)

    def _cut(self) -> tuple[int, ...]:
        """Find out on some pairs how far cells, and arcs, have to be cut."""
        partition, rng = self.partition, np.random.default_rng(0)
        index = partition.multi_index(rng.integers(partition.size, size=PROBED))
        control = self.controls[:, rng.integers(self.controls.shape[1], size=PROBED)]
        part = rng.integers(self.encloser.parts, size=PROBED)
        noise = [Interval(w.low[part], w.high[part]) for w in self.encloser.noise]
        pieces, where = [1] * partition.dimension, rng.random((partition.dimension, PROBED))
        while True:
            states = []
            for k, domain in enumerate(self.domains):
                low, high = domain.low[index[k]], domain.high[index[k]]
                step = (high - low) / pieces[k]
                start = low + np.floor(where[k] * pieces[k]) * step
                states.append(Interval(start, start + step))
            boxes = StepBoxes(states, [*control], noise)
            excess = self.encloser.excess(boxes, self.guard)[: partition.dimension]
            worst = [_most(e) for e in excess]
            if sum(worst) <= TARGET or math.prod(pieces) >= PIECES or not np.isfinite(worst).all():
                break
            pieces[int(np.argmax(worst))] *= 2
        if self.path:
            far = _most(self.encloser.speed(boxes, self.guard))
            cuts = math.ceil(2 * far) if far < MOST_PARTS else MOST_PARTS
            self.encloser.arc_parts = min(max(cuts, 1), MOST_PARTS)
        return tuple(pieces)

    def along(self, array: Floats, axis: int) -> Floats:
        """Return an array as one of the axes of a block: states, controls, parts of the noise."""
        axes = self.partition.dimension + 2
        return array.reshape([-1 if k == axis else 1 for k in range(axes)])

    def stretches(self, block: Slab) -> Iterator[tuple[list[Span], Bools | None]]:
        """Yield by axis where the stretches of the path lie, in order, and last the images.

        With the stretches comes whether they are judged, see :class:`Stretch`.

        Each array has the axes of the block, 1 long where it does not depend on one.
        """
        fast = self.fast or self.encloser
        for stretch in fast.stretches(self._boxes(block), self.path, self.guard):
            judged = stretch.judged
            seen = None if judged is None else self._everywhere(block, judged)
            yield self._spans(block, stretch), seen

    def admits(self, block: Slab) -> Bools | None:
        """Return on which cells the condition of admissible pairs certainly holds; None: all."""
        if self.admitted is None:
            return None
        boxes = self._boxes(block)
        values = dict(zip(self.names, (*boxes.states, *map(Interval.point, boxes.controls)),
                          strict=True))  # fmt: skip
        return self._everywhere(block, self.admitted.decide(values, self.guard)[0][0])

    def _everywhere(self, block: Slab, holds: Any) -> Bools:
        """Return on which cells something holds, from the pieces on which it does."""
        surely, axes = np.asarray(holds, dtype=np.float64), self.partition.dimension + 2
        surely = surely.reshape((1,) * (axes - surely.ndim) + surely.shape)
        for k in range(self.partition.dimension):
            surely, _ = self._joined((surely, -surely), k, block, None)
        return np.asarray(surely > 0)

    def _boxes(self, block: Slab) -> StepBoxes:
        d = self.partition.dimension
        states = []
        for k, (domain, span) in enumerate(zip(self.domains, block.spans, strict=True)):
            ends = domain.pieces(domain.positions(*span), self.pieces[k])
            states.append(Interval(*(self.along(end, k) for end in ends)))
        controls = [self.along(u[slice(*block.controls)], d) for u in self.controls]
        some = slice(block.parts)
        noise = [
            Interval(*(self.along(end[some], d + 1) for end in w)) for w in self.encloser.noise
        ]
        return StepBoxes(states, controls, noise)

    def _spans(self, block: Slab, stretch: Stretch) -> list[Span]:
        partition, found = self.partition, []
        for axis in range(partition.dimension):
            own = self.domains[axis].positions(*block.spans[axis]).astype(np.float64)
            own = self.along(np.repeat(own, self.pieces[axis]), axis)
            span = met(stretch, axis, partition, own)
            for k in range(partition.dimension):
                span = self._joined(span, k, block, partition.axes[axis])
            found.append(span)
        return found

    def _joined(self, span: Span, k: int, block: Slab, axis: AxisCells | None) -> Span:
        """Join the ranges of the pieces of cells along axis k, and that of the seam to the first.

        ``axis`` is that on which the ranges lie.
        """
        positions = len(self.domains[k].positions(*block.spans[k]))
        shape = span[0].shape
        if shape[k] == 1 and positions * self.pieces[k] > 1:
            return span  # it does not depend on the place
        ends = span
        if self.pieces[k] > 1:
            flat = (math.prod(shape[:k]) * positions, self.pieces[k], math.prod(shape[k + 1 :]))
            ends = _hull(span, flat, axis, (*shape[:k], positions, *shape[k + 1 :]))
        cells = block.spans[k][1] - block.spans[k][0]
        if positions == cells:
            return ends
        seam = _part(ends, k, slice(cells, None))  # the first cell's too
        joined = union(_part(ends, k, slice(0, 1)), seam, axis)
        rest = _part(ends, k, slice(1, cells))
        return (
            np.concatenate([joined[0], rest[0]], axis=k),
            np.concatenate([joined[1], rest[1]], axis=k),
        )


def _most(x: Floats) -> float:
    """Return what all but a few are below, infinite numbers among them."""
    ordered = np.sort(np.ravel(x))
    return float(ordered[math.ceil(SHARE * len(ordered)) - 1])


def _hull(
    span: Span, pieces: tuple[int, int, int], axis: AxisCells | None, shape: tuple[int, ...]
) -> Span:
    """Return what holds all pieces, the middle of three axes; on a circle turned next to others."""
    first, last = (fixed(np.ascontiguousarray(end).reshape(pieces)) for end in span)
    least, most = (np.empty((pieces[0], pieces[2])) for _ in range(2))
    circle = axis.cells if axis is not None and axis.periodic else 0.0
    counting.join(first, last, circle, least, most)
    return least.reshape(shape), most.reshape(shape)


def _part(span: Span, axis: int, where: int | slice) -> Span:
    """Return a part of a span along an axis."""
    at = (*(slice(None),) * axis, where)
    return span[0][at], span[1][at]


def met(stretch: Stretch, k: int, partition: Partition, own: Floats) -> Span:
    """Return first and last index on axis k that a stretch meets; both are NaN where it can be out.

    ``own`` is the index of where it begins: a path that only rises meets none below.
    """
    axis, place = partition.axes[k], stretch.places[k]
    first, last = (axis.number(end, partition.clip) for end in place)
    if stretch.rises:  # from a state, which is not out
        first = np.where(stretch.rises[k], np.fmax(first, own), first)
        last = np.where(stretch.falls[k], np.fmin(last, own), last)
    return np.where(np.isnan(last), np.nan, first), np.where(np.isnan(first), np.nan, last)


def union(a: Span, b: Span, axis: AxisCells | None) -> Span:
    """Return a range that holds both: on a circle the second is turned next to the first."""
    first, last = b
    if axis is not None and axis.periodic:
        turn = np.round((a[0] + a[1] - first - last) / (2 * axis.cells)) * axis.cells
        first, last = first + turn, last + turn
    return np.minimum(a[0], first), np.maximum(a[1], last)


def blocks(grid: Slabs) -> Iterator[tuple[Slab, int]]:
    """Yield blocks in the order of the cells, and the cell after their last.

    They are the largest products of consecutive cells that take no more boxes than fit.
    """
    shape, M = grid.partition.shape, grid.controls.shape[1]
    limit = max(LANES, min(MOST_LANES, grid.partition.size * M // SHARED))
    limit = min(limit, MOST_DOUBLES // grid.fast.size) if grid.fast else limit
    small = Slab(tuple((0, min(2, n)) for n in shape), (0, min(2, M)), 2)
    depends = [[n > 1 for n in low.shape] for spans, _ in grid.stretches(small) for low, _ in spans]

    def fits(spans: list[int], controls: int) -> bool:
        lengths = [n * q for n, q in zip(spans, grid.pieces, strict=True)]
        lengths += [controls, grid.encloser.parts]
        most = (math.prod(n for n, on in zip(lengths, row, strict=True) if on) for row in depends)
        return bool(max(most) <= limit)

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
                yield Slab(spans, (a, min(a + width, M))), (number * shape[k] + end) * inner


def _halved(n: int) -> Iterator[int]:
    """Yield n, its half and so on, rounded up, to 1."""
    while n > 1:
        yield n
        n = (n + 1) // 2
    yield 1

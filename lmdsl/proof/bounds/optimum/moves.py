"""What every control may do on every part of every cell: ranges of parts, and least costs.

Cells are cut into 2^``split`` equal parts by axis, numbered in C order of the finer grid. The image
of a part under a control and a part of the noise is enclosed and located as boxes of a proof are
(images/), and is kept as a range of parts on every axis, which wraps on circles.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Guard, Indices, Statuses
from lmdsl.machine import memory, threads
from lmdsl.model.discretization import control_vectors, node_count
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.compiled import enclosing, places, tapes
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.noise import NoiseNormal
from lmdsl.problem.problem import Problem
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.proof.images.pieces import pieces

AT_A_TIME = 2**14  # most boxes enclosed at a time by a thread
DEEPEST = 20  # bisections of an axis


class Moves(NamedTuple):
    """What a part may do, by row: its pieces (two at a seam), its controls, the parts of noise.

    Attributes
    ----------
    span
        First and last part on every axis that is met, shape (rows, d, 2), in parts of the axis;
        the last may be a turn further, and is below the first where none is met.
    cost
        At least what is paid, >= 0, infinite where the control is surely not admissible.
    enters
        Whether the path may enter the attractor.
    seam
        By part: the piece at the other end of a circle, -1 where there is none; then by piece.
    """

    span: NDArray[np.int32]
    cost: Floats
    enters: Bools
    seam: NDArray[np.int32]


class Game:
    """A problem as the choice of controls sees it: its map, its noise and what it costs.

    Attributes
    ----------
    problem, partition, status
        The problem, its cells, and what they are, shape (N,).
    control
        Every control of the grid, shape (M, p).
    weight
        Of the parts of the noise, shape (R,).
    entry
        What is paid at least on entering the attractor: by cell, (N,), infinite elsewhere.
    negative
        Whether an enclosure lets a cost be negative, which is then assumed not to be.
    """

    def __init__(
        self, problem: Problem, partition: Partition, status: Statuses, entry: Floats,
        slack: float = 0.0,
    ) -> None:  # fmt: skip
        self.problem, self.partition, self.status = problem, partition, status
        self.control, self.slack = control_vectors(problem), slack
        self.noise, self.weight = noise_parts(problem)
        self.step, self.admitted = tapes.step(problem), tapes.admitted(problem)
        self.negative = bool((entry < 0).any())
        self.entry = np.maximum(entry, 0.0)
        self.axes = np.array(partition.axes, dtype=np.float64)
        kind = np.zeros(len(status), dtype=np.int64)
        if absorbed_on_way(problem.local_controller):
            kind[status == CellStatus.ATTRACTOR] = places.MAY_ARRIVE
        self.kind, self.avoided = kind, status == CellStatus.AVOID

    @property
    def factor(self) -> float:
        """What the cost after a step counts."""
        return self.problem.gamma * (self.problem.discount or 1.0)

    def row_bytes(self) -> int:
        """Return the bytes of a row, with what is held while rows are made."""
        return 8 * self.partition.dimension + 9

    def moves(self, grid: Parts, guard: Guard) -> Moves:
        """Return what every control may do on every part."""
        part = np.arange(grid.size)
        cell = grid.cell(self.partition, part)
        place = grid.by_axis(part) & ((1 << grid.split) - 1)
        split = np.broadcast_to(grid.split, place.shape)
        boxes = pieces(self.partition, cell, split, place)
        seam = np.full(len(boxes.owner), -1, dtype=np.int32)
        last = np.arange(grid.size)
        for piece in range(grid.size, len(boxes.owner)):  # few: those at seams
            seam[last[boxes.owner[piece]]] = piece
            last[boxes.owner[piece]] = piece
        each, d = len(self.control) * len(self.weight), self.partition.dimension
        rows = len(boxes.owner) * each
        memory.require(2.0 * self.row_bytes() * rows, "the moves of all controls")
        found = Moves(
            np.empty((rows, d, 2), dtype=np.int32), np.empty(rows), np.empty(rows, dtype=np.bool_),
            seam,
        )  # fmt: skip
        some = max(AT_A_TIME // each, 1)

        def fill(start: int) -> bool:
            guard()
            at = slice(start, start + some)
            chosen = boxes._replace(**{n: getattr(boxes, n)[at] for n in boxes._fields})
            return self._fill(grid, cell[chosen.owner], chosen, found, start * each)

        free = range(0, len(boxes.owner), some)
        self.negative |= any(threads.each(fill, list(free)))
        return found

    def _fill(self, grid, cell, boxes, found: Moves, at: int) -> bool:  # type: ignore[no-untyped-def]
        """Fill in the rows of some pieces; return whether a cost may be negative."""
        M, R, n = len(self.control), len(self.weight), len(boxes.low)
        low, high = (np.repeat(ends, M * R, axis=0) for ends in (boxes.low, boxes.high))
        control = np.tile(np.repeat(self.control, R, axis=0), (n, 1))
        least, most = (np.tile(ends, (n * M, 1)) for ends in self.noise)
        given = enclosing.Given(low, high, control, least, most)
        image, flags, cost = self._seen(given, np.repeat(boxes.start, M * R, axis=0))
        if self.admitted is not None:
            _, holds = enclosing.ranges(self.step, self.admitted, given)
            cost[holds[:, 0] < 0.5] = np.inf
        rows = slice(at, at + len(low))
        span = image >> (places.BITS - grid.split)[:, None]
        span[(flags & places.EMPTY) > 0] = (1, 0)
        found.span[rows] = span
        found.enters[rows] = (flags & places.MAY_ARRIVE) > 0
        found.cost[rows] = np.maximum(cost, 0.0)
        free = np.repeat(~self.avoided[cell] & ~np.isfinite(self.entry[cell]), M * R)
        return bool((cost[free] < 0).any())

    def _seen(
        self, given: enclosing.Given, start: Floats
    ) -> tuple[Indices, NDArray[np.uint8], Floats]:
        d = self.partition.dimension
        found = enclosing.enclose(self.step, given)
        image = np.empty((len(found.low), d, 2), dtype=np.int64)
        flags = np.zeros(len(found.low), dtype=np.uint8)
        clip = self.partition.clip
        with np.errstate(all="ignore"):
            places.locate_images(found.low, found.high, self.axes, clip, self.slack, image, flags)
            if self.step.path:
                ground = (self.axes, self.kind, clip, enclosing.HERMITE)
                places.follow(found, start, ground, flags)
        if found.low.shape[1] > d:  # of a rate, paid only until A is entered
            early = (flags & places.MAY_ARRIVE) > 0
            return image, flags, np.where(early, 0.0, found.low[:, d])
        return image, flags, enclosing.ranges(self.step, self.step.cost, given)[0][:, 0]


def noise_parts(problem: Problem) -> tuple[tuple[Floats, Floats], Floats]:
    """Return the parts of the noise, ends of shape (R, r), and their weights, shape (R,).

    A normal variable of which a range is covered is one part: of runs whose noise stays within it
    no more is known.
    """
    memory.require(node_count(problem) * 400, "noise nodes")
    ends, weights = [], []
    for noise in (problem.noise or {}).values():
        low, high = noise.parts()
        if isinstance(noise, NoiseNormal) and noise.normal.within is not None:
            low, high, weight = low[:1], high[-1:], np.ones(1)
        else:
            weight = noise.nodes()[1]
            weight = weight[weight > 0] / weight.sum()
        ends.append((low, high))
        weights.append(weight)
    if not ends:
        return (np.zeros((1, 0)), np.zeros((1, 0))), np.ones(1)
    low, high = (
        np.stack(np.meshgrid(*(e[k] for e in ends), indexing="ij"), axis=-1).reshape(-1, len(ends))
        for k in (0, 1)
    )
    total = weights[0]
    for weight in weights[1:]:
        total = np.multiply.outer(total, weight).ravel()
    return (low, high), total

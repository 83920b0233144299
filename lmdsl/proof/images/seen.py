"""Images of the boxes of a cover: enclosed, located, and kept."""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices, Statuses
from lmdsl.machine import threads
from lmdsl.model.discretization import noise_parts
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.compiled import enclosing, places, tapes
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem
from lmdsl.proof.images.pieces import DEEPEST, Integers, Pieces, pieces
from lmdsl.proof.images.whole import CellRanges

SOME = 2**13  # most boxes enclosed at a time by a thread
KEPT = 2**22  # doubles of paths above which fewer boxes are enclosed at a time


class Seen(NamedTuple):
    """What is known of the images of boxes.

    Attributes
    ----------
    owner
        Position of the node of each image.
    place
        Places of the images, shape (images, d, 2).
    more
        What each image may do besides.
    flags
        The same by node.
    dearest, cheapest
        Bounds of the stage cost, by node.
    axis
        The axis along which bisecting makes the images smallest, by node.
    """

    owner: Indices
    place: Indices
    more: Integers
    flags: Integers
    dearest: Floats
    cheapest: Floats
    axis: Integers


class BoxImages:
    """The true map under a controller that is constant on cells, on boxes.

    Parameters
    ----------
    problem, partition, status
        The problem, its cells and what they are, shape (N,).
    control
        The controls of the cells, shape (N, p); any where there is none.
    slack
        By how much images are widened, in cells.
    whole
        What is known of the images of whole cells.
    """

    def __init__(
        self, problem: Problem, partition: Partition, status: Statuses, control: Floats,
        slack: float = 0.0, whole: CellRanges | None = None,
    ) -> None:  # fmt: skip
        self.problem, self.partition, self.whole = problem, partition, whole
        self.control, self.slack = control, slack
        self.step = tapes.step(problem)
        self.noise = noise_parts(problem)
        self.axes = np.array(partition.axes, dtype=np.float64)
        kind = np.zeros(len(status), dtype=np.int64)
        if absorbed_on_way(problem.local_controller):
            kind[status == CellStatus.ATTRACTOR] = places.MAY_ARRIVE
        kind[status == CellStatus.AVOID] = places.MAY_LEAVE
        self.ground = (self.axes, kind, partition.clip, enclosing.HERMITE)

    def __call__(self, cell: Integers, split: Integers, place: Integers) -> Seen:
        """Return what is known of the images of nodes; several threads work."""
        arcs = 2 * sum(self.step.sizes[:2]) * self.step.substeps
        size = max(64, min(SOME, KEPT // arcs))
        starts = range(0, len(cell), size)

        def some(start: int) -> Seen:
            at = slice(start, start + size)
            return self.part(cell[at], split[at], place[at])

        if len(starts) <= 1:
            return some(0)
        found = threads.each(some, list(starts))
        owner = np.concatenate([s + seen.owner for s, seen in zip(starts, found, strict=True)])
        rest = (np.concatenate(arrays) for arrays in list(zip(*found, strict=True))[1:])
        return Seen(owner, *rest)

    def part(self, cell: Integers, split: Integers, place: Integers) -> Seen:
        """Return the same by this thread; images of a node stand together, nodes in order."""
        boxes = pieces(self.partition, cell, split, place)
        count, nodes, d = len(boxes.owner), len(cell), self.partition.dimension
        flags = np.zeros(nodes, dtype=np.uint8)
        dearest, cheapest = np.full(nodes, -np.inf), np.full(nodes, np.inf)
        held, stretch = enclosing.rows(self.step), np.zeros((count, d))
        located: list[Indices] = []
        besides: list[Integers] = []
        for part, (least, most) in enumerate(zip(*self.noise, strict=True)):
            given = enclosing.Given(
                boxes.low, boxes.high, self.control[cell[boxes.owner]],
                *(np.broadcast_to(ends, (count, len(ends))) for ends in (least, most)),
            )  # fmt: skip
            found = enclosing.enclose(self.step, given, held)
            image, more = self._located(boxes, found)
            if self.whole is not None:
                self.whole.narrow(cell[boxes.owner], part, image, more)
            located.append(image)
            besides.append(more)
            np.bitwise_or.at(flags, boxes.owner, more)
            low, high = self._cost(given, found, more)
            np.maximum.at(dearest, boxes.owner, high)
            np.minimum.at(cheapest, boxes.owner, low)
            stretch += (found.stretch[:, :d] / self.partition.width[:, None]).sum(axis=1)
        owner = np.tile(boxes.owner, len(located))
        order = np.argsort(owner, kind="stable")
        axis = self._axis(stretch[:nodes], split)
        image, more = np.concatenate(located)[order], np.concatenate(besides)[order]
        return Seen(owner[order], image, more, flags, dearest, cheapest, axis)

    def _located(self, boxes: Pieces, found: enclosing.Enclosed) -> tuple[Indices, Integers]:
        d = self.partition.dimension
        image = np.empty((len(found.low), d, 2), dtype=np.int64)
        flags = np.zeros(len(found.low), dtype=np.uint8)
        clip = self.partition.clip
        with np.errstate(all="ignore"):
            places.locate_images(found.low, found.high, self.axes, clip, self.slack, image, flags)
            if self.step.path:
                places.follow(found, boxes.start, self.ground, flags)
                places.absorb(found, boxes.start, self.ground, self.slack, flags)
        image[(flags & places.EMPTY) > 0] = (1, 0)  # nothing of it is in the box
        return image, flags & ~np.uint8(places.EMPTY)

    def _cost(
        self, given: enclosing.Given, found: enclosing.Enclosed, flags: Integers
    ) -> tuple[Floats, Floats]:
        d = self.partition.dimension
        if found.low.shape[1] > d:  # of a rate, paid only until A is entered
            early = (flags & places.MAY_ARRIVE) > 0
            least, most = places.paid(found, d)
            low, high = found.low[:, d], found.high[:, d]
            return np.where(early, least, low), np.where(early, most, high)
        low, high = enclosing.ranges(self.step, self.step.cost, given)
        return low[:, 0], high[:, 0]

    def _axis(self, stretch: Floats, split: Integers) -> Integers:
        size = 2.0 ** -split.astype(np.float64)
        sound = np.asarray(np.isfinite(stretch).all(axis=1))
        worth = np.where(sound[:, None], np.maximum(stretch, 1e-3 * size), size)
        worth[split >= DEEPEST] = -1.0
        return np.asarray(np.argmax(worth, axis=1))


def deep(split: Integers) -> Bools:
    """Return which nodes cannot be bisected any more."""
    return np.asarray((split >= DEEPEST).all(axis=-1))

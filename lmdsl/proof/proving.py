"""From a problem and a controller to a proof: what arrives, is lost, or stays, box by box."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Progress, Statuses
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.proof import settling
from lmdsl.proof.cover import Cover, node_bytes
from lmdsl.proof.images import enclosing
from lmdsl.proof.images.pieces import pieces
from lmdsl.proof.images.seen import BoxImages
from lmdsl.proof.prover import Prover
from lmdsl.proof.record import Proof
from lmdsl.proof.search import ARRIVES, LOST, STAYS, UNDECIDED
from lmdsl.proof.tightening import tighten

# Images are widened by so much, in cells, when boxes are chosen, but not when they are checked:
# other versions of elementary functions differ by less.
SLACK = 2.0**-36

# Without a time limit bounds of the cost are tightened until there are so many times as many boxes,
# or so many.
GROWN, FEW = 4, 200_000


class Loop(NamedTuple):
    """The true map under a controller that is constant on cells.

    Attributes
    ----------
    problem, partition
        The problem and its cells.
    status
        What the cells are, shape (N,).
    control
        Their controls, shape (N, p); any where there is none.
    """

    problem: Problem
    partition: Partition
    status: Statuses
    control: Floats

    @property
    def factor(self) -> float:
        """What the cost after a step counts."""
        return self.problem.gamma * (self.problem.discount or 1.0)

    def images(self, slack: float = 0.0) -> BoxImages:
        """Return what encloses images of boxes."""
        return BoxImages(self.problem, self.partition, self.status, self.control, slack)

    def entry(self, images: BoxImages) -> tuple[Indices, Floats, Floats]:
        """Return the attractor cells, and bounds of what is paid on entering each."""
        cells = np.flatnonzero(self.status == CellStatus.ATTRACTOR)
        zero, d = np.zeros(len(cells)), self.partition.dimension
        if not len(images.step.terminal.middle) or not len(cells):
            return cells, zero, zero
        whole = np.zeros((len(cells), d), dtype=np.int64)
        boxes = pieces(self.partition, cells, whole, whole)
        none = np.zeros((len(boxes.low), 0))
        given = enclosing.Given(
            boxes.low, boxes.high, np.zeros((len(none), images.step.sizes[2])),
            *(np.zeros((len(none), images.step.sizes[3])) for _ in range(2)),
        )  # fmt: skip
        low, high = enclosing.ranges(images.step, images.step.terminal, given)
        least, most = zero + np.inf, zero - np.inf
        np.minimum.at(least, boxes.owner, low[:, 0])
        np.maximum.at(most, boxes.owner, high[:, 0])
        return cells, least, most


def prove(
    loop: Loop, target: float, deadline: Deadline, holds: bool | None, progress: Progress | None
) -> Proof:
    """Prove what becomes of the volume of C, until the target is reached or nothing helps."""
    began = time.monotonic()
    images, partition = loop.images(SLACK), loop.partition
    each = node_bytes(partition.dimension, len(images.noise[0]))
    memory.require(3.0 * each * partition.size, "the boxes of the proof")
    limited = deadline.seconds is None
    to_stay = bool(loop.problem.attractor.empty)
    prover = Prover(Cover(partition, loop.status), images, loop.factor, loop.entry(images))

    def enough(shares: Floats) -> bool:
        """Return whether the target is reached, or out of reach and little is left to know."""
        reached = shares[STAYS if to_stay else ARRIVES]
        open_ = shares[UNDECIDED]
        return bool(reached >= target or (reached + open_ < target and open_ < 1.0 - target))

    prover.run(enough, deadline, progress)
    few = max(GROWN * len(prover.cover.leaves()), FEW)
    tighten(prover, lambda boxes: limited and boxes > few, deadline, progress)
    arrays = boxes(prover)
    cells = int((loop.status == CellStatus.STABILIZED).sum())
    seconds = time.monotonic() - began
    return Proof.of(arrays, cells, seconds=seconds, holds=holds, target=target, to_stay=to_stay)


def boxes(prover: Prover) -> dict[str, NDArray[Any]]:
    """Return the arrays of a proof: the leaves by cell, levels and bounds made exact for each."""
    cover = prover.cover
    tree = cover.tree
    leaves = cover.leaves()
    leaves = leaves[tree.images[leaves] > 0]
    for decided in (ARRIVES, LOST):
        some = leaves[tree.state[leaves] == decided]
        some = some[np.argsort(tree.level[some], kind="stable")]
        settling.refine(prover.search, some, prover.factor, np.zeros(len(some)))
    leaves = leaves[np.argsort(tree.cell[leaves], kind="stable")]
    state = tree.state[leaves]
    arrives, ends = state == ARRIVES, (state == ARRIVES) | (state == LOST)
    return {
        "cell": tree.cell[leaves].astype(np.int64), "split": tree.split[leaves],
        "place": tree.place[leaves], "class": state,
        "level": np.where(ends, tree.level[leaves], 0).astype(np.int32),
        "cost": np.where(arrives, tree.cost[leaves], 0.0),
        "lower": np.where(arrives, tree.least[leaves], 0.0),
    }  # fmt: skip

"""The closed loop of which something is proved: never a result, only what it is made of."""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices, Statuses
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.compiled import enclosing
from lmdsl.problem.problem import Problem
from lmdsl.proof.bounds.optimum.moves import Game
from lmdsl.proof.images.pieces import pieces
from lmdsl.proof.images.seen import BoxImages
from lmdsl.proof.images.whole import CellRanges


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

    @property
    def cells(self) -> int:
        """Number of cells of C."""
        return int((self.status == CellStatus.STABILIZED).sum())

    @property
    def attractor(self) -> Bools:
        """The attractor cells, shape (N,)."""
        return np.asarray(self.status == CellStatus.ATTRACTOR)

    @property
    def noisy(self) -> bool:
        """Whether there is noise."""
        return bool(self.problem.noises)

    @property
    def to_stay(self) -> bool:
        """Whether there is no attractor, so that staying is what is wanted."""
        return bool(self.problem.attractor.empty)

    def images(self, slack: float = 0.0, whole: CellRanges | None = None) -> BoxImages:
        """Return what encloses images of boxes."""
        return BoxImages(self.problem, self.partition, self.status, self.control, slack, whole)

    def whole(self, deadline: Deadline) -> CellRanges | None:
        """Return what the compiled model knows of the images of whole cells."""
        return CellRanges.of(self.problem, self.partition, self.status, self.control, deadline)

    def game(self, slack: float = 0.0) -> Game:
        """Return the choice of controls that every law has."""
        cells, least, _ = self.entry(self.images())
        entry = np.full(self.partition.size, np.inf)
        entry[cells] = least
        return Game(self.problem, self.partition, self.status, entry, slack)

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

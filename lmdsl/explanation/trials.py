"""The true map tried on a few cells: their sample points, under every control, noise at its nodes.

Arrays have the shape (cells, controls, points, nodes), or broadcast to it.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.model import discretization
from lmdsl.model.assembly.sampler import CHUNK
from lmdsl.model.grid.partition import Partition
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem

MOST_CONTROLS = 64


class Limits(NamedTuple):
    """Numbers above which only so many are tried, evenly chosen."""

    cells: int
    controls: int
    points: int
    nodes: int


# Of formulas, and of a user's own function, which may take long for a sample.
MANY, FEW = Limits(512, MOST_CONTROLS, 16, 4), Limits(64, 9, 4, 2)


def some(values: NDArray[Any], most: int) -> NDArray[Any]:
    """Return at most so many values, evenly chosen, with both ends."""
    if len(values) <= most:
        return values
    chosen: NDArray[Any] = values[np.linspace(0, len(values) - 1, most).round().astype(int)]
    return chosen


class MapTrial:
    """The true map at samples of cells.

    Attributes
    ----------
    problem, partition
        What declares the map, and the cells.
    points, nodes, controls
        What is tried of sample offsets, noise nodes and control vectors.
    most_cells
        Number of cells that are tried at most.
    span
        Length of every axis, shape (d,).
    quick
        Whether the map is one of formulas.
    """

    def __init__(
        self,
        problem: Problem,
        partition: Partition,
        deadline: Deadline | None = None,
        doing: str = "trying the map",
    ) -> None:
        self.problem, self.partition = problem, partition
        self.true_map = TrueMap(problem, partition)
        self.guard = partial(Deadline.of(deadline).raise_if_over, doing)
        self.quick = math.isfinite(self.true_map.map.work)
        most = MANY if self.quick else FEW
        self.points = some(discretization.offsets(problem), most.points)
        self.nodes = some(discretization.noise_nodes(problem).values, most.nodes)
        self.noise = list(np.ascontiguousarray(self.nodes.T)[:, None, None, None, :])
        self.controls = some(discretization.control_vectors(problem), most.controls)
        each = len(self.points) * len(self.nodes) * len(self.controls)
        self.most_cells = max(1, min(most.cells, CHUNK // each))
        self._admitted = problem.admitted()
        self.span: Floats = self.partition.high - self.partition.low

    def shape(self, cells: Indices) -> tuple[int, ...]:
        """Return the shape of the samples of cells."""
        return (len(cells), len(self.controls), len(self.points), len(self.nodes))

    def start(self, cells: Indices) -> list[Floats]:
        """Return the states of sample points, per axis (cells, 1, points, 1)."""
        return [x[:, None, :, None] for x in self.partition.samples(cells, self.points)]

    def vectors(self) -> list[Floats]:
        """Return the controls tried, per variable (1, controls, 1, 1)."""
        return [np.ascontiguousarray(u)[None, :, None, None] for u in self.controls.T]

    def images(self, state: list[Floats], controls: list[Floats]) -> tuple[Floats, ...]:
        """Return the images per axis, neither wrapped nor clipped."""
        return self.true_map(state, controls, self.noise, self.guard)

    def admits(self, state: list[Floats], controls: list[Floats]) -> Bools | None:
        """Return where the condition of admissible pairs holds; None without one."""
        if self._admitted is None:
            return None
        values = self.true_map.named(state, controls, self.noise)
        holds: Bools = self._admitted(values, self.guard)[0] != 0
        return holds

    def stuck(self, cells: Indices) -> Bools:
        """Return which cells keep all of their samples under every control, shape (cells,).

        A control that is not admitted moves nothing.
        """
        state, controls = self.start(cells), self.vectors()
        own = self.partition.locate(self.images(state, controls)) == cells[:, None, None, None]
        admitted = self.admits(state, controls)
        if admitted is not None:
            own = own | ~admitted
        return np.asarray(np.broadcast_to(own, self.shape(cells)).all(axis=(1, 2, 3)))

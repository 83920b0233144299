"""The map and the stage cost at the samples of blocks of cells and controls.

Formulas and users' functions are evaluated on arrays that broadcast to (controls, points, nodes,
cells), or (cells, points, nodes, controls) where there are more controls than cells. So what does
not depend on the control is computed once for all controls, and NumPy's inner loops are long.
Plain arithmetic with the control is done line by line instead (lines.py), to the same bits.
"""

from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.formulas.program import Program
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import fixed
from lmdsl.model import discretization
from lmdsl.model.assembly.lines import Lines
from lmdsl.model.assembly.merging import mean_cost
from lmdsl.model.grid.partition import Partition
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem
from lmdsl.systems.base import StateMap
from lmdsl.systems.function import Audit, FunctionMap

# Number of samples at a time: few enough to stay in cache, many enough to keep threads apart.
CHUNK = 2**17

LEAST_LINE = 64  # number of pairs side by side from which on arithmetic goes line by line

FEW = 16  # number of cells, and of controls, above which a function is asked twice of so many only


class Block(NamedTuple):
    """Some cells, each with some controls."""

    first: int  # position of the first cell among all cells asked for
    cells: Indices  # indices of the cells in the box
    controls: tuple[int, int]  # the first control and the one after the last

    @property
    def width(self) -> int:
        """Number of controls."""
        return self.controls[1] - self.controls[0]

    @property
    def lanes(self) -> int:
        """Number of pairs."""
        return self.width * len(self.cells)

    @property
    def cells_last(self) -> bool:
        """Whether the last axis of arrays is that of the cells, not of the controls."""
        return len(self.cells) >= self.width

    @property
    def shape(self) -> tuple[int, int]:
        """The first and last axis of arrays."""
        cells = len(self.cells)
        return (self.width, cells) if self.cells_last else (cells, self.width)


class Sampler:
    """Evaluates a problem's map and stage cost at the samples of blocks.

    Attributes
    ----------
    points, nodes
        Sample offsets (points, d) and noise nodes.
    samples
        Number of samples S of a pair; sample s is point ``s // nodes`` and node ``s % nodes``.
    controls
        Control vectors, shape (M, p).
    guard
        Raises once the deadline has passed.
    true_map
        The map, by axis.
    step, cost
        Map and stage cost of named arrays; they raise once the deadline has passed.
    """

    def __init__(
        self,
        problem: Problem,
        partition: Partition,
        deadline: Deadline | None = None,
        doing: str = "compiling",
    ) -> None:
        self.problem, self.partition = problem, partition
        self.points = discretization.offsets(problem)
        self.controls = discretization.control_vectors(problem)
        self.nodes = discretization.noise_nodes(problem)
        self.samples = len(self.points) * len(self.nodes.weights)
        self.true_map = TrueMap(problem, partition)
        step = _written(problem, self.true_map.map)
        cost = Program([problem.cost()], problem.system.constants())
        self._images, self._costs = _split(problem, step, cost)
        self.guard = guard = partial(Deadline.of(deadline).raise_if_over, doing)
        self.step, self.cost = partial(step, guard=guard), partial(cost, guard=guard)
        self._audit: Audit | None = None
        self._offset = np.ascontiguousarray(self.points.T)[:, :, None]
        self._control = np.ascontiguousarray(self.controls.T)
        self._noise = np.ascontiguousarray(self.nodes.values.T)[:, None, None, :, None]

    def blocks(self, cells: Indices) -> Iterator[Block]:
        """Yield blocks of about CHUNK samples, ordered by cell, then control."""
        M = len(self.controls)
        lanes = max(1, CHUNK // self.samples)
        if lanes >= M:
            for i in range(0, len(cells), lanes // M):
                yield Block(i, cells[i : i + lanes // M], (0, M))
            return
        for i in range(len(cells)):
            for a in range(0, M, lanes):
                yield Block(i, cells[i : i + 1], (a, min(a + lanes, M)))

    def values(self, block: Block) -> dict[str, Floats]:
        """Return named arrays that broadcast to the samples of a block (see the module)."""
        cells_last = block.cells_last
        index = self.partition.multi_index(block.cells)
        states = []
        for k, offset in enumerate(self._offset):
            x = self.partition.low[k] + (index[k] + offset) * self.partition.width[k]
            states.append(x[None, :, None, :] if cells_last else x.T.copy()[:, :, None, None])
        u = self._control[:, slice(*block.controls)]
        controls = u[:, :, None, None, None] if cells_last else u[:, None, None, None, :]
        return self.true_map.named(states, list(controls), list(self._noise))

    def audit(self, cells: Indices) -> Audit | None:
        """Ask a user's function about a few pairs, before all; None for formulas.

        From then on, of every block some samples are asked for again.
        """
        step = self.step.func
        if not isinstance(step, FunctionMap) or not len(cells):
            return None
        width = min(len(self.controls), FEW)
        count = max(1, min(len(cells), FEW, CHUNK // (self.samples * width)))
        few = cells[np.linspace(0, len(cells) - 1, count).astype(int)]
        self._audit = step.audit(self.values(Block(0, few, (0, width))))
        return self._audit

    def outcomes(self, block: Block) -> tuple[Floats, Floats]:
        """Return :meth:`images` and :meth:`costs` of a block."""
        values = self.values(block)
        first, last = block.shape
        shape = (first, len(self.points), len(self.nodes.weights), last)
        index = mean = None
        axes, clip, weights = self.partition.axes, self.partition.clip, self.nodes.weights
        if last >= LEAST_LINE:
            images, costs = self._images, self._costs
            if images is not None:
                weighting = weights if costs is images else None
                index, mean = images(values, shape, axes, clip, weighting)
            if costs is not None and costs is not images:
                _, mean = costs(values, shape, (), clip, weights)
        index = self.images(block, values) if index is None else index
        return index, self.costs(block, values) if mean is None else mean

    def images(self, block: Block, values: Mapping[str, Floats]) -> Floats:
        """Return the image cells, NaN where a sample leaves, shape (first, S, last)."""
        images = self.step(values)
        if self._audit is not None:
            self._audit.alone(values, images)
        index = self.partition.index(images)
        first, last = block.shape
        if index.size != self.samples * block.lanes:
            shape = (first, len(self.points), len(self.nodes.weights), last)
            index = np.ascontiguousarray(np.broadcast_to(index, shape))
        return index.reshape(first, self.samples, last)

    def costs(self, block: Block, values: Mapping[str, Floats]) -> Floats:
        """Return the mean costs, NaN where that of a sample is negative or not finite.

        The shape is (first, last), with 1 for an axis on which the cost does not depend.
        """
        cost = self.cost(values)[0]
        if cost.ndim < 4:
            cost = cost.reshape((1,) * (4 - cost.ndim) + cost.shape)
        mean = np.zeros((cost.shape[0], cost.shape[3]))
        mean_cost(fixed(cost), len(self.points), self.nodes.weights, mean, mean.copy())
        return mean


def _written(problem: Problem, step: StateMap) -> StateMap:
    """Return the map as one program where it can be written out: the same, with fewer arrays."""
    if step.formulas is None or isinstance(step, Program):
        return step
    return Program(step.formulas, problem.system.constants())


def _split(problem: Problem, step: StateMap, cost: Program) -> tuple[Lines | None, Lines | None]:
    """Return how images and costs are made line by line, one and the same for both if possible."""
    if not isinstance(step, Program):
        return None, Lines.of(cost, problem.controls)
    images = Lines.of(step, problem.controls)
    if images is not None:
        joint = Program([*step.formulas, *cost.formulas], problem.system.constants())
        both = Lines.of(joint, problem.controls)
        if both is not None:
            return both, both
    return images, Lines.of(cost, problem.controls)

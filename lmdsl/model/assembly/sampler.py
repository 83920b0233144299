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

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.formulas.program import Program
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import fixed
from lmdsl.model import discretization
from lmdsl.model.assembly.asked import Asked
from lmdsl.model.assembly.entries import Entries, doubles
from lmdsl.model.assembly.lines import Lines
from lmdsl.model.assembly.merging import mean_cost
from lmdsl.model.assembly.paths.judging import Endings
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem
from lmdsl.systems.base import StateMap

# Number of samples at a time: few enough to stay in cache, many enough to keep threads apart.
CHUNK = 2**17

LEAST_LINE = 64  # number of pairs side by side from which on arithmetic goes line by line
SHORT_PATH = 64  # number of doubles of a path above which fewer samples are done at a time

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
    chunk
        Number of samples at a time.
    asked
        The user's own functions among the map and the cost.
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
        sets: CellSets | None = None,
    ) -> None:
        self.problem, self.partition = problem, partition
        self.points = discretization.offsets(problem)
        self.controls = discretization.control_vectors(problem)
        self.nodes = discretization.noise_nodes(problem)
        self.samples = len(self.points) * len(self.nodes.weights)
        self.true_map = TrueMap(problem, partition)
        self.guard = guard = partial(Deadline.of(deadline).raise_if_over, "compiling")
        self._admitted = problem.admitted()
        step, cost = _written(problem, self.true_map.map), problem.stage()
        self.step = partial(step, guard=guard)
        self.cost = None if cost is None else partial(cost, guard=guard)
        self.chunk, self.asked = chunk(problem), Asked(step, cost)
        self._entries = Entries.of(problem, partition, sets)
        self._images, self._costs = None, None
        if self._entries is None:
            self._images, self._costs = _split(problem, step, cost)
        self._offset = np.ascontiguousarray(self.points.T)[:, :, None]
        self._control = np.ascontiguousarray(self.controls.T)
        self._noise = np.ascontiguousarray(self.nodes.values.T)[:, None, None, :, None]

    def blocks(self, cells: Indices, span: tuple[int, int] | None = None) -> Iterator[Block]:
        """Yield blocks of about ``chunk`` samples, ordered by cell, then control.

        Of a span, from a position in ``cells`` to before another, those of all cells that meet it.
        """
        M = len(self.controls)
        lanes = max(1, self.chunk // self.samples)
        together = max(1, lanes // M)
        first, last = (0, len(cells)) if span is None else span
        for i in range(first // together * together, last if last > first else 0, together):
            some = cells[i : i + together]
            for a in range(0, M, M if lanes >= M else lanes):
                yield Block(i, some, (a, M if lanes >= M else min(a + lanes, M)))

    def values(self, block: Block) -> dict[str, Floats]:
        """Return named arrays that broadcast to the samples of a block (see the module)."""
        cells_last = block.cells_last
        index = self.partition.multi_index(block.cells)
        states = []
        for k, offset in enumerate(self._offset):
            x = self.partition.place(k, index[k], offset)
            states.append(x[None, :, None, :] if cells_last else x.T.copy()[:, :, None, None])
        u = self._control[:, slice(*block.controls)]
        controls = u[:, :, None, None, None] if cells_last else u[:, None, None, None, :]
        return self.true_map.named(states, list(controls), list(self._noise))

    def audit(self, cells: Indices) -> None:
        """Ask a user's functions about a few pairs, before all, and how long that takes.

        From then on, of every block some samples are asked for again.
        """
        if not self.asked.maps or not len(cells):
            return
        width = min(len(self.controls), FEW)
        count = max(1, min(len(cells), FEW, CHUNK // (self.samples * width)))
        few = cells[np.linspace(0, len(cells) - 1, count).astype(int)]
        self.asked.audit(self.values(Block(0, few, (0, width))), self.guard)
        self.chunk = self.asked.chunk(self.chunk)
        self.asked.announce(len(cells) * len(self.controls) * self.samples)

    def outcomes(self, block: Block) -> tuple[Floats, Floats]:
        """Return :meth:`images` and :meth:`costs` of a block."""
        values, shape = self.values(block), self._shape(block)
        if self._entries is not None:
            ends = self._entries.ends(values, self._step, shape, self.guard)
            cost = self._mean(self._paid(self._by_key(values, ends)))
            return self._samples_together(self._admitted_only(values, ends.cell)), cost
        index = mean = None
        axes, clip, weights = self.partition.axes, self.partition.clip, self.nodes.weights
        if shape[-1] >= LEAST_LINE:
            images, costs = self._images, self._costs
            if images is not None:
                weighting = weights if costs is images else None
                index, mean = images(values, shape, axes, clip, weighting)
            if costs is not None and costs is not images:
                _, mean = costs(values, shape, (), clip, weights)
            if index is not None:
                index = self._admitted_only(values, index.reshape(shape))
                index = self._samples_together(index)
        index = self.images(block, values) if index is None else index
        return index, self.costs(block, values) if mean is None else mean

    def images(self, block: Block, values: Mapping[str, Floats]) -> Floats:
        """Return the cells where samples end, NaN where one leaves, shape (first, S, last)."""
        shape = self._shape(block)
        if self._entries is not None:
            index = self._entries.ends(values, self._step, shape, self.guard).cell
        else:
            index = self.partition.index(self._step(values))
            if index.size != self.samples * block.lanes:
                index = np.ascontiguousarray(np.broadcast_to(index, shape))
        return self._samples_together(self._admitted_only(values, index.reshape(shape)))

    def places(self, block: Block) -> Floats:
        """Return where samples end: images not wrapped, or places on the way, (d, samples)."""
        values, shape = self.values(block), self._shape(block)
        if self._entries is not None:
            return self._entries.ends(values, self._step, shape, self.guard, places=True).place
        return np.stack([np.broadcast_to(x, shape).ravel() for x in self._step(values)])

    def admits(self, values: Mapping[str, Floats]) -> Bools | None:
        """Return where the condition of admissible pairs holds; None without one."""
        if self._admitted is None:
            return None
        holds: Bools = self._admitted(values, self.guard)[0] != 0
        return holds

    def _admitted_only(self, values: Mapping[str, Floats], index: Floats) -> Floats:
        """Let samples leave where the condition of admissible pairs does not hold."""
        admitted = self.admits(values)
        return index if admitted is None else np.where(admitted, index, np.nan)

    def costs(self, block: Block, values: Mapping[str, Floats]) -> Floats:
        """Return the mean costs, NaN where that of a sample is negative or not finite.

        The shape is (first, last), with 1 for an axis on which the cost does not depend.
        """
        return self._mean(self._paid(self.costs_by_key(block, values)))

    def costs_by_key(self, block: Block, values: Mapping[str, Floats]) -> dict[str, Floats]:
        """Return what samples cost, by key of the problem, in shapes that broadcast to theirs.

        Each is the value of its formula: a terminal cost is paid times gamma and the discount.
        """
        if self._entries is None:
            return self._by_key(values, None)
        ends = self._entries.ends(values, self._step, self._shape(block), self.guard)
        return self._by_key(values, ends)

    def _by_key(self, values: Mapping[str, Floats], ends: Endings | None) -> dict[str, Floats]:
        costs: dict[str, Floats] = {}
        if self.cost is not None:
            (costs["stage_cost"],) = stage = self.cost(values)
            self.asked.alone(self.cost.func, values, stage)
        if self._entries is not None and ends is not None:
            costs |= self._entries.costs(ends, self.guard)
        return costs

    def _paid(self, costs: dict[str, Floats]) -> Floats:
        """Return what samples pay in all, NaN where a part is negative: another may not hide it."""
        if self._entries is not None and "terminal_cost" in costs:
            costs = {**costs, "terminal_cost": self._entries.factor * costs["terminal_cost"]}
        total: Floats = sum(costs.values(), np.zeros(()))
        if len(costs) > 1:
            for part in costs.values():
                total = np.where(part < 0, np.nan, total)
        return total

    def _step(self, values: Mapping[str, Floats]) -> tuple[Floats, ...]:
        """Return the images; of a user's function some are asked for again."""
        images = self.step(values)
        self.asked.alone(self.step.func, values, images)
        if self.true_map.steepness is not None:
            self.true_map.steepness.require(values, images)
        return images

    def _shape(self, block: Block) -> tuple[int, int, int, int]:
        """Return what the arrays of a block broadcast to."""
        first, last = block.shape
        return first, len(self.points), len(self.nodes.weights), last

    def _samples_together(self, index: Floats) -> Floats:
        return index.reshape(index.shape[0], self.samples, index.shape[3])

    def _mean(self, cost: Floats) -> Floats:
        if cost.ndim < 4:
            cost = cost.reshape((1,) * (4 - cost.ndim) + cost.shape)
        mean = np.zeros((cost.shape[0], cost.shape[3]))
        mean_cost(fixed(cost), len(self.points), self.nodes.weights, mean, mean.copy())
        return mean


def chunk(problem: Problem) -> int:
    """Return how many samples are evaluated at a time: fewer where each keeps a long path."""
    return max(1, CHUNK * SHORT_PATH // max(SHORT_PATH, doubles(problem)))


def _written(problem: Problem, step: StateMap) -> StateMap:
    """Return the map as one program where it can be written out: the same, with fewer arrays."""
    if step.formulas is None or isinstance(step, Program):
        return step
    return problem.program(*step.formulas)


def _split(
    problem: Problem, step: StateMap, cost: StateMap | None
) -> tuple[Lines | None, Lines | None]:
    """Return how images and costs are made line by line, one and the same for both if possible."""
    if cost is None:
        return None, None
    costs = Lines.of(cost, problem.controls) if isinstance(cost, Program) else None
    if not isinstance(step, Program):
        return None, costs
    images = Lines.of(step, problem.controls)
    if not isinstance(cost, Program):
        return images, None
    if images is not None:
        joint = problem.program(*step.formulas, *cost.formulas)
        both = Lines.of(joint, problem.controls)
        if both is not None:
            return both, both
    return images, costs

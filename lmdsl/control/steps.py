"""Steps of the map as it is declared or compiled, and the noise of a step."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np

from lmdsl.common.types import Floats, Guard, Indices
from lmdsl.machine.forking import cached_property
from lmdsl.model.assembly.entries import integrated
from lmdsl.model.assembly.paths.judging import PathJudge
from lmdsl.model.discretization import noise_nodes
from lmdsl.model.sets import CellSets
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem

AS_DECLARED = "the map as declared"


class Drawn:
    """Draws noise: from the declared distributions, or from the nodes that stand for them."""

    def __init__(self, problem: Problem, nodes: bool) -> None:
        self.variables = tuple((problem.noise or {}).values())
        self.nodes = noise_nodes(problem) if nodes and self.variables else None

    def __call__(self, rng: np.random.Generator, count: int) -> list[Floats]:
        """Return an array of shape (count,) for every variable."""
        if self.nodes is None:
            return [variable.draw(rng, count) for variable in self.variables]
        share = self.nodes.weights / self.nodes.weights.sum()
        node = rng.choice(len(share), size=count, p=share)
        return list(self.nodes.values[node].T)


class Moved(NamedTuple):
    """Where runs are after a step.

    Attributes
    ----------
    state
        Wrapped, and clipped where that is declared; of the first event, or the end; shape (r, d).
    cell
        Of the first event, or of the end; -1 outside; shape (r,).
    cost
        What the step cost, without the terminal cost, shape (r,).
    drawn
        States within the step, not wrapped, shape (pieces, r, d); after an event, where that was.
    part
        Which part of the step was made, shape (r,), or 1 of all: an event ends it early.
    """

    state: Floats
    cell: Indices
    cost: Floats
    drawn: Floats
    part: Floats | float = 1.0


class Steps(Protocol):
    """Makes the steps of runs."""

    @property
    def method(self) -> str:
        """How they are made, in words."""

    def move(self, values: Mapping[str, Floats], guard: Guard, absorb: bool, pieces: int) -> Moved:
        """Move runs from states, under controls and noise: named arrays of shape (r,).

        With ``absorb`` a run ends where it enters the attractor. ``pieces`` states are wanted from
        within the step of an equation, at equal distances in time.
        """


class CompiledSteps:
    """A map has no other steps; of a differential equation, what the compiled model is made of.

    ``declared`` is the problem whose sets end a path, by default the map's own.
    """

    def __init__(self, true_map: TrueMap, declared: Problem | None = None) -> None:
        self.true_map = true_map
        self.problem, self.partition = true_map.problem, true_map.partition
        self.declared = declared or self.problem

    @property
    def method(self) -> str:
        """See :attr:`Steps.method`."""
        flow = self.problem.flow()
        if flow is None:
            return AS_DECLARED
        return f"Runge-Kutta steps, {flow.substeps} per sampling time"

    @cached_property
    def _judges(self) -> tuple[PathJudge, PathJudge] | None:
        """What judges paths, without and with an end on entering the attractor; None for maps."""
        flow, problem = integrated(self.problem), self.problem
        if flow is None:
            return None
        sets = CellSets.of(self.declared, self.partition)
        endpoint = problem.judged == "endpoint"
        on, until = (PathJudge(flow, self.partition, sets, endpoint, a) for a in (False, True))
        return on, until

    def move(self, values: Mapping[str, Floats], guard: Guard, absorb: bool, pieces: int) -> Moved:
        """See :meth:`Steps.move`; nothing is drawn within a step."""
        count = len(values[self.partition.names[0]])
        cost, drawn = np.zeros(count), np.zeros((0, count, self.partition.dimension))
        if self._judges is None:
            return Moved(*self.true_map.step(values, guard), cost, drawn)
        ends = self._judges[absorb](values, (count,), guard, True)
        cell = np.where(ends.cell >= 0, ends.cell, -1).astype(np.int64)
        state = self.partition.states(np.ascontiguousarray(ends.place.T))
        part = ends.time / (self._judges[absorb].flow.substeps if len(ends.time) else 1)
        return Moved(state, cell, ends.integral if len(ends.integral) else cost, drawn, part)

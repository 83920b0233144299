"""Steps of the map as it is declared or compiled, and the noise of a step."""

from collections.abc import Sequence

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.control.integration import Moved
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


class CompiledSteps:
    """A map has no other steps; of a differential equation, what the compiled model is made of."""

    def __init__(self, true_map: TrueMap) -> None:
        self.true_map = true_map
        self.problem, self.partition = true_map.problem, true_map.partition

    @property
    def method(self) -> str:
        """How images are made, in words."""
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
        sets, endpoint = CellSets.of(problem, self.partition), problem.judged == "endpoint"
        on, until = (PathJudge(flow, self.partition, sets, endpoint, a) for a in (False, True))
        return on, until

    def move(
        self,
        x: Floats,
        u: Floats,
        w: Sequence[Floats],
        guard: Guard | None = None,
        absorb: bool = True,
        pieces: int = 0,
    ) -> Moved:
        """See :meth:`lmdsl.control.integration.Integrator.move`; nothing is drawn of a map."""
        cost, drawn = np.zeros(len(x)), np.zeros((0, *x.shape))
        if self._judges is None:
            return Moved(*self.true_map.step(x, u, w, guard), cost, drawn)
        values = self.true_map.named(list(x.T), list(u.T), w)
        ends = self._judges[absorb](values, (len(x),), guard or (lambda: None), True)
        cell = np.where(ends.cell >= 0, ends.cell, -1).astype(np.int64)
        state = self.partition.states(np.ascontiguousarray(ends.place.T))
        return Moved(state, cell, ends.integral if len(ends.integral) else cost, drawn)

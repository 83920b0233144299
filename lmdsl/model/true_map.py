"""The true map x+ = T(x, u, w) of a problem, and the states and cells that its images become."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, Guard, Indices
from lmdsl.formulas.enclosures import Jet
from lmdsl.model.grid.partition import Partition
from lmdsl.problem.problem import Problem
from lmdsl.systems.base import StateMap
from lmdsl.systems.black_box.function_map import FunctionMap
from lmdsl.systems.runge_kutta import ArcJets, RungeKutta


class TrueMap:
    """x+ = T(x, u, w) as declared, not the finite model that is made from its samples.

    States, controls and noise are given by axis: one array (or jet) for each name, in order; they
    broadcast against each other.

    Attributes
    ----------
    problem, partition
        What declares the map, and the cells of its states.
    map
        The map on named arrays.
    names
        Of the states, the controls, and the noise.
    steepness
        Lipschitz constants that are promised of a Python function; None where none are.
    """

    def __init__(self, problem: Problem, partition: Partition) -> None:
        self.problem, self.partition = problem, partition
        self.map: StateMap = problem.step()
        self.steepness = problem.system.promised(problem.states, problem.noises)
        self.names = (*problem.states, *problem.controls, *problem.noises)

    def named(self, x: Sequence[Any], u: Sequence[Any], w: Sequence[Any]) -> dict[str, Any]:
        """Return states, controls and noise by name."""
        return dict(zip(self.names, (*x, *u, *w), strict=True))

    def __call__(
        self, x: Sequence[Any], u: Sequence[Any], w: Sequence[Any], guard: Guard | None = None
    ) -> tuple[Floats, ...]:
        """Return the images by axis, not wrapped, each in the shape of what it depends on."""
        return self.map(self.named(x, u, w), guard)

    def helped(self) -> AbstractContextManager[None]:
        """Keep ready what helps with many calls of a user's function."""
        return self.map.helped() if isinstance(self.map, FunctionMap) else nullcontext()

    def enclose(
        self, x: Sequence[Jet], u: Sequence[Jet], w: Sequence[Jet], guard: Guard | None = None
    ) -> tuple[Jet, ...] | None:
        """Enclose images and derivatives on boxes; None where nothing encloses the map."""
        enclose = self.map.enclose
        return None if enclose is None else enclose(self.named(x, u, w), guard)

    def arcs(
        self, x: Sequence[Jet], u: Sequence[Jet], w: Sequence[Jet], guard: Guard | None = None
    ) -> Iterator[ArcJets]:
        """Enclose the path of a differential equation, substep by substep."""
        assert isinstance(self.map, RungeKutta)
        return self.map.arcs(self.named(x, u, w), guard)

    def images(
        self, x: Floats, u: Floats, w: Sequence[Floats], guard: Guard | None = None
    ) -> Floats:
        """Return the images of states (r, d) under controls (r, p), not wrapped, shape (r, d)."""
        return self._images(self.named(list(x.T), list(u.T), w), guard)

    def step(
        self, values: Mapping[str, Floats], guard: Guard | None = None
    ) -> tuple[Floats, Indices]:
        """Return the next states, wrapped or clipped, shape (r, d), and their cells, -1 outside.

        ``values`` are named arrays of shape (r,).
        """
        return self.partition.enter(self._images(values, guard))

    def _images(self, values: Mapping[str, Floats], guard: Guard | None) -> Floats:
        count = len(values[self.names[0]])
        return np.stack([np.broadcast_to(y, count) for y in self.map(values, guard)], axis=-1)

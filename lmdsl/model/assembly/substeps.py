"""How many Runge-Kutta steps it takes to follow a differential equation.

That is judged at seeded pairs of a cell and a control, each with a sample point and a noise node,
that stay in the box: by twice as many substeps. Whether they stay an accurate integrator says.
"""

from functools import partial
from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model import discretization
from lmdsl.model.assembly.estimates import unless_short
from lmdsl.model.assembly.paths.quadrature import Quadrature
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.systems.accurate import AccurateFlow
from lmdsl.systems.runge_kutta import RungeKutta

PAIRS, FIRST = 10_000, 100  # pairs, and as many of them as are tried first
QUANTILE = 0.99
GOAL, MOST = 0.01, 1_000  # of automatic substeps: difference in cell widths, number of substeps
COST_GOAL = 0.001  # of the integral of a cost rate, relative
LARGEST = 2 ** int(np.log2(MOST))  # automatic substeps
ATTEMPTS = MOST  # steps of the accurate integrator: where it takes more, so does Runge-Kutta


def settled(
    problem: Problem, deadline: Deadline | None = None, sets: CellSets | None = None
) -> Problem:
    """Return a problem whose substeps are a number: ``auto`` is as many as it takes.

    ``sets`` are its cells, where they are known. What compiles in a moment has two seconds at
    least: fast equations take longer than cells.

    Raises
    ------
    BadInput
        The equation is too fast for any number of substeps.
    TimeLimitReached
        The deadline has passed.
    """
    if getattr(problem.system, "substeps", None) != "auto":
        return problem
    deadline = Deadline.of(deadline)
    hurried = unless_short(problem, deadline) is deadline
    pairs, count = JudgedPairs.of(problem, sets, deadline if hurried else deadline.again()), 1
    assert pairs is not None
    if pairs.given_up:
        raise BadInput(_too_fast(problem), "system.substeps")
    coarse, rates = pairs.images(1), pairs.quadrature(1)
    while 2 * count <= MOST:
        fine = pairs.images(2 * count)
        if pairs.apart(coarse, fine) < GOAL and (rates is None or rates.halving < COST_GOAL):
            break
        count, coarse, rates = 2 * count, fine, pairs.quadrature(2 * count)
    return problem.replaced(system=problem.system.replaced(substeps=count))


def needed(problem: Problem, deadline: Deadline | None = None) -> int:
    """Return how many substeps ``auto`` makes of an equation; 0 where it finds no number."""
    system: Any = problem.system
    try:
        found: Any = settled(problem.replaced(system=system.replaced(substeps="auto")), deadline)
    except BadInput:
        return 0
    return int(found.system.substeps)


def _too_fast(problem: Problem) -> str:
    step = getattr(problem.system, "step", None)
    return (
        f'"auto" finds no number up to {LARGEST}: the equation is so stiff, or so fast, that an '
        f"accurate integrator takes more than {ATTEMPTS:,} steps for one step of {step!r}; "
        "shorten step, let what settles at once be a formula of the others, or write a number of "
        "substeps to take what these make of it"
    )


class JudgedPairs:
    """Samples of seeded pairs that stay in the box, and their images.

    Attributes
    ----------
    values
        States, controls and noise by name, each of shape (count,).
    ends
        Where the accurate integrator sees them after the step, shape (d, count), not wrapped;
        infinite where it gives up.
    given_up
        That is so of more than 1 %.
    """

    def __init__(
        self,
        problem: Problem,
        sets: CellSets,
        partition: Partition,
        drawn: dict[str, Floats],
        deadline: Deadline,
    ) -> None:
        self.problem, self.sets, self.partition = problem, sets, partition
        self.guard = partial(deadline.raise_if_over, "judging the integration error")
        flow = problem.flow(cost=False)
        assert flow is not None
        self.flow = flow
        accurate = AccurateFlow(flow, partition.width, ATTEMPTS)
        first = {name: x[:FIRST] for name, x in drawn.items()}
        self.drawn, ends = first, accurate(first, self.guard)
        if not self._many(ends):
            rest = {name: x[FIRST:] for name, x in drawn.items()}
            self.drawn, ends = drawn, np.hstack([ends, accurate(rest, self.guard)])
        self.given_up = accurate.smooth and self._many(ends)
        inside = np.isfinite(ends).all(axis=0) & (partition.locate(list(ends)) >= 0)
        inside |= np.isinf(ends).any(axis=0) & accurate.smooth
        self.values = {name: x[inside] for name, x in self.drawn.items()}
        self.ends, self.count = ends[:, inside], int(inside.sum())

    @staticmethod
    def _many(ends: Floats) -> bool:
        return bool(np.isinf(ends).any(axis=0).mean() > 1 - QUANTILE)

    @classmethod
    def of(
        cls, problem: Problem, sets: CellSets | None, deadline: Deadline | None
    ) -> "JudgedPairs | None":
        """Draw the pairs of a problem; None for a map."""
        names = (problem.states, problem.controls, problem.noises)
        if problem.flow(cost=False) is None:
            return None
        partition, deadline = Partition.of(problem), Deadline.of(deadline)
        sets = sets or CellSets.of(problem, partition, deadline)
        free = sets.free if len(sets.free) else np.arange(1)
        rng = np.random.default_rng(0)

        def some(rows: Floats) -> Floats:
            return rows[rng.integers(len(rows), size=PAIRS)].T

        cells = free[rng.integers(len(free), size=PAIRS)]
        offsets = some(discretization.offsets(problem))
        index = partition.multi_index(cells)
        columns = [partition.place(k, index[k], offset) for k, offset in enumerate(offsets)]
        columns += list(some(discretization.control_vectors(problem)))
        columns += list(some(discretization.noise_nodes(problem).values))
        values = dict(zip((name for each in names for name in each), columns, strict=True))
        return cls(problem, sets, partition, values, deadline)

    def images(self, substeps: int) -> Floats:
        """Return the images by so many substeps, not wrapped, shape (d, count)."""
        flow = RungeKutta(
            self.flow.field, self.flow.states, self.flow.h * self.flow.substeps, substeps
        )
        found = flow(self.values, self.guard)
        return np.stack([np.broadcast_to(x, self.count) for x in found])

    def apart(self, a: Floats, b: Floats) -> float:
        """Return the quantile of differences in cell widths, 0 of no pair."""
        if not self.count:
            return 0.0
        with np.errstate(all="ignore"):
            apart = (np.abs(a - b) / self.partition.width[:, None]).max(axis=0)
        apart[np.isnan(apart)] = np.inf
        return float(np.quantile(apart, QUANTILE, method="higher"))

    def quadrature(self, substeps: int) -> Quadrature | None:
        """Return the integrals of the cost rate at all that were drawn; None without a rate."""
        if self.problem.cost_rate is None:
            return None
        return Quadrature(self.problem, self.partition, self.sets, self.drawn, self.guard, substeps)

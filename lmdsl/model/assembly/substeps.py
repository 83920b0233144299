"""How far the compiled Runge-Kutta steps are from the differential equation, and how many it takes.

Both are judged at seeded pairs of a cell and a control, each with a sample point and a noise node,
that stay in the box: by twice as many substeps, and by an accurate integrator.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from lmdsl.common.records import Reported
from lmdsl.common.types import Floats, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.model import discretization
from lmdsl.model.assembly.estimates import unless_short
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.systems.accurate import AccurateFlow
from lmdsl.systems.runge_kutta import RungeKutta

PAIRS = 10_000
QUANTILE = 0.99
GOAL, MOST = 0.01, 1_000  # of automatic substeps: difference in cell widths, number of substeps
TOO_MUCH = 0.1  # cell widths by which a step may miss the equation before this is said


@dataclass(frozen=True)
class IntegrationError(Reported):
    """By how much compiled steps miss the differential equation, in cell widths.

    Of each pair the largest over the axes; of all pairs the 99 % quantile, infinite where steps
    are not finite. None where no pair stays in the box.

    Attributes
    ----------
    substeps
        Runge-Kutta steps per sampling time.
    pairs
        Number of pairs judged.
    halving
        Difference to twice as many substeps.
    accurate
        Difference to the accurate integrator.
    """

    substeps: int
    pairs: int
    halving: float | None
    accurate: float | None

    @property
    def excessive(self) -> bool:
        """Whether that is more than a tenth of a cell."""
        return max(self.halving or 0.0, self.accurate or 0.0) > TOO_MUCH

    def warning(self) -> str:
        """Return what to do about an excessive error; empty where it is not."""
        much = "the steps are more than a tenth of a cell from the equation"
        more = 2 * self.substeps <= MOST
        remedy = 'raise substeps, or write "auto"' if more else "shorten step, or use larger cells"
        return f"{much}: {remedy}" if self.excessive else ""

    def sentence(self) -> str:
        """Return one line for people."""
        if self.accurate is None or self.halving is None:
            return "no sample stays in the box"
        largest = max(self.halving, self.accurate)
        text = f"99 % of the steps within {largest:.2g} cell widths of the equation"
        return text + f"; {self.warning()}" * self.excessive

    __str__ = sentence


def integration_error(
    problem: Problem, free: Indices | None = None, deadline: Deadline | None = None
) -> IntegrationError | None:
    """Return how far the compiled steps of a problem are from its equation; None for a map.

    ``free`` are the cells outside A and Z, where they are known.

    Raises
    ------
    TimeLimitReached
        The deadline has passed.
    """
    pairs = _Pairs.of(problem, free, deadline)
    if pairs is None:
        return None
    flow, count = pairs.flow, pairs.flow.substeps
    if not pairs.count:
        return IntegrationError(count, 0, None, None)
    images = pairs.images(count)
    halving = pairs.apart(images, pairs.images(2 * count))
    return IntegrationError(flow.substeps, pairs.count, halving, pairs.apart(images, pairs.ends))


def settled(problem: Problem, deadline: Deadline | None = None) -> Problem:
    """Return a problem whose substeps are a number: ``auto`` is as many as it takes.

    What compiles in a moment has two seconds at least: stiff equations take longer than cells.

    Raises
    ------
    TimeLimitReached
        The deadline has passed.
    """
    if getattr(problem.system, "substeps", None) != "auto":
        return problem
    deadline = Deadline.of(deadline)
    hurried = unless_short(problem, deadline) is deadline
    pairs, count = _Pairs.of(problem, None, deadline if hurried else deadline.again()), 1
    assert pairs is not None
    coarse = pairs.images(1)
    while pairs.count and 2 * count <= MOST:
        fine = pairs.images(2 * count)
        if pairs.apart(coarse, fine) < GOAL:
            break
        count, coarse = 2 * count, fine
    return problem.replaced(system=problem.system.replaced(substeps=count))


class _Pairs:
    """Samples of seeded pairs that stay in the box, and their images."""

    def __init__(
        self, flow: RungeKutta, partition: Partition, values: dict[str, Floats], deadline: Deadline
    ) -> None:
        self.flow, self.partition = flow, partition
        self.guard = partial(deadline.raise_if_over, "judging the integration error")
        ends = AccurateFlow(flow, partition.width)(values, self.guard)
        inside = np.isfinite(ends).all(axis=0) & (partition.locate(list(ends)) >= 0)
        self.values = {name: x[inside] for name, x in values.items()}
        self.ends, self.count = ends[:, inside], int(inside.sum())

    @classmethod
    def of(
        cls, problem: Problem, free: Indices | None, deadline: Deadline | None
    ) -> "_Pairs | None":
        """Draw the pairs of a problem; None for a map."""
        names = (problem.states, problem.controls, problem.noises)
        flow = problem.flow(cost=False)
        if flow is None:
            return None
        partition, deadline = Partition.of(problem), Deadline.of(deadline)
        if free is None:
            free = CellSets.of(problem, partition, deadline).free
        free = free if len(free) else np.arange(1)
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
        return cls(flow, partition, values, deadline)

    def images(self, substeps: int) -> Floats:
        """Return the images by so many substeps, not wrapped, shape (d, pairs)."""
        flow = RungeKutta(
            self.flow.field, self.flow.states, self.flow.h * self.flow.substeps, substeps
        )
        found = flow(self.values, self.guard)
        return np.stack([np.broadcast_to(x, self.count) for x in found])

    def apart(self, a: Floats, b: Floats) -> float:
        """Return the quantile of differences in cell widths."""
        with np.errstate(all="ignore"):
            apart = (np.abs(a - b) / self.partition.width[:, None]).max(axis=0)
        apart[np.isnan(apart)] = np.inf
        return float(np.quantile(apart, QUANTILE, method="higher"))

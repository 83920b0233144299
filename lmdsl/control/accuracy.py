"""How far the compiled Runge-Kutta steps are from the differential equation, and from its costs."""

from dataclasses import dataclass

import numpy as np

from lmdsl.common.records import Reported
from lmdsl.common.types import Statuses
from lmdsl.control.integration import Integrator
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.paths.quadrature import Quadrature, relative
from lmdsl.model.assembly.substeps import ATTEMPTS, COST_GOAL, MOST, JudgedPairs
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem

TOO_MUCH = 0.1  # cell widths by which a step may miss the equation before this is said
COST_TOO_MUCH = 0.01  # the same of the costs of steps, relative: costs of policies miss as much
FEW = 1_000  # pairs whose costs are integrated accurately


@dataclass(frozen=True)
class IntegrationError(Reported):
    """By how much compiled steps miss the differential equation, in cell widths.

    Of each pair the largest over the axes; of all pairs the 99 % quantile, infinite where steps
    are not finite, or an accurate integrator gives up. None where no pair stays in the box.

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
    cost_halving
        Of a cost rate: relative difference of the costs of all pairs whose path is no escape to
        those by twice as many substeps until the same moment. None without a rate, or such a pair.
    cost_accurate
        The same to what the accurate integrator makes of some pairs, until it enters A.
    given_up
        The accurate integrator takes too many steps in more than 1 % of the pairs.
    """

    substeps: int
    pairs: int
    halving: float | None
    accurate: float | None
    cost_halving: float | None = None
    cost_accurate: float | None = None
    given_up: bool = False

    @property
    def largest(self) -> float:
        """The larger of the differences in cell widths."""
        return max(self.halving or 0.0, self.accurate or 0.0)

    @property
    def largest_of_costs(self) -> float:
        """The larger of the relative differences of costs."""
        return max(self.cost_halving or 0.0, self.cost_accurate or 0.0)

    @property
    def excessive(self) -> bool:
        """Whether that is more than a tenth of a cell, or a hundredth of the costs."""
        return self.largest > TOO_MUCH or self.largest_of_costs > COST_TOO_MUCH

    def fault(self) -> str:
        """Return what is excessive; empty where nothing is."""
        if self.given_up:
            return (
                "the equation is so stiff, or so fast, that an accurate integrator gives up after "
                f"{ATTEMPTS:,} steps"
            )
        if self.largest > TOO_MUCH:
            return "the steps are more than a tenth of a cell from the equation"
        if self.largest_of_costs <= COST_TOO_MUCH:
            return ""
        much = f"the costs of steps miss the integrals of cost_rate by {self._percent()} %"
        return much + ", as paths end up to half a cell inside the attractor" * self._late

    def remedy(self) -> str:
        """Return what to do about it."""
        more = 2 * self.substeps <= MOST
        if self.given_up:
            return "shorten step, or let what settles at once be a formula of the others"
        if self.largest <= TOO_MUCH and self._late:
            return "raise substeps, or use more cells" if more else "use more cells"
        return 'raise substeps, or write "auto"' if more else "shorten step, or use larger cells"

    def warning(self) -> str:
        """Return both in one line; empty where nothing is excessive."""
        return f"{self.fault()}: {self.remedy()}" if self.excessive else ""

    @property
    def _late(self) -> bool:
        """Whether costs are wrong for when paths end, and not for how they are integrated."""
        return (self.cost_halving or 0.0) < COST_GOAL

    def _percent(self) -> str:
        return f"{100 * self.largest_of_costs:.2g}"

    def sentence(self) -> str:
        """Return one line for people."""
        text = f"99 % of the steps within {self.largest:.2g} cell widths of the equation"
        if self.accurate is None or self.halving is None:
            text = "no sample stays in the box"
        elif self.largest == np.inf:
            text = ""
        elif self.cost_halving is not None and self.largest_of_costs <= COST_TOO_MUCH:
            text += f", their costs within {self._percent()} %"
        return "; ".join(part for part in (text, self.warning()) if part)

    __str__ = sentence


def integration_error(
    problem: Problem, sets: CellSets | None = None, deadline: Deadline | None = None
) -> IntegrationError | None:
    """Return how far the compiled steps of a problem are from its equation; None for a map.

    ``sets`` are its cells, where they are known.

    Raises
    ------
    TimeLimitReached
        The deadline has passed.
    """
    pairs = JudgedPairs.of(problem, sets, deadline)
    if pairs is None:
        return None
    count = pairs.flow.substeps
    halving = accurate = cost_halving = cost_accurate = None
    if pairs.count:
        images = pairs.images(count)
        halving = pairs.apart(images, pairs.images(2 * count))
        accurate = pairs.apart(images, pairs.ends)
    rates = pairs.quadrature(count)
    if rates is not None and len(rates.rows):
        cost_halving, cost_accurate = rates.halving, _missed(pairs, rates)
    return IntegrationError(
        count, pairs.count, halving, accurate, cost_halving, cost_accurate, pairs.given_up
    )


def _missed(pairs: JudgedPairs, rates: Quadrature) -> float | None:
    """Return the relative difference of some costs to those of the true path; None of no pair.

    Of those whose true path is no escape: what it costs until it enters A, or in a whole step.
    """
    problem, partition = pairs.problem, pairs.partition
    integrator = Integrator(TrueMap(problem, partition), statuses(pairs.sets), ATTEMPTS)
    rows = rates.rows[:FEW]
    held = {name: x[rows] for name, x in pairs.drawn.items()}
    absorb = absorbed_on_way(problem.local_controller)
    moved = integrator.move(held, pairs.guard, absorb, 0)
    inside = np.flatnonzero(moved.cell >= 0)
    inside = inside[~pairs.sets.avoid[moved.cell[inside]]]
    return relative(rates.integral[inside], moved.cost[inside]) if len(inside) else None


def statuses(sets: CellSets) -> Statuses:
    """Return what every cell is before anything is compiled, shape (N,)."""
    status = np.full(len(sets.number), CellStatus.STABILIZED, dtype=np.uint8)
    status[sets.attractor[:]], status[sets.avoid[:]] = CellStatus.ATTRACTOR, CellStatus.AVOID
    return status

"""What a result of recorded data rests on, and how sure it is: part of every report."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from lmdsl.certificate import sums
from lmdsl.common.records import Reported
from lmdsl.common.types import Guard, Policy
from lmdsl.data.intervals import ROUNDING, Family, intervals, observed, unseen
from lmdsl.data.worst_case import Bounds, bounds, of_one_chain
from lmdsl.machine.deadline import TimeLimitReached
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.systems import DataSystem

UNSEEN_LEVEL = 0.95
"""Level of the unseen mass where no confidence was asked for."""
ASSUMES = ("support", "independence")
GIVEN = (CellStatus.ATTRACTOR, CellStatus.AVOID)
Range = tuple[float | None, float | None]


@dataclass(frozen=True)
class DataReport(Reported):
    """What was recorded, what is assumed, and what follows at a level of confidence.

    Attributes
    ----------
    assumes
        ``support``: no transition occurs that was not recorded. ``independence``: those recorded
        are independent draws in their cells.
    transitions, used
        Given, and in the rows.
    outside, unmatched, few
        Dropped: start outside the box, control off the grid, pair below ``min_count``.
    cells_seen, pairs_seen
        Free cells, and their pairs, that were recorded often enough.
    level
        Level at which the unseen mass, and the cost, hold.
    unseen
        Upper limit of the probability of what was not recorded, of the policy's pairs: the largest
        of them and the median; None without a policy.
    cost
        The policy's cost by m lies between these for every chain whose probabilities lie in the
        intervals; None where no confidence was asked for. An upper end that is None is not bounded.
    unseen_in_a_run
        Upper limit of the probability that a run, started by m, meets what was not recorded before
        it reaches A: it does not assume `support`. None where no confidence was asked for.
    """

    assumes: tuple[str, ...]
    transitions: int
    used: int
    outside: int
    unmatched: int
    few: int
    cells_seen: int
    pairs_seen: int
    level: float
    unseen: tuple[float, float] | None
    cost: Range | None
    unseen_in_a_run: float | None = None

    @classmethod
    def of(cls, lp: StabilizationLP, policy: Policy | None, guard: Guard | None = None) -> Self:
        """Report on a compiled model of recorded data and a policy."""
        system = lp.problem.system
        assert isinstance(system, DataSystem)
        recorded, rows = system.recorded, system.rows
        free = ~np.isin(lp.cell_status, GIVEN)[rows.cell]
        level = UNSEEN_LEVEL if system.confidence is None else system.confidence
        hidden: tuple[float, float] | None = None
        cost: Range | None = None
        met: float | None = None
        if policy is not None and lp.n:
            seen, family = observed(lp, policy), Family.of(lp)
            limit = unseen(seen, family, level)
            hidden = (float(limit.max()), float(np.median(limit)))
            if system.confidence is not None:
                cost = _range(lp, policy_bounds(lp, policy, system.confidence, guard))
                met = _met(lp, policy, system.confidence, guard)
        return cls(
            ASSUMES, recorded.transitions, recorded.used, recorded.outside, recorded.unmatched,
            recorded.few, len(np.unique(rows.cell[free])), int(free.sum()), level, hidden, cost,
            met,
        )  # fmt: skip

    def sentence(self) -> str:
        """Return what a claim rests on, for the end of a message."""
        text = "it rests on `support`: no transition occurs that was not recorded"
        if self.unseen is None:
            return text
        most, median = self.unseen
        return (
            f"{text} (unseen mass of a pair at most {most:.2g}, median {median:.2g}, at "
            f"{_percent(self.level)})"
        )

    def rows(self) -> list[tuple[str, str]]:
        """Return lines of a report: what, and how much."""
        dropped = [
            f"{count} {why}"
            for count, why in (
                (self.outside, "start outside the box"),
                (self.unmatched, "off the control grid"),
                (self.few, "of pairs with too few"),
            )
            if count
        ]
        text = f"{self.used} of {self.transitions} transitions used"
        text += f" (dropped: {', '.join(dropped)})" if dropped else ""
        seen = f"{self.pairs_seen} pairs of {self.cells_seen} free cells recorded"
        lines = [("data", f"{text}; {seen}"), ("assumes", ", ".join(self.assumes))]
        if self.unseen is not None:
            most, median = self.unseen
            about = f"at most {most:.2g} a pair, median {median:.2g}, at {_percent(self.level)}"
            lines.append(("unseen", about))
        if self.cost is not None:
            low, high = (None if x is None else f"{x:.9g}" for x in self.cost)
            upto = "and not bounded above" if high is None else f"to {high}"
            lines.append(("true cost", f"{low} {upto} at {_percent(self.level)}, given `support`"))
        if self.unseen_in_a_run is not None:
            about = f"a run meets it with probability at most {self.unseen_in_a_run:.2g}"
            lines[-2] = ("unseen", f"{lines[-2][1]}; {about}")
        return lines

    def text(self) -> str:
        """Return the report for people."""
        lines = self.rows()
        width = max(len(name) for name, _ in lines)
        return "\n".join(f"{name.ljust(width)}  {value}" for name, value in lines)

    __str__ = text


def policy_bounds(
    lp: StabilizationLP, policy: Policy, level: float, guard: Guard | None = None
) -> Bounds:
    """Return proved bounds of a policy's cost over all chains that the data allow at a level."""
    b = 1.0 if lp.problem.discount is None else lp.problem.discount
    rows = intervals(observed(lp, policy), Family.of(lp), level)
    try:
        return bounds(rows, lp.cost[policy], lp.gamma * b, lp.growth * b, guard)
    except TimeLimitReached:
        return Bounds(np.zeros(lp.n), np.full(lp.n, np.inf))


def _met(lp: StabilizationLP, policy: Policy, level: float, guard: Guard | None) -> float:
    """Return an upper limit of the probability that a run meets what was not recorded.

    It is at most V >= eps + max over rows of P V, eps the unseen mass of a cell, if intervals and
    masses hold together: each at half of what may go wrong.
    """
    b = 1.0 if lp.problem.discount is None else lp.problem.discount
    both, seen, family = (1.0 + level) / 2.0, observed(lp, policy), Family.of(lp)
    eps = np.nextafter(unseen(seen, family, both) * (1 + ROUNDING), 2.0)
    rows = intervals(seen, family, both)
    one = of_one_chain(rows, eps, b)
    if one is None or lp.weight @ one >= 1.0 + ROUNDING:
        return 1.0  # the worst is no less
    try:
        V = bounds(rows, eps, b, b, guard, below=False).high
    except TimeLimitReached:
        return 1.0
    return float(min(sums.mean(lp.weight, V, np.inf), 1.0))


def _range(lp: StabilizationLP, found: Bounds) -> Range:
    high = sums.mean(lp.weight, found.high, np.inf)
    low = max(sums.mean(lp.weight, found.low, -np.inf), 0.0)
    return low, high if np.isfinite(high) else None


def _percent(level: float) -> str:
    return f"{100 * level:.6g} %"

"""The true map in closed loop: runs, and what became of them."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from lmdsl.common.records import Frozen, jsonable
from lmdsl.common.types import Floats, Indices
from lmdsl.control.costs import MeanCost, mean_cost
from lmdsl.control.loop import CYCLING, LOSSES, LOST, REACHED, ClosedLoop, Held, draw_starts
from lmdsl.control.steps import AS_DECLARED
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline

UNSAID = ("aimed", "followed")  # fields that no report holds apart
FEW = 0.01  # share of runs that miss the attractor above which the samples are called too few


@dataclass(frozen=True, eq=False)
class Simulation(Frozen):
    """Outcome of closed-loop runs of the true map from fresh random starts.

    Attributes
    ----------
    starts
        Number of runs; starts are drawn by m (a cell, then uniform inside).
    reached, lost, cycling
        Runs that entered A; that left the box, entered avoid or a cell without control; that did
        neither within the step limit.
    steps
        ``min``, ``q50``, ``q90``, ``q99``, ``max`` of the steps of the reached; None if none.
    interval
        95 % Clopper-Pearson interval of the share reached.
    held
        What became of the reached under the local controller; None without one.
    steps_made
        Steps that were made: fewer than the limit where every run ended, or the time was up.
    cut
        The time was up: the runs that had not ended count as cycling.
    aimed
        There is an attractor to reach; else going on for ever is no fault.
    lost_to
        The lost by ``outside`` (left the box), ``avoid`` and ``no_control`` (entered such a cell).
    cost
        ``mean`` of what ``runs`` paid, its ``standard_error`` (None for one run), and ``cut_off``,
        at most how much more they pay later. The runs are the reached; with a discount, and gamma
        times it below 1, all but the lost. None where there are none. To be compared with the
        certificate's cost where none is left out.
    method
        What was followed, in words: the map, or how its equation was integrated.
    followed
        Whose runs they are: the true map's, or those of a finite model's rows.
    """

    starts: int
    reached: int
    lost: int
    cycling: int
    steps: dict[str, int] | None
    interval: tuple[float, float]
    held: Held | None = None
    steps_made: int = 0
    cut: bool = False
    aimed: bool = True
    lost_to: dict[str, int] = field(default_factory=lambda: dict.fromkeys(LOSSES, 0))
    cost: MeanCost | None = None
    method: str = ""
    followed: str = "true map"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {key: jsonable(value) for key, value in asdict(self).items() if key not in UNSAID}

    def sentence(self) -> str:
        """Return what became of the runs, and what it means where many did not arrive."""
        if not self.aimed:
            few = ": too few samples, or too large cells" * (self.lost > FEW * self.starts)
            steps, lost = f"{self.steps_made:,} steps", f"{self.lost:,} of {self.starts:,}"
            text = f"{self.followed}: discounted, no target; {lost} runs are lost in {steps}{few}"
            return text + (f"; mean cost {self._mean()}" if self.cost else "")
        parts = [f"{self.followed}: {self.reached:,} of {self.starts:,} runs arrive"]
        parts += [f"{self.lost:,} {'is' if self.lost == 1 else 'are'} lost"] * bool(self.lost)
        parts += [f"{self.cycling:,} cycle{'s'[self.cycling != 1 :]}"] * bool(self.cycling)
        text = ", ".join(parts)
        if self.cut:
            text += f" or are cut off after {self.steps_made:,} steps"
        usual = self.steps["q50"] if self.steps else self.steps_made
        underway = self.cut and self.steps_made < 10 * usual
        missed = self.lost + self.cycling * (not underway)
        return text + ": too few samples, or too large cells" * (missed > FEW * self.starts)

    def text(self) -> str:
        """Return a summary for people."""
        low, high = self.interval
        lines = [
            f"{self.starts} runs of the {self.followed} from random starts",
            f"  reached the attractor  {self.reached}  ({100 * self.reached / self.starts:.4g} %; "
            f"95 % interval {100 * low:.4g} to {100 * high:.4g} %)",
            f"  lost                   {self.lost}{self._causes()}",
            f"  cycling                {self.cycling}",
        ]
        if not self.aimed:
            lines[1:4] = [lines[2], f"  going on               {self.cycling}  (no target)"]
        if self.method not in (AS_DECLARED, self.followed):
            lines.insert(1, f"  followed               {self.method}")
        if self.cut:
            lines[-1] += f"  (or cut off by the time limit after {self.steps_made} steps)"
        if self.steps:
            steps = ", ".join(f"{k} {v}" for k, v in self.steps.items())
            lines.append(f"  steps                  {steps}")
        if self.cost:
            lines.append(self._paid(self.cost))
        if self.held:
            held = self.held
            lines += [
                f"  then {held.steps} more steps under local controller and controller together",
                f"    stayed in the attractor  {held.stayed}",
                f"    left, and came back      {held.returned}",
                f"    left, on the way back    {held.away}",
                f"    left, and were lost      {held.lost}",
            ]
            if held.distance:
                lines.append(
                    f"    distance from the orbit  median {held.distance[0]:.3g}, "
                    f"max {held.distance[1]:.3g} cell widths"
                )
        return "\n".join(lines)

    __str__ = text

    def _paid(self, cost: MeanCost) -> str:
        """Return what runs paid in the mean, whose it is, and what it lacks."""
        whose = {self.starts: "all runs   ", self.reached: "the reached"}
        label = whose.get(int(cost["runs"] or 0), "runs kept  ")
        cut_off = cost["cut_off"]
        later = f", and {cut_off:.2g} more at most after {self.steps_made} steps"
        return f"  cost of {label}    {self._mean()}{later if cut_off else ''}"

    def _mean(self) -> str:
        """Return the mean cost and its standard error."""
        assert self.cost is not None
        mean, error = self.cost["mean"], self.cost["standard_error"]
        return f"{mean:.6g}" + ("" if error is None else f" +- {error:.2g} (standard error)")

    def _causes(self) -> str:
        """Return by what runs were lost, in brackets; empty where none was."""
        words = {"outside": "left the box", "avoid": "in avoid", "no_control": "without control"}
        parts = [f"{count} {words[key]}" for key, count in self.lost_to.items() if count]
        return f"  ({', '.join(parts)})" * bool(parts)


def simulate(
    loop: ClosedLoop,
    cells: Indices,
    weight: Floats,
    starts: int,
    steps: int,
    seed: int,
    hold: int,
    deadline: Deadline,
) -> Simulation:
    """Simulate closed-loop runs from random starts.

    Parameters
    ----------
    loop
        The true map under the controller.
    cells, weight
        The cells of C and m on them; starts are drawn by m.
    starts, steps, seed
        Number of runs, step limit, seed of starts and noise.
    hold
        Steps to run on after the first entry into A, where there is a local controller.
    deadline
        When to stop: the runs that have not ended by then count as cycling.
    """
    # States, images and their cells, controls, noise, and the arrays of the formulas.
    wide, live = len(loop.true_map.names), loop.true_map.map.live
    memory.require(8 * starts * (16 * wide + 12 + live), "runs")
    rng = np.random.default_rng(seed)
    if not len(cells) or not weight.any():
        raise BadInput("there is no stabilizable cell to start from")
    x = draw_starts(loop.partition, cells, weight, starts, rng)
    held = None
    with loop.true_map.helped():
        runs = loop.run(x, steps, rng, deadline)
        if loop.holds:
            held = loop.hold(runs.arrived, hold, rng, deadline)
    outcome, taken = runs.outcome, runs.taken
    reached = int((outcome == REACHED).sum())
    made = int(taken.max())
    cycling = int((outcome == CYCLING).sum())
    quantiles = None
    if reached:
        q = np.quantile(taken[outcome == REACHED], [0, 0.5, 0.9, 0.99, 1], method="inverted_cdf")
        quantiles = dict(zip(("min", "q50", "q90", "q99", "max"), map(int, q), strict=True))
    return Simulation(
        starts=starts,
        reached=reached,
        lost=int((outcome == LOST).sum()),
        cycling=cycling,
        steps=quantiles,
        interval=clopper_pearson(reached, starts),
        held=held,
        steps_made=made,
        cut=bool(cycling) and made < steps,
        aimed=not loop.problem.attractor.empty,
        lost_to={
            name: int(((outcome == LOST) & (runs.loss == k)).sum()) for k, name in enumerate(LOSSES)
        },
        cost=mean_cost(loop, runs),
        method=loop.method,
        followed=loop.followed,
    )


def clopper_pearson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact two-sided confidence interval of a binomial probability."""
    from scipy.special import betaincinv

    tail = (1 - level) / 2
    low = float(betaincinv(hits, trials - hits + 1, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1, trials - hits, 1 - tail)) if hits < trials else 1.0
    return low, high

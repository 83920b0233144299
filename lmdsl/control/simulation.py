"""The true map in closed loop: runs, and what became of them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.html import facts
from lmdsl.common.records import Frozen, jsonable
from lmdsl.common.types import Floats, Indices
from lmdsl.control.after_arrival import Held, quantiles
from lmdsl.control.costs import MeanCost, counted, mean_cost
from lmdsl.control.loop import CYCLING, LOSSES, LOST, OUTCOMES, REACHED, ClosedLoop, Runs
from lmdsl.control.steps import AS_DECLARED
from lmdsl.machine.deadline import Deadline

UNSAID = ("aimed", "followed", "given", "each")  # fields that no report holds apart
FEW = 0.01  # share of runs that miss the attractor above which the samples are called too few


@dataclass(frozen=True, eq=False)
class EachRun(Frozen):
    """What became of each run, in the order of the starts.

    Attributes
    ----------
    starts
        Where they began, shape (r, d).
    outcome
        ``reached``, ``lost`` or ``cycling``, shape (r,).
    lost_to
        Of the lost ``outside``, ``avoid`` or ``no_control``, else empty, shape (r,).
    steps, times
        Steps made, shape (r,), and the time that they took: in steps, where there is no other.
    cost
        What was paid by the powers of gamma (and of the discount), shape (r,); NaN of runs that
        have no cost: the lost, and those that go on where only arriving costs finitely.
    """

    starts: Floats
    outcome: NDArray[np.str_]
    lost_to: NDArray[np.str_]
    steps: Indices
    times: Floats
    cost: Floats

    @classmethod
    def of(cls, loop: ClosedLoop, x: Floats, runs: Runs) -> Self:
        """Return it of runs from states, shape (r, d)."""
        lost = np.array((*LOSSES, ""))[np.where(runs.outcome == LOST, runs.loss, len(LOSSES))]
        return cls(
            x,
            np.array(OUTCOMES)[runs.outcome],
            lost,
            runs.taken,
            runs.time * (loop.step_time or 1.0),
            np.where(counted(loop.problem, runs), runs.cost, np.nan),
        )


@dataclass(frozen=True, eq=False)
class Simulation(Frozen):
    """Outcome of closed-loop runs of the true map.

    Attributes
    ----------
    starts
        Number of runs; starts are given, or drawn by m (a cell, then uniform inside).
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
        ``mean`` of what ``runs`` paid, its ``standard_error`` (None for one run), ``cut_off``, at
        most how much more they pay later, and quantiles as of ``steps``. The runs are the reached;
        with a discount, and gamma times it below 1, all but the lost. None where there are none. To
        be compared with the certificate's cost where none is left out.
    method
        What was followed, in words: the map, or how its equation was integrated.
    followed
        Whose runs they are: the true map's, or those of a finite model's rows.
    times
        The same quantiles as ``steps`` of the time until A is entered, in the units of the
        equation; None of a map, and if none arrives.
    given
        The starts were given, not drawn.
    law
        Of the controller: ``constant`` on cells, as certified, or ``interpolated``.
    each
        What became of each run; not compared.
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
    times: dict[str, float] | None = None
    given: bool = False
    law: str = "constant"
    each: EachRun | None = field(default=None, compare=False, repr=False)

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
            f"{self.starts} runs of the {self.followed} from "
            f"{'given' if self.given else 'random'} starts",
            f"  reached the attractor  {self.reached}  ({100 * self.reached / self.starts:.4g} %; "
            f"95 % interval {100 * low:.4g} to {100 * high:.4g} %)",
            f"  lost                   {self.lost}{self._causes()}",
            f"  cycling                {self.cycling}",
        ]
        if not self.aimed:
            lines[1:4] = [lines[2], f"  going on               {self.cycling}  (no target)"]
        if self.law != "constant":
            lines.insert(1, f"  control                {self.law} between cells, not as certified")
        if self.method not in (AS_DECLARED, self.followed):
            lines.insert(1, f"  followed               {self.method}")
        if self.cut:
            lines[-1] += f"  (or cut off by the time limit after {self.steps_made} steps)"
        if self.steps:
            steps = ", ".join(f"{k} {v}" for k, v in self.steps.items())
            lines.append(f"  steps                  {steps}")
        if self.times:
            lines.append(f"  time                   {_quantiles(self.times)}")
        if self.cost:
            lines.append(self._paid(self.cost))
            if self.cost["runs"] != 1:
                shown = {key: self.cost[key] for key in ("min", "q50", "q90", "q99", "max")}
                lines.append(f"                         {_quantiles(shown)}")
        if self.held:
            lines += _went_on(self.held)
        return "\n".join(lines)

    __str__ = text

    def _repr_html_(self) -> str:
        low, high = self.interval
        share = f"{100 * self.reached / self.starts:.4g} %"
        sure = f"95 % interval {100 * low:.4g} to {100 * high:.4g} %"
        reached = f"{self.reached:,}: {share} ({sure})"
        rows = [("reached the attractor", reached)] * self.aimed
        rows += [("lost", f"{self.lost:,}{self._causes()}")]
        rows += [("cycling" if self.aimed else "going on", f"{self.cycling:,}")]
        if self.steps:
            rows.append(("steps", ", ".join(f"{k} {v:,}" for k, v in self.steps.items())))
        if self.cost:
            rows.append(("mean cost", f"{self._mean()}, of {int(self.cost['runs'] or 0):,} runs"))
        which = "given" if self.given else "random"
        title = f"{self.starts:,} runs of the {self.followed} from {which} starts"
        return facts([*rows, ("", self.sentence())], title)

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


def _went_on(held: Held) -> list[str]:
    """Return what became of the runs in A."""
    lines = [
        f"  then {held.steps} more steps under local controller and controller together",
        f"    stayed in the attractor  {held.stayed}",
        f"    left, and came back      {held.returned}",
        f"    left, on the way back    {held.away}",
        f"    left, and were lost      {held.lost}",
    ]
    if held.inside is not None:
        lines.append(f"    time in the attractor    {100 * held.inside:.4g} %")
    if held.left and held.mean_to_leave is not None:
        left = f"mean {held.mean_to_leave:.4g}, of these {_quantiles(held.left)}"
        lines.append(f"    steps until it is left   {left}")
    if held.distance:
        lines.append(
            f"    distance from the orbit  median {held.distance[0]:.3g}, "
            f"max {held.distance[1]:.3g} cell widths"
        )
    return lines


def _quantiles(values: Mapping[str, float | None]) -> str:
    return ", ".join(f"{key} {value:.4g}" for key, value in values.items())


def simulate(
    loop: ClosedLoop,
    x: Floats,
    steps: int,
    rng: np.random.Generator,
    hold: int,
    deadline: Deadline,
    given: bool = False,
) -> Simulation:
    """Simulate closed-loop runs.

    Parameters
    ----------
    loop
        The true map under the controller.
    x
        The starts, shape (r, d).
    steps, rng
        Step limit, and what noise is drawn from.
    hold
        Steps to run on after the first entry into A, where there is a local controller.
    deadline
        When to stop: the runs that have not ended by then count as cycling.
    given
        Whether the starts were given, not drawn.
    """
    starts, held = len(x), None
    with loop.true_map.helped():
        runs = loop.run(x, steps, rng, deadline)
        if loop.holds:
            held = loop.hold(runs.arrived, hold, rng, deadline)
    outcome, taken = runs.outcome, runs.taken
    reached = int((outcome == REACHED).sum())
    made = int(taken.max())
    cycling = int((outcome == CYCLING).sum())
    in_steps, in_time = None, None
    if reached:
        in_steps = {key: int(n) for key, n in quantiles(taken[outcome == REACHED]).items()}
        if loop.step_time:
            in_time = quantiles(runs.time[outcome == REACHED] * loop.step_time)
    return Simulation(
        starts=starts,
        reached=reached,
        lost=int((outcome == LOST).sum()),
        cycling=cycling,
        steps=in_steps,
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
        times=in_time,
        given=given,
        law=loop.controller.mode,
        each=EachRun.of(loop, x, runs),
    )


def clopper_pearson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact two-sided confidence interval of a binomial probability."""
    from scipy.special import betaincinv

    tail = (1 - level) / 2
    low = float(betaincinv(hits, trials - hits + 1, tail)) if hits else 0.0
    high = float(betaincinv(hits + 1, trials - hits, 1 - tail)) if hits < trials else 1.0
    return low, high

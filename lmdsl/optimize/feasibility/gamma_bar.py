"""The largest feasible gamma: gamma_bar = 1/rho*, rho* = min over policies of rho(P_u) on C.

Two vectors that anyone can check enclose it (h(w) = min_a P_a w):

low    a policy u and w > 0 with low P_u w <= w: the policy is gamma-stabilizing for gamma < low.
high   w >= 0, w != 0 with w <= high P_a w for every surviving pair: at gamma >= high the cells
       with w > 0 have no policy of finite occupation.

gamma_bar is infinite exactly when C is exhausted by levels "some surviving pair has all
successors in A or in lower levels": then a policy reaches A within a fixed number of steps.

The limit of one policy is found class by class (``spectral_radius``). Then *optimal stopping* at a
gamma slightly beyond that limit decides whether the policy is as good as any. Its greatest solution
w is the upper vector, supported where it keeps growing, zero elsewhere (plain power iteration
would not close the bracket for reducible structures); or w = 0, and the policy it ends with is
stabilizing at that gamma: a better policy, from which to go on. Policy iteration under unit cost
just below the limit takes most steps at once, and halving the bracket bounds their number.
"""

import math
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.records import Frozen
from lmdsl.common.types import FilePath, Floats, Policy, Progress, TimeUp, never, told
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline, Stopped
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.boxes import Area
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.optimize.feasibility import spectral_radius
from lmdsl.optimize.feasibility.infeasible import (
    LEAST_WIDTH,
    WIDTH,
    _beyond,
    _climbed,
    _core,
    check_high,
    exhausted_by_levels,
)
from lmdsl.optimize.feasibility.spectral_radius import PolicyClasses
from lmdsl.problem import Problem, given

# How far beyond the limit of a policy optimal stopping is asked where doubles decide no nearer.
FARTHER = (1e-5, 1e-3, 0.1, 1.0)

# Relative width down to which the bracket is halved, so often before it is tried to close.
COARSE, HALVINGS = 1e-2, 2


@dataclass(frozen=True, eq=False)
class GammaBar(Frozen):
    """A proved bracket of gamma_bar.

    Attributes
    ----------
    low, high
        gamma_bar lies in [low, high]; both infinite when the graph test says so, high infinite
        alone when no upper bound was found.
    policy
        A policy that is gamma-stabilizing for every gamma < low: a column per cell of C.
    w_low
        w > 0 with low P_u w <= w, shape (n,); None where gamma_bar is infinite.
    w_high
        w >= 0, not 0, with w <= high P_a w for every pair, shape (n,); None where high is infinite.
    note
        Empty, or why the bracket is wider than asked for, or that no cell is stabilizable.
    beyond
        The cells with w_high > 0: no policy has finite cost from them at gamma >= high. None
        where high is infinite.
    limiting
        Those of them that limit gamma_bar: a w that is 0 on all other cells satisfies the same
        inequality, whatever happens there. The rest of ``beyond`` cannot avoid them, or worse.
    stabilizable
        Number of cells of C. Where it is 0, low and high are 0: no gamma is feasible.
    """

    low: float
    high: float
    policy: Policy
    w_low: Floats | None
    w_high: Floats | None
    note: str = ""
    beyond: Area | None = None
    limiting: Area | None = None
    stabilizable: int = 0

    @property
    def corner(self) -> bool:
        """True when gamma_bar is that of a part of C; the other cells allow a larger gamma."""
        return self.beyond is not None and len(self.beyond) < self.stabilizable

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data; ``gamma_bar`` is None where no cell is stabilizable."""
        bracket = [x if math.isfinite(x) else "inf" for x in (self.low, self.high)]
        return {
            "gamma_bar": bracket if self.stabilizable else None,
            "stabilizable_cells": self.stabilizable,
            "limiting": self.limiting and self.limiting.to_dict(),
            "beyond": self.beyond and self.beyond.to_dict(),
            "note": self.note,
        }

    def text(self) -> str:
        """Return the bracket and the cells behind it for people."""
        if not self.stabilizable:
            return f"{self.note}, so there is no gamma_bar"
        lines = [f"gamma_bar lies in [{self.low!r}, {self.high!r}]"]
        if self.note:
            lines.append(f"  {self.note}")
        if self.beyond is not None and self.limiting is not None:
            limiting, beyond, n = self.limiting, self.beyond, self.stabilizable
            lines.append(f"  limited by {len(limiting)} of {n} stabilizable cells: {limiting}")
            if len(beyond) > len(limiting):
                also = f": {beyond}" if self.corner else ""
                lines.append(f"  with those that cannot avoid them {len(beyond)} cells{also}")
            if self.corner:
                lines.append(f"  {CORNER}")
        return "\n".join(lines)

    __str__ = text


CORNER = (
    "this corner limits gamma_bar for all; --restrict-to-gamma (restrict_to_gamma=True) solves on "
    "the cells for which gamma is feasible"
)


@own_arithmetic
def gamma_max(
    problem: Problem | StabilizationLP | FilePath,
    progress: Progress | bool | None = None,
    time_limit: float | Deadline | None = None,
    width: float = WIDTH,
) -> GammaBar:
    """Enclose the largest feasible gamma of a problem.

    Parameters
    ----------
    problem
        A problem, the path of its file, or its compiled LP; its own gamma plays no part.
    progress
        Called with (stage, fraction done, or -1); True shows it on stderr.
    time_limit
        Seconds; then the bracket is as tight as it was made by then.
    width
        Relative width asked for, 1e-8 to 1; as a rule a wider one saves half of the time.

    Returns
    -------
    GammaBar
        Relative width at most ``width``, wider only where the vectors leave the range of doubles.
        Where no cell is stabilizable, no gamma is feasible: both ends are 0.

    Raises
    ------
    BadInput
        The problem cannot be compiled, or the width is no such number.
    TimeLimitReached
        It was not compiled in time.
    """
    progress = told(progress)
    problem = given(problem, StabilizationLP)
    if not inputs.is_number(width) or not LEAST_WIDTH <= width <= 1:
        raise BadInput(f"{shown(width)} must be a number from {LEAST_WIDTH} to 1", "width")
    deadline = Deadline.of(time_limit)
    lp = compile(problem, progress, deadline) if isinstance(problem, Problem) else problem
    if progress:
        progress("gamma-max", -1.0)
    return bracket(lp, deadline, width=width)


def bracket(
    lp: StabilizationLP,
    time_up: TimeUp = never,
    limit: int = 60,
    width: float = WIDTH,
    start: PolicyClasses | None = None,
) -> GammaBar:
    """Enclose gamma_bar of a compiled model, from a policy; ``time_up`` ends the work early."""
    if not lp.n:
        none = np.empty(0, dtype=np.int64)
        return GammaBar(0.0, 0.0, none, None, None, "no cell is stabilizable")
    certain = exhausted_by_levels(lp)
    if certain is not None:
        return GammaBar(math.inf, math.inf, certain, None, None, stabilizable=lp.n)
    search = _Search(lp, time_up, lp._algorithm_1[1], width)
    with suppress(Stopped):
        search.run(limit, start)
    return search.found()


def enclosed(lp: StabilizationLP, low: float, high: float) -> tuple[float, float]:
    """Return a proved bracket of gamma_bar that lies in [low, high], or is as narrow as can be."""
    if not lp.n:
        return 0.0, 0.0
    if exhausted_by_levels(lp) is not None:
        return math.inf, math.inf
    proved = 0.0, math.inf
    for width in (WIDTH, LEAST_WIDTH):
        search = _Search(lp, never, lp._algorithm_1[1], width)
        search.time_up = partial(search.within, low, high)
        with suppress(Stopped):
            search.run(60)
        proved = max(proved[0], search.low), min(proved[1], search.high)
        if proved[0] >= low and proved[1] <= high:
            break
    return proved


class _Search:
    """The bracket while it narrows: both ends, their vectors, and the best policy so far."""

    def __init__(self, lp: StabilizationLP, time_up: TimeUp, policy: Policy, width: float) -> None:
        self.lp, self.time_up, self.policy, self.width = lp, time_up, policy, width
        self.steps = (0.1 * width, 0.4 * width, *(x for x in FARTHER if x > width))
        self.low, self.high = 0.0, math.inf
        self.w_low: Floats | None = None
        self.w_high: Floats | None = None
        self.best: PolicyClasses | None = None

    @property
    def closed(self) -> bool:
        return self.high <= self.low * (1 + self.width)

    def within(self, low: float, high: float) -> bool:
        return self.low >= low and self.high <= high

    def run(self, limit: int, start: PolicyClasses | None = None) -> None:
        """Narrow the bracket until it closes, or doubles decide no more."""
        best = start or spectral_radius.short_lived(self.lp, self.time_up)
        for _ in range(limit):
            best = spectral_radius.improved(self.lp, best, self.time_up, least=0.01 * self.width)
            self._raise_low(best)
            if self.time_up():
                return
            better = self._closing(best)
            if self.closed:
                return
            if better is None:
                better = _climbed(self.lp, best, self.time_up)
                if better is best:
                    return
            best = better
            # Halve the bracket too, so that many small gains cannot make it long.
            for _ in range(HALVINGS):
                top = self.high if math.isfinite(self.high) else 4 * best.limit
                if top <= best.limit * (1 + COARSE) or self.time_up():
                    break
                answer = _beyond(self.lp, best, math.sqrt(best.limit * top), self.time_up)
                if isinstance(answer, PolicyClasses):
                    best = answer
                elif answer is not None:
                    self._take(*answer)
                else:
                    break

    def _closing(self, best: PolicyClasses) -> PolicyClasses | None:
        """Ask a little beyond the limit of a policy: take the high, or return a better policy."""
        self._take(check_high(self.lp, best.slow_vector), best.slow_vector)
        closed = self.closed
        for step in self.steps[:1] if closed else self.steps:
            answer = _beyond(self.lp, best, best.limit * (1 + step), self.time_up)
            if isinstance(answer, PolicyClasses):
                return answer
            if answer is not None:
                # Of two vectors that close it, that of optimal stopping names all cells.
                self._take(*answer, closed and answer[0] <= self.low * (1 + self.width))
                break
        return None

    def _raise_low(self, best: PolicyClasses) -> None:
        self.best = best
        proved = spectral_radius.prove_low(self.lp, best)
        if proved is not None and proved[0] > self.low:
            self.low, self.w_low = proved
            self.policy = best.policy

    def _take(self, high: float | None, w: Floats, anyway: bool = False) -> None:
        if high is not None and (high < self.high or anyway):
            self.high, self.w_high = high, w

    def found(self) -> GammaBar:
        """Return the bracket, and the cells behind its upper end."""
        lp, high, note = self.lp, self.high, ""
        if not self.closed:
            note = "the vectors leave the range of doubles; the bracket is as tight as they allow"
            note = "the work was ended before the bracket closed" if self.time_up() else note
        beyond = limiting = None
        if self.w_high is not None and self.best is not None:
            most = max(high, self.low * (1 + self.width))
            core, high = _core(lp, self.best, self.w_high, high, most, self.time_up)
            beyond, limiting = (Area.of(lp.partition, lp.cells[w > 0]) for w in (self.w_high, core))
        return GammaBar(
            self.low, high, self.policy, self.w_low, self.w_high, note, beyond, limiting, lp.n
        )

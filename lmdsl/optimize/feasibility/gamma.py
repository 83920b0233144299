"""The largest feasible gamma: gamma_bar = 1/rho*, rho* = min over policies of rho(P_u) on C.

Two vectors that anyone can check enclose it (h(w) = min_a P_a w):

low    a policy u and w > 0 with low P_u w <= w: the policy is gamma-stabilizing for gamma < low.
high   w >= 0, w != 0 with w <= high P_a w for every surviving pair: at gamma >= high the cells
       with w > 0 have no policy of finite occupation.

gamma_bar is infinite exactly when C is exhausted by levels "some surviving pair has all
successors in A or in lower levels": then a policy reaches A within a fixed number of steps.

The limit of one policy is found class by class (:mod:`lmdsl.optimize.feasibility.spectral_radius`). Then *optimal stopping* at a
gamma slightly beyond that limit decides whether the policy is as good as any. Its greatest solution
w is the upper vector, supported where growth wins and zero elsewhere (plain power iteration would
not close the bracket for reducible structures); or w = 0, and the policy it ends with is
stabilizing at that gamma: a better policy, from which to go on. Policy iteration under unit cost
just below the limit takes most steps at once, and halving the bracket bounds their number.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common import inputs
from lmdsl.common.frozen import Frozen
from lmdsl.common.types import Bools, Floats, Pairs, Progress, Stop, never
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline, Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.boxes import Area
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize import descent
from lmdsl.optimize.feasibility import first_policy, spectral_radius
from lmdsl.optimize.feasibility.spectral_radius import Growth
from lmdsl.optimize.policies import policy
from lmdsl.problem.problem import Problem

WIDTH, LEAST_WIDTH = 1e-6, 1e-8
"""Relative width of the bracket aimed at, and the least that may be asked for."""

FARTHER = (1e-5, 1e-3, 0.1, 1.0)
"""How far beyond the limit of a policy optimal stopping is asked where doubles decide no nearer."""

COARSE, HALVINGS = 1e-2, 2
"""Relative width down to which the bracket is halved, so often before it is tried to close."""

DODGES = 12
"""Steps of optimal stopping towards the cells that limit gamma_bar, which only names them."""


@dataclass(frozen=True, eq=False)
class GammaBar(Frozen):
    """A proved bracket of gamma_bar.

    Attributes
    ----------
    low, high
        gamma_bar lies in [low, high]; both infinite when the graph test says so, high infinite
        alone when no upper bound was found.
    pair
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
    pair: Pairs
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
    problem: Problem | StabilizationLP,
    progress: Progress | None = None,
    time_limit: float | Deadline | None = None,
    width: float = WIDTH,
) -> GammaBar:
    """Enclose the largest feasible gamma of a problem.

    Parameters
    ----------
    problem
        A problem, or its compiled LP; its own gamma plays no part.
    progress
        Called with (stage, fraction done, or -1).
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
    inputs.kind(problem, (Problem, StabilizationLP), "problem", "a Problem or a compiled LP")
    number = isinstance(width, float | int | np.floating | np.integer) and width is not True
    if not number or not LEAST_WIDTH <= width <= 1:
        raise BadInput(f"{shown(width)} must be a number from {LEAST_WIDTH} to 1", "width")
    deadline = Deadline.of(time_limit)
    lp = compile(problem, progress, deadline) if isinstance(problem, Problem) else problem
    if progress:
        progress("gamma-max", -1.0)
    return bracket(lp, deadline, width=width)


def bracket(
    lp: StabilizationLP,
    stop: Stop = never,
    limit: int = 60,
    width: float = WIDTH,
    start: Growth | None = None,
) -> GammaBar:
    """Enclose gamma_bar of a compiled model, from a policy; ``stop`` ends the work early."""
    if not lp.n:
        nobody = np.empty(0, dtype=np.int64)
        return GammaBar(0.0, 0.0, nobody, None, None, "no cell is stabilizable")
    certain = exhausted_by_levels(lp)
    if certain is not None:
        return GammaBar(math.inf, math.inf, certain, None, None, stabilizable=lp.n)
    search = _Search(lp, stop, lp._algorithm_1[1], width)
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
        search.stop = partial(_inside, search, low, high)
        with suppress(Stopped):
            search.run(60)
        proved = max(proved[0], search.low), min(proved[1], search.high)
        if proved[0] >= low and proved[1] <= high:
            break
    return proved


def _inside(search: _Search, low: float, high: float) -> bool:
    return search.low >= low and search.high <= high


class _Search:
    """The bracket while it narrows: both ends, their vectors, and the best policy so far."""

    def __init__(self, lp: StabilizationLP, stop: Stop, pair: Pairs, width: float) -> None:
        self.lp, self.stop, self.pair, self.width = lp, stop, pair, width
        self.steps = (0.1 * width, 0.4 * width, *(x for x in FARTHER if x > width))
        self.low, self.high = 0.0, math.inf
        self.w_low: Floats | None = None
        self.w_high: Floats | None = None
        self.best: Growth | None = None

    @property
    def closed(self) -> bool:
        return self.high <= self.low * (1 + self.width)

    def run(self, limit: int, start: Growth | None = None) -> None:
        """Narrow the bracket until it closes, or doubles decide no more."""
        best = start or spectral_radius.short_lived(self.lp, self.stop)
        for _ in range(limit):
            best = spectral_radius.improved(self.lp, best, self.stop, least=0.01 * self.width)
            self._raise_low(best)
            if self.stop():
                return
            better = self._closing(best)
            if self.closed:
                return
            if better is None:
                better = _climbed(self.lp, best, self.stop)
                if better is best:
                    return
            best = better
            # Halve the bracket too, so that many small gains cannot make it long.
            for _ in range(HALVINGS):
                top = self.high if math.isfinite(self.high) else 4 * best.limit
                if top <= best.limit * (1 + COARSE) or self.stop():
                    break
                answer = _beyond(self.lp, best, math.sqrt(best.limit * top), self.stop)
                if isinstance(answer, Growth):
                    best = answer
                elif answer is not None:
                    self._take(*answer)
                else:
                    break

    def _closing(self, best: Growth) -> Growth | None:
        """Ask a little beyond the limit of a policy: take the high, or return a better policy."""
        self._take(check_high(self.lp, best.slow_vector), best.slow_vector)
        closed = self.closed
        for step in self.steps[:1] if closed else self.steps:
            answer = _beyond(self.lp, best, best.limit * (1 + step), self.stop)
            if isinstance(answer, Growth):
                return answer
            if answer is not None:
                # Of two vectors that close it, that of optimal stopping names all cells.
                self._take(*answer, closed and answer[0] <= self.low * (1 + self.width))
                break
        return None

    def _raise_low(self, best: Growth) -> None:
        self.best = best
        proved = spectral_radius.prove_low(self.lp, best)
        if proved is not None and proved[0] > self.low:
            self.low, self.w_low = proved
            self.pair = best.pair

    def _take(self, high: float | None, w: Floats, anyway: bool = False) -> None:
        if high is not None and (high < self.high or anyway):
            self.high, self.w_high = high, w

    def found(self) -> GammaBar:
        """Return the bracket, and the cells behind its upper end."""
        lp, high, note = self.lp, self.high, ""
        if not self.closed:
            note = "the vectors leave the range of doubles; the bracket is as tight as they allow"
            note = "the work was ended before the bracket closed" if self.stop() else note
        beyond = limiting = None
        if self.w_high is not None and self.best is not None:
            most = max(high, self.low * (1 + self.width))
            core, high = _core(lp, self.best, self.w_high, high, most, self.stop)
            beyond, limiting = (Area.of(lp.partition, lp.cells[w > 0]) for w in (self.w_high, core))
        return GammaBar(
            self.low, high, self.pair, self.w_low, self.w_high, note, beyond, limiting, lp.n
        )


def check_high(lp: StabilizationLP, w: Floats) -> float | None:
    """Return the least high (rounded up) with w <= high P_a w for all pairs, None if none is."""
    if not (np.isfinite(w).all() and (w >= 0).all() and (w > 0).any()):
        return None
    ahead = descent.backup_below(lp, w, 1.0, None)
    on = w > 0
    if (ahead[on] <= 0).any():
        return None
    return float((w[on] / ahead[on]).max()) * (1 + 4 * bounds.UNIT)


def exhausted_by_levels(lp: StabilizationLP) -> Pairs | None:
    """Return a policy that reaches A within n steps surely, None where there is none."""
    before = lp.predecessors
    pair = np.full(lp.n, -1, dtype=np.int64)
    _sure_levels(before.pointer, before.pair, lp.rows.pointer, lp.rows.target, lp.cell, pair)
    return pair if (pair >= 0).all() else None


def _climbed(lp: StabilizationLP, start: Growth, stop: Stop) -> Growth:
    """Improve a policy under unit cost just below its limit, where its value fits into doubles."""
    unit = np.ones(lp.K)
    for below in (1e-3, 0.1):
        at = start.limit * (1 - below)
        value = policy.evaluate(lp, start.pair, at, unit, stop=stop)
        if value is None:
            continue
        done = policy.iterate(lp, start.pair, value, at, unit, stop=stop)
        if not done.steps:
            return start
        found = spectral_radius.of_policy(lp, done.pair, stop)
        return found if found.limit > start.limit else start
    return start


def _beyond(
    lp: StabilizationLP, start: Growth, gamma: float, stop: Stop, inside: Bools | None = None
) -> Growth | tuple[float, Floats] | None:
    """Decide a gamma: a policy that is stabilizing there, or a proved high and its vector.

    Neither where doubles do not decide. The first stopping policy goes on wherever the class of
    ``start`` does not grow. With ``inside`` the vector is 0 in all other cells.
    """
    going = start.rate < (1 - 1e-12) / gamma  # gamma may be infinite
    reward = np.where(going, 1.0, start.x)  # which nothing changes, where no policy is better
    if inside is not None:
        reward, going = np.where(inside, reward, 0.0), going & inside
    limit = 1000 if inside is None else DODGES
    found = first_policy.optimal_stopping(lp, gamma, reward, start.pair, going, stop, limit)
    if found is None:
        return None
    if not found.refuses:
        better = spectral_radius.of_policy(lp, found.pair, stop) if found.going.all() else None
        return better if better is not None and better.limit > start.limit else None
    # Small entries may be rounding, or what carries a vector that falls over many decades.
    for w in (found.carried, found.w):
        high = check_high(lp, w)
        if high is not None and high <= gamma * (1 + 1e-9):
            return high, w
    return None


def _core(
    lp: StabilizationLP,
    best: Growth,
    w_high: Floats,
    high: float,
    most: float,
    stop: Stop,
) -> tuple[Floats, float]:
    """Return an upper vector on the slowest classes alone, and a high that holds for it too.

    Their Perron vectors serve where the best policy is also the least favourable one for them. Else
    stopping is rewarded in these classes only. Where neither closes the bracket (the controls can
    dodge from one slow class to another), w_high itself serves.
    """
    needed = check_high(lp, best.slow_vector)
    if needed is not None and needed <= most:
        return best.slow_vector, max(high, needed)
    # How far the controls can dodge these classes: they limit nothing if far enough.
    alone = spectral_radius.improved(lp, best, stop, most, inside=best.slowest)
    if alone.limit > most:
        return w_high, high
    answer = None
    with suppress(Stopped):
        answer = _beyond(lp, alone, alone.limit * (1 + 0.1 * WIDTH), stop, best.slowest)
    if isinstance(answer, tuple) and answer[0] <= most:
        return answer[1], max(high, answer[0])
    return w_high, high


def refusal_message(
    lp: StabilizationLP, w: Floats, limits: GammaBar, bracket: tuple[float, float]
) -> str:
    """Return the sentence that refuses a gamma: the bracket, the cells, and what can be done.

    Parameters
    ----------
    lp, w
        The model, and the vector that proves its gamma infeasible, shape (n,).
    limits, bracket
        What is known of gamma_bar.
    """
    cells = Area.of(lp.partition, lp.cells[w > 0])
    left = lp.n - len(cells)
    parts = [
        f"gamma = {lp.gamma!r} is not below gamma_bar, which lies in "
        f"[{bracket[0]:.9g}, {bracket[1]:.9g}]: proved that no control makes the cost finite from "
        f"{_counted(cells)}"
    ]
    limiting = limits.limiting
    if limiting is not None and len(limiting) != len(cells):
        parts.append(f"gamma_bar is limited by {_counted(limiting)}")
    if left:
        parts.append(
            "this corner limits gamma_bar for all; lower gamma, or solve on the other "
            f"{left} cells with --restrict-to-gamma (restrict_to_gamma=True)"
        )
    else:
        parts.append("lower gamma")
    return "; ".join(parts)


def _counted(area: Area) -> str:
    """Return how many cells an area has, and where, as text."""
    return f"{len(area)} cell{'s' * (len(area) != 1)} ({area})"


def restricted(lp: StabilizationLP, w: Floats) -> StabilizationLP | None:
    """Leave out the cells a refusal proves infeasible, and the pairs that can lead to them.

    With w the greatest solution of w = min(1, gamma min_a P_a w), every cell with w = 0 keeps a
    pair whose successors all have w = 0: the smaller model is the part on which gamma is feasible.

    Parameters
    ----------
    lp, w
        The model and the vector of its refusal (claim 6), shape (n,).

    Returns
    -------
    StabilizationLP or None
        The model on the cells with w = 0; the others get the status BEYOND_GAMMA. None where no
        cell is left, or one is left without a pair.
    """
    inside, out = np.flatnonzero(w == 0), ~(w == 0)  # also where a file says -1 or NaN
    beyond = np.append(out, False)
    length = np.diff(lp.rows.pointer)
    leads = np.add.reduceat(beyond[lp.rows.target].astype(np.int64), lp.rows.pointer[:-1]) > 0
    columns = np.flatnonzero(~leads & (w[lp.cell] == 0) & (length > 0))
    if not len(inside) or len(np.unique(lp.cell[columns])) < len(inside):
        return None
    smaller = lp.part(columns, inside)
    status = lp.cell_status.copy()
    status[lp.cells[out]] = CellStatus.BEYOND_GAMMA
    total = math.fsum(smaller.weight)
    weight = smaller.weight / total if total > 0 else smaller.weight
    return replace(smaller, cell_status=status, weight=weight)


@kernel(allocates=True)
def _sure_levels(before_pointer, before_pair, pointer, target, cell, pair):  # type: ignore[no-untyped-def]
    """Peel off cells with a pair all of whose successors are in A or peeled off before."""
    n = len(pair)
    waits = np.empty(len(cell), dtype=np.int32)
    for k in range(len(cell)):
        waits[k] = pointer[k + 1] - pointer[k]
    queue = np.empty(n + 1, dtype=np.int64)
    queue[0] = n  # the attractor
    start, end = 0, 1
    while start < end:
        j = queue[start]
        start += 1
        for e in range(before_pointer[j], before_pointer[j + 1]):
            k = before_pair[e]
            waits[k] -= 1
            if waits[k] == 0 and pair[cell[k]] < 0:
                pair[cell[k]] = k
                queue[end] = cell[k]
                end += 1

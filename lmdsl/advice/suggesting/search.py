"""``suggest``: a search for step, cells and samples that fit each other.

Each trial is the problem on as many cells, with as many controls, as is cheap: compiled, solved,
and run on the true map. Steps are tried first, over a factor of 32; then one thing after the other
is changed by a factor of two, as long as that helps, then by its root: the step, the cells of one
axis against those of all others, the samples. In the end the best is tried beside the problem as
declared, on as many cells as this has.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from lmdsl.advice import sizes
from lmdsl.advice.suggesting import choices
from lmdsl.advice.suggesting.choices import Combination
from lmdsl.advice.suggesting.pilots import Attempt, tried
from lmdsl.advice.suggesting.reasons import reasons
from lmdsl.advice.suggesting.report import Suggestion, changes
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.assembly import estimates
from lmdsl.model.assembly.substeps import settled
from lmdsl.problem import Problem, given
from lmdsl.problem.local_control import without_orbit
from lmdsl.systems import MatrixSystem

# Additions that a trial takes about, and up to which the problem itself is tried.
TRIAL, WHOLE = 2e9, 1e11
CONTROLS = (10**6, 81, 27, 9, 5)  # numbers of controls that are tried, the most that are cheap
MOST = 48  # number of trials
LEAST = 200  # number of cells that a trial has at least
GAIN = 1.03  # by how much a better choice is better
ENOUGH = 0.98  # score above which nothing better is looked for
STEPS = (0.25, 0.5, 1, 2, 4, 8)  # times the declared step


class Best(NamedTuple):
    """The best choice so far, and what became of it."""

    choice: Combination
    pilot: Attempt


class _Trials:
    """Makes trials, each once, and keeps them."""

    def __init__(self, problem: Problem, deadline: Deadline, progress: Progress | None) -> None:
        self.problem, self.deadline, self.progress = problem, deadline, progress
        self.known: dict[str, Attempt] = {}
        self.cut = False

    def __call__(self, choice: Combination) -> Attempt | None:
        """Return what becomes of a choice; None where no more trials are made."""
        key = str((choice.step, choice.cells(self.problem), choice.sampling))
        if key in self.known:
            return self.known[key]
        if len(self.known) >= MOST or self.cut:
            return None
        if self.progress:
            self.progress("suggest", len(self.known) / MOST)
        try:
            self.known[key] = tried(self.problem, choice, self.deadline)
        except TimeLimitReached:
            self.cut = True
            return None
        return self.known[key]


@own_arithmetic
def suggest(
    problem: Problem | FilePath,
    *,
    time_limit: float | Deadline | None = None,
    progress: Progress | bool | None = None,
) -> Suggestion:
    """Suggest step, cells and samples together, from trials, and say why.

    The number of cells stays about the same. Trials are judged by the share of the box from which
    runs of the true map arrive, and by how many of those that are promised to arrive do.

    Parameters
    ----------
    problem
        A problem with a map or a differential equation, or the path of its file.
    time_limit
        Seconds, after which the best so far is suggested.
    progress
        Called with (stage, fraction done); True shows it on stderr.

    Raises
    ------
    BadInput
        It is a finite model, whose states are given, or cannot be compiled.
    TimeLimitReached
        The time was up before the first trial.
    """
    progress = told(progress)
    problem = given(problem)
    if isinstance(problem.system, MatrixSystem):
        raise BadInput("a finite model has its states and no samples; nothing is to be chosen",
                       "problem")  # fmt: skip
    deadline = Deadline.of(time_limit)
    base = _comparable(problem)
    most = _controls(settled(base, deadline))
    few = choices.thinned(base, most)
    factor = _affordable(choices.thinned(settled(base, deadline), most))
    trials = _Trials(few, deadline, progress)
    start = choices.own(base).scaled(factor)._replace(step=choices.own(base).step)
    before = trials(start)
    if before is None:
        raise TimeLimitReached("the time limit was reached while trying")
    best = _searched(trials, Best(start, before))
    return _decided(problem, base, trials, best, start, factor, deadline)


def _comparable(problem: Problem) -> Problem:
    """Return the problem as it can be tried on other cells, at no gamma that rules it out."""
    base = sizes.without_indices(problem)
    if base is None:
        raise BadInput("too many cells to name the attractor by boxes instead", "attractor.cells")
    return base.replaced(
        measure=None, gamma=min(problem.gamma, 1.0), **without_orbit(problem.local_controller)
    )


def _controls(problem: Problem) -> int:
    """Return how many of its controls a trial of all cells of a problem can have."""
    usual = problem.replaced(sampling=choices.usual(problem))
    for most in CONTROLS:
        if sizes.work(choices.thinned(usual, most)) <= TRIAL:
            break
    return most


def _affordable(problem: Problem) -> float:
    """Return the part of an axis' cells that a trial may have."""
    usual = problem.replaced(sampling=choices.usual(problem))
    cells = float(math.prod(axis.cells for axis in problem.state_box.values()))
    part = max(min(1.0, TRIAL / sizes.work(usual)), min(1.0, LEAST / cells))
    return float(part ** (1 / len(problem.states)))


def _searched(trials: _Trials, best: Best) -> Best:
    """Return the best choice that is found."""

    def better(choice: Combination) -> bool:
        nonlocal best
        if best.pilot.score > ENOUGH:
            return False
        pilot = trials(choice)
        if pilot is None or not pilot.score > GAIN * best.pilot.score:
            return False
        best = Best(choice, pilot)
        return True

    problem, start = trials.problem, best.choice
    usual = start._replace(sampling=choices.usual(problem))
    for factor in STEPS if start.step is not None else (1,):
        better(usual._replace(step=None if start.step is None else start.step * factor))
    for radius in (1.0, 0.5):
        while _round(choices.moves(problem, radius), lambda move: better(move(best.choice))):
            pass
    return best


def _round(moves: Any, attempt: Callable[[Any], bool]) -> bool:
    """Make every move as often as it helps; return whether one did."""
    helped = False
    for move in moves:
        while attempt(move):
            helped = True
    return helped


def _decided(
    problem: Problem,
    base: Problem,
    trials: _Trials,
    best: Best,
    start: Combination,
    factor: float,
    deadline: Deadline,
) -> Suggestion:
    """Try the best beside the problem as it is, on as many cells; return the better one."""
    scaled = best.choice.scaled(1 / factor)
    asked = [best.choice, scaled._replace(step=best.choice.step), scaled]
    asked = [choice.rounded() for choice in asked]
    asked = list({str((c.step, c.cells(base), c.sampling)): c for c in asked}.values())
    before, finals = trials(start), [Best(best.choice, best.pilot)]
    whole = all(_cheap(choice.of(base)) for choice in (choices.own(base), *asked))
    if whole:
        try:
            before = tried(base, choices.own(base), deadline, True)
            finals = [Best(c, tried(base, c, deadline, True)) for c in asked if c.of(base) != base]
        except TimeLimitReached:
            whole, trials.cut, before = False, True, trials(start)
            finals = [Best(best.choice, best.pilot)]
    assert before is not None
    final = max(finals, key=lambda each: each.pilot.score, default=Best(start, before))
    better = final.pilot.score > GAIN * before.score
    changed = _written(problem, base, final.choice) if better else problem
    known = list(trials.known.values())
    return Suggestion(
        problem=changed,
        better=better,
        changes=changes(problem, changed),
        before=before,
        after=final.pilot if better else before,
        whole=whole,
        reasons=tuple(reasons(problem, known, best.pilot, changed)) if better else (),
        pilots=tuple(known),
        cut=trials.cut,
    )


def _cheap(problem: Problem) -> bool:
    return sizes.work(problem) <= WHOLE and memory.fits(estimates.estimate(problem))


def _written(problem: Problem, base: Problem, choice: Combination) -> Problem:
    """Return the problem with a choice."""
    kept = problem.measure
    if kept is not None and kept.weights is not None:
        kept = None  # a weight for each cell fits no other cells
    own = problem.replaced(attractor=base.attractor, measure=kept)
    return choice.of(own)

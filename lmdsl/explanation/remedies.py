"""Changes of a problem that may help, and what a compilation shows of them.

A period is *hidden* where the map does not change when a state is moved by the length of its axis
(images may move by whole turns), though it does change in between, and the axis is not declared
periodic.
"""

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.explanation.one_cell import NAMES
from lmdsl.explanation.trials import MapTrial
from lmdsl.machine.deadline import Deadline
from lmdsl.model import stabilizable_set
from lmdsl.model.assembly import estimates
from lmdsl.model.assembly.substeps import settled
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid import boxes
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.systems.base import OdeSystem
from lmdsl.systems.named import NamedOde

MOST_SUBSTEPS = 1_000  # number above which no problem may have more
TURN = 2 * np.pi
LEAST_TURN, MOST_TURN = 0.98, 1.25  # turns that an axis may have that is meant as one
SAME, DIFFERENT = 1e-8, 1e-4  # differences of images, in lengths of the axis
PLACES = 64  # number of cells at which periods are looked for
ASIDE = (0.381966, 0.5)  # parts of a period by which a map with that period must change
# By how much a remedy raises the share of cells that can be stabilized; what is no difference.
GAIN, ABOUT = 0.1, 0.03
TRIAL = 1e9  # additions above which a change is not compiled
FACTORS = (2, 4, 8, 16, 32, 64)  # how much longer a step, how many times the cells, is tried


class StabilizableShare(NamedTuple):
    """How many of the cells outside attractor and avoid can be stabilized."""

    stabilizable: int
    free: int
    lost: Mapping[str, int] = {}
    """How many of the others there are by cause, by its name."""

    @property
    def share(self) -> float:
        """The same as a share, 1 where there is no such cell."""
        return self.stabilizable / self.free if self.free else 1.0


def coverage(problem: Problem, deadline: Deadline | None = None) -> StabilizableShare:
    """Return how much of a problem can be stabilized."""
    # A deadline of its own: a fault cancels it, and who asks goes on with other problems.
    deadline = None if deadline is None else Deadline(deadline.left)
    problem = settled(problem, deadline)
    partition = Partition.of(problem)
    transitions = holding.assembled(problem, partition, deadline=deadline)
    found = stabilizable_set.of_transitions(problem, partition, transitions, deadline)
    return counted(transitions, found)


def counted(transitions: Transitions, found: stabilizable_set.Stabilizable) -> StabilizableShare:
    """Return how much can be stabilized, and the causes of the others."""
    status = stabilizable_set.statuses(transitions, found)
    lost = {NAMES[code]: int((status == code).sum()) for code in stabilizable_set.LOST}
    return StabilizableShare(int(found.inside.sum()), len(found.inside), lost)


def cheap(problem: Problem, most: float) -> bool:
    """Return whether compiling a problem takes a moment at most."""
    return estimates.work(problem) <= most


def longer_step(problem: Problem, factor: int) -> Problem | None:
    """Return a problem with a longer step, integrated as finely; None where there is no step."""
    system: Any = problem.system
    if not isinstance(system, OdeSystem | NamedOde):
        return None
    changes: dict[str, Any] = {"step": system.step * factor}
    if isinstance(system.substeps, int):
        changes["substeps"] = min(system.substeps * factor, MOST_SUBSTEPS)
    return problem.replaced(system=system.replaced(**changes))


def better_step(
    problem: Problem, share: float, deadline: Deadline | None = None
) -> tuple[Problem, float] | None:
    """Return a problem with a longer step, and its share, where that gains; None where none does.

    Of those that compiling is cheap for, the shortest that gains about as much as the best.
    """
    found, most = [], 2 * TRIAL
    for factor in FACTORS:
        longer = longer_step(problem, factor)
        if longer is None or not cheap(longer, most):
            break
        found.append((longer, coverage(longer, deadline).share))
        most -= estimates.work(longer)
        if found[-1][1] >= 1 - ABOUT:
            break
    best = max((reached for _, reached in found), default=0.0)
    if best < share + GAIN:
        return None
    return next(one for one in found if one[1] >= best - ABOUT)


def with_cells(problem: Problem, cells: Mapping[str, int]) -> Problem:
    """Return a problem with other numbers of cells; its sets must not speak of cells."""
    axes = {
        name: axis.replaced(cells=cells.get(name, axis.cells))
        for name, axis in problem.state_box.items()
    }
    return problem.replaced(state_box=axes)


def on_circle(problem: Problem, name: str, period: float) -> Problem:
    """Return a problem with an axis made periodic."""
    axis = problem.state_box[name]
    middle = (axis.low + axis.high) / 2
    low, high = axis.low, axis.high
    if high - low != period:
        low, high = middle - period / 2, middle + period / 2
    changed = axis.replaced(low=low, high=high, periodic=True)
    return problem.replaced(state_box={**problem.state_box, name: changed})


def circle_words(problem: Problem, name: str, period: float) -> str:
    """Return what makes an axis periodic, in words of JSON."""
    axis = on_circle(problem, name, period).state_box[name]
    ends = f'"low": {axis.low!r}, "high": {axis.high!r}, '
    return f'{ends}"periodic": true in state_box.{name}'


def share_on_circle(
    problem: Problem, name: str, period: float, deadline: Deadline | None = None
) -> float | None:
    """Return the share that can be stabilized with an axis made periodic, None if not cheap."""
    changed = on_circle(problem, name, period)
    if not cheap(changed, TRIAL):
        return None
    try:
        return coverage(changed, deadline).share
    except BadInput:  # its sets reach beyond the axis
        return None


def hidden_periods(trial: MapTrial) -> Iterator[tuple[int, float]]:
    """Yield the axes that look like circles and are not declared so, with their periods."""
    for k in np.flatnonzero(~trial.partition.periodic):
        span = float(trial.span[k])
        about = LEAST_TURN <= span / TURN <= MOST_TURN
        for period in (span, TURN) if about else (span,):
            if repeats(trial, int(k), period):
                yield int(k), period
                break


def repeats(trial: MapTrial, axis: int, period: float) -> bool:
    """Return whether the map has a period along an axis, and is not the same everywhere along it.

    Images may move by whole turns of a circle, and along the axis by whole periods. Where the image
    along the axis is straight (3 x + u: whole periods go to whole periods), that is no circle.
    """
    p = trial.partition
    cells = np.unique(np.random.default_rng(0).integers(p.size, size=PLACES))
    state, vectors = trial.start(cells), trial.vectors()

    def moved(by: float) -> list[Floats]:
        """Return by how much images change, along the axis what is more than ``by``."""
        at = [x + by if j == axis else x for j, x in enumerate(state)]
        change = [new - old for new, old in zip(trial.images(at, vectors), here, strict=True)]
        return [x - by if j == axis else x for j, x in enumerate(change)]

    with np.errstate(all="ignore"):
        here = trial.images(state, vectors)
        turned = moved(period)
        for j, x in enumerate(turned):
            circle = period if j == axis else float(trial.span[j])
            if j == axis or p.periodic[j]:
                x = x - np.round(x / circle) * circle
            if not np.abs(x).max() <= SAME * trial.span[j]:
                return False
        for part in ASIDE:
            for j, x in enumerate(moved(part * period)):
                if j == axis:
                    x = x - part * turned[j]
                if np.abs(x).max() >= DIFFERENT * trial.span[j]:
                    return True
    return False


def attractor_boxes(problem: Problem, grow: int = 0) -> list[boxes.Ends]:
    """Return boxes that hold the attractor cells of a problem exactly, or some cells more around.

    Across the seam of a periodic axis there are two.
    """
    partition = Partition.of(problem)
    mask = CellSets.of(problem, partition).attractor
    found: list[boxes.Ends] = []
    for region in boxes.regions(partition, mask, boxes.MOST_REGIONS):
        parts: list[list[tuple[float, float]]] = []
        for k, (a, b) in enumerate(region.box.values()):
            wide = grow * float(partition.width[k])
            ends = (float(partition.low[k]), float(partition.high[k]))
            parts.append(_parts(a - wide, b + wide, ends, bool(partition.periodic[k])))
            parts[-1] = [
                (_short(a, partition.width[k]), _short(b, partition.width[k])) for a, b in parts[-1]
            ]
        found += [dict(zip(partition.names, each, strict=True)) for each in product(*parts)]
    return found


def _short(x: float, width: float) -> float:
    """Return a number of few digits that means the same edge of a cell."""
    for digits in range(1, 17):
        short = float(f"{x:.{digits}g}")
        if abs(short - x) <= 0.1 * EDGE * width:
            return short + 0.0
    return x


def _parts(
    a: float, b: float, ends: tuple[float, float], periodic: bool
) -> list[tuple[float, float]]:
    """Return an interval within an axis, in two parts across the seam of a circle."""
    low, high = ends
    if not periodic or (low <= a and b <= high):
        return [(max(a, low), min(b, high))]
    if b - a >= high - low:
        return [ends]
    turn = high - low
    if b > high:
        return [(a, high), (low, b - turn)] if a < high else [(a - turn, b - turn)]
    return [(a + turn, high), (low, b)]

"""What is chosen together, step, cells and samples, and the problem that this makes."""

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lmdsl.explanation.remedies import with_cells
from lmdsl.explanation.trials import some
from lmdsl.model.grid.axis import EDGE
from lmdsl.problem.axes import Axis
from lmdsl.problem.problem import Problem
from lmdsl.problem.whole.changing import with_step

NEAR = math.log(4 / 3)  # how far, in logarithms, from what is aimed at a number of cells may be
FAR = 0.5  # what that distance counts beside the part of the attractor that is lost
MORE = 1.2  # how many times the cells aimed at a choice may have
# Samples in a cell up to which a sampling is tried, and the times of the usual one up to which.
FEW_SAMPLES, TIMES = 16, 6
GRIDS, CORNERS = range(1, 5), 32  # grids tried; corners up to which a cell's are sampled


class Combination(NamedTuple):
    """A step, cells and samples.

    Attributes
    ----------
    step
        Sampling time; None of a map.
    aim
        Cells aimed at on each axis, not rounded.
    sampling
        As a problem file declares it.
    """

    step: float | None
    aim: tuple[float, ...]
    sampling: Any

    def of(self, problem: Problem) -> Problem:
        """Return the problem with this choice."""
        if self.step is not None:
            problem = with_step(problem, self.step)
        return with_cells(problem.replaced(sampling=self.sampling), self.cells(problem))

    def cells(self, problem: Problem) -> dict[str, int]:
        """Return the cells of each axis: near those aimed at, not many more in all."""
        if self.aim == own(problem).aim:
            return {name: axis.cells for name, axis in problem.state_box.items()}
        aim, most = self.aim, MORE * math.prod(self.aim)
        for _ in range(40):
            found = {n: count(problem, n, a) for n, a in zip(problem.states, aim, strict=True)}
            if math.prod(found.values()) <= max(most, 1):
                break
            aim = tuple(max(0.97 * a, 1.0) for a in aim)
        return found

    def stretched(self, axis: int, factor: float) -> "Combination":
        """Return more cells on an axis and fewer on the others, as many in all."""
        others = factor ** (-1 / (len(self.aim) - 1))
        aim = tuple(n * (factor if k == axis else others) for k, n in enumerate(self.aim))
        return self._replace(aim=tuple(max(n, 1.0) for n in aim))

    def rounded(self) -> "Combination":
        """Return the same with a step of few digits."""
        return self._replace(step=None if self.step is None else float(f"{self.step:.3g}"))

    def scaled(self, factor: float) -> "Combination":
        """Return so many times the cells on each axis, and a step that fits them.

        In a step a run moves h f, and errs by about a width w: w/(h f) of it. Images of a cell
        spread by h. Where both count alike the best step goes like the root of the width.
        """
        step = None if self.step is None else self.step * factor**-0.5
        return self._replace(step=step, aim=tuple(n * factor for n in self.aim))


def own(problem: Problem) -> Combination:
    """Return what a problem declares itself."""
    aim = tuple(float(axis.cells) for axis in problem.state_box.values())
    return Combination(getattr(problem.system, "step", None), aim, problem.sampling)


def count(problem: Problem, name: str, aim: float) -> int:
    """Return a number of cells near one, in which boxes of the attractor fit best.

    A point on an edge has two cells, one inside a cell one: then even numbers stay even.
    """
    axis = problem.state_box[name]
    parity = 2 if problem.attractor.points else 1
    low, high = math.floor(aim * math.exp(-NEAR)), math.ceil(aim * math.exp(NEAR))
    best, found = math.inf, max(round(aim), 1)
    for n in range(max(low, 1), high + 1):
        if n % parity != axis.cells % parity or abs(math.log(n / aim)) > NEAR + 0.5 / aim:
            continue
        loss = FAR * abs(math.log(n / aim)) + _lost(problem, name, n)
        if loss < best:
            best, found = loss, n
    return found


def _lost(problem: Problem, name: str, cells: int) -> float:
    """Return the largest part of a box of the attractor that is in no whole cell of an axis."""
    axis: Axis = problem.state_box[name]
    width, lost = (axis.high - axis.low) / cells, 0.0
    for box in problem.attractor.boxes:
        a, b = box.get(name, (axis.low, axis.high))
        first = math.ceil((max(a, axis.low) - axis.low) / width - EDGE)
        last = math.floor((min(b, axis.high) - axis.low) / width + EDGE)
        lost = max(lost, 1 - max(last - first, 0) * width / (b - a))
    return lost


def samplings(problem: Problem) -> list[dict[str, Any]]:
    """Return samplings worth trying, the fewest first: grids, corners, and points where many."""
    d = len(problem.states)
    most = max(FEW_SAMPLES, TIMES * min(2**d, CORNERS))
    found = [{"kind": "grid", "per_axis": 1, "corners": True}] if 2**d <= CORNERS else []
    grids = [{"kind": "grid", "per_axis": k} for k in GRIDS if k**d <= most]
    points = [] if 2**d <= CORNERS else [{"kind": "sobol", "points": CORNERS, "seed": 0}]
    known: list[dict[str, Any]] = [*grids, *found, *points]
    return sorted(known, key=lambda s: _count(problem, s))


def _count(problem: Problem, sampling: Mapping[str, Any]) -> int:
    return problem.replaced(sampling=sampling).sampling.count(problem.states)


def usual(problem: Problem) -> dict[str, Any]:
    """Return the sampling to begin with: enough to see what a cell does, not more."""
    enough = [s for s in samplings(problem) if s["kind"] != "grid" or s["per_axis"] > 1]
    return (enough or samplings(problem))[0]


def thinned(problem: Problem, most: int) -> Problem:
    """Return a problem with fewer controls, evenly chosen, with both ends."""
    grid = problem.control_grid
    each = int(most ** (1 / max(len(grid), 1)))
    each = max(each - (each % 2 == 0), 2)  # an odd number keeps the middle
    changed = {
        name: {"values": some(np.asarray(values.vector()), each).tolist()}
        if values.count() > each else values
        for name, values in grid.items()
    }  # fmt: skip
    return problem.replaced(control_grid=changed)


def moves(problem: Problem, radius: float) -> Iterator[Callable[[Combination], Combination]]:
    """Yield functions from a choice to another one: steps, then cells, then samples."""
    factor = 2.0**radius
    if own(problem).step is not None:
        for by in (factor, 1 / factor):
            yield partial(_longer, by=by)
    d = len(problem.states)
    for k in range(d if d > 1 else 0):
        for by in (factor, 1 / factor):
            yield partial(Combination.stretched, axis=k, factor=by)
    for sampling in samplings(problem):
        yield partial(_sampled, sampling=sampling)


def _longer(choice: Combination, by: float) -> Combination:
    return choice._replace(step=None if choice.step is None else choice.step * by)


def _sampled(choice: Combination, sampling: Any) -> Combination:
    return choice._replace(sampling=sampling)

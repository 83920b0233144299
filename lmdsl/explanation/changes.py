"""Hints of changes for which a problem was compiled again: the cause itself is removed.

longer step     cells keep all of their samples under every control, or too few can be stabilized:
                with a longer step more can be.
periodic axis   the map does not change when a state is moved by the length of its axis: with the
                axis declared periodic more can be stabilized.
box attractor   the attractor is the cells around points: with a box that also has the cells around
                these, more can be stabilized, and it does not shrink with the cells.
smaller cells   successors are enclosed, and by their samples more cells can be stabilized.

A hint is given if the share of the cells that can be stabilized rises by at least a tenth, where
compiling takes a moment. The figures are those of the compilations. Where it takes longer, a longer
step is named if a twentieth of the lost cells or more keep their samples, and a tenth of these at
most then does.
"""

import json
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from lmdsl.common.types import Indices, Statuses
from lmdsl.errors import BadInput
from lmdsl.explanation import remedies
from lmdsl.explanation.hints import Hint, hints
from lmdsl.explanation.trials import MapTrial, some
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.problem.local_control import without_orbit
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem

# Share of the lost cells that keep their samples, and of these a longer step may leave so many.
STUCK, LEFT = 0.05, 0.1
GROWTH = (1, 2, 4)  # number of cells by which the attractor is tried to grow on every side


def every_hint(
    problem: Problem, partition: Partition, status: Statuses, deadline: Deadline
) -> tuple[Hint, ...]:
    """Return what helps, as far as it was tried in time; a finite model has no map to try."""
    found: list[Hint] = []
    with suppress(TimeLimitReached):
        if not isinstance(problem.system, MatrixSystem):
            found += changes(problem, partition, status, deadline)
            found += hints(problem, partition, status, deadline)
    return tuple(found)


def changes(
    problem: Problem, partition: Partition, status: Statuses, deadline: Deadline
) -> Iterator[Hint]:
    """Yield the hints that compilations support, given the status of all cells (N,)."""
    lost = int(np.isin(status, LOST).sum())
    if not lost:
        return
    kept = int((status == CellStatus.STABILIZED).sum())
    share = kept / (kept + lost)
    bare = problem.replaced(measure=None, **without_orbit(problem.local_controller))
    yield from _longer_step(MapTrial(bare, partition, deadline), status, share, deadline)
    yield from _periodic(MapTrial(bare, partition, deadline), share, deadline)
    yield from _box(bare, share, deadline)
    yield from _smaller_cells(bare, share, deadline)


def _gain(share: float, then: float) -> str:
    return f"{100 * then:.3g} % of the cells can be stabilized instead of {100 * share:.3g} %"


def _longer_step(
    trial: MapTrial, status: Statuses, share: float, deadline: Deadline
) -> Iterator[Hint]:
    cells = some(np.flatnonzero(np.isin(status, LOST)), trial.most_cells)
    stuck = cells[trial.stuck(cells)]
    kept = (
        f"{len(stuck)} of {len(cells)} lost cells tried keep all of their samples under every "
        "control now"
    )
    numbers: dict[str, Any] = {"stuck": len(stuck), "tried": len(cells), "share": share}
    better = remedies.better_step(trial.problem, share, deadline)
    if better is not None:
        longer, then = better
        gain = f"{_gain(share, then)}; {kept}"
        numbers["share_then"] = then
    else:
        freed = _freed(trial, stuck) if len(stuck) >= STUCK * len(cells) else None
        if freed is None:
            return
        longer, left = freed
        gain = f"{left or 'none'} of them do; {kept}"
        numbers |= {"share_then": None, "stuck_then": left}
    system: Any = longer.system
    numbers |= {"step": float(f"{system.step:.12g}"), "substeps": system.substeps}
    step = f'"step": {numbers["step"]!r}, "substeps": {json.dumps(system.substeps)}'
    yield Hint("longer step", f"a longer step: with {step}, {gain}", numbers)


def _freed(trial: MapTrial, stuck: Indices) -> tuple[Problem, int] | None:
    """Return the shortest longer step that frees cells, where compiling would take too long."""
    for factor in remedies.FACTORS:
        longer = remedies.longer_step(trial.problem, factor)
        if longer is None or (factor == 2 and remedies.cheap(longer, 2 * remedies.TRIAL)):
            return None
        left = int(MapTrial(longer, trial.partition).stuck(stuck).sum())
        if left <= LEFT * len(stuck):
            return longer, left
    return None


def _periodic(trial: MapTrial, share: float, deadline: Deadline) -> Iterator[Hint]:
    for k, period in remedies.hidden_periods(trial):
        name = trial.partition.names[k]
        then = remedies.share_on_circle(trial.problem, name, period, deadline)
        if then is None or then < share + remedies.GAIN:
            continue
        words = remedies.circle_words(trial.problem, name, period)
        text = (
            f"a periodic axis: the map is the same when {name} is moved by {period:.7g}; with "
            f"{words}, {_gain(share, then)}"
        )
        numbers = {"axis": name, "period": period, "share": share, "share_then": then}
        yield Hint("periodic axis", text, numbers)


def _smaller_cells(problem: Problem, share: float, deadline: Deadline) -> Iterator[Hint]:
    if problem.successors != "enclosed" or not remedies.cheap(problem, remedies.TRIAL):
        return
    sampled = remedies.coverage(problem.replaced(successors=None), deadline).share
    if sampled <= share:
        return
    text = (
        f"smaller cells: by its samples {100 * sampled:.3g} % of the cells can be stabilized, not "
        f"{100 * share:.3g} %: the others are kept out by enclosures of whole cells, which are "
        "narrower on smaller cells and over shorter steps; a finer control grid has more to choose "
        "from"
    )
    numbers: dict[str, Any] = {"share": share, "share_sampled": sampled, "share_then": None}
    finer = (
        None
        if problem.attractor.cells
        else remedies.with_cells(
            problem, {name: 2 * axis.cells for name, axis in problem.state_box.items()}
        )
    )
    if finer is not None and remedies.cheap(finer, 4 * remedies.TRIAL):
        then = remedies.coverage(finer, deadline).share
        numbers["share_then"] = then
        text += f"; with twice the cells an axis it is {100 * then:.3g} %"
    yield Hint("smaller cells", text, numbers)


def _box(problem: Problem, share: float, deadline: Deadline) -> Iterator[Hint]:
    if not problem.attractor.points or not remedies.cheap(problem, remedies.TRIAL):
        return
    for grow in GROWTH:
        boxes = remedies.attractor_boxes(problem, grow)
        try:
            then = remedies.coverage(problem.replaced(attractor={"boxes": boxes}), deadline).share
        except BadInput:  # it meets avoid
            return
        if then >= share + remedies.GAIN:
            text = (
                f'a box as attractor: with "boxes": {json.dumps(boxes)} instead of points, '
                f"{_gain(share, then)}; it keeps its size when there are more cells, while that "
                "of points shrinks"
            )
            numbers = {"boxes": boxes, "cells_around": grow, "share": share, "share_then": then}
            yield Hint("box attractor", text, numbers)
            return

"""Findings about how far and where to a step goes, of samples of the true map."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from lmdsl.advice.report import Finding
from lmdsl.advice.survey import Survey
from lmdsl.common.types import Indices
from lmdsl.control.accuracy import TOO_MUCH, integration_error
from lmdsl.explanation import remedies
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.substeps import needed
from lmdsl.model.grid.partition import MAX_CELLS

STUCK = 0.05  # share of cells tried that keep their samples from which on a step is too short
COVERED = 0.9  # share of the cells stabilized from which on no longer step is looked for
WIDE = 2.0  # widths of a cell from which on the median sample moves far enough
CURED = 0.1  # the part of that share that a remedy may leave
EDGES = 0.1  # share of images on edges from which on that is no accident


def short_step(survey: Survey, share: float | None, deadline: Deadline) -> Iterator[Finding]:
    """Find cells out of which no control moves any sample, or too little, and a step that does.

    ``share`` is that of the problem's cells that can be stabilized, None if it is not known.
    """
    # What moves by a width and stays was turned round a circle, or back into the box.
    slow_ones = survey.stays & (survey.moved < 1)
    cells = survey.cells[slow_ones]
    count, tried = len(cells), len(survey.cells)
    if share == 1 or not tried:
        return  # a discount, say, ends what stays
    many = count >= max(STUCK * tried, 1)
    slow = share is not None and share < COVERED
    if not many and not (slow and float(np.median(survey.moved)) < WIDE):
        return
    of = slow_ones if many else np.ones(tried, dtype=np.bool_)
    moved = float(np.median(survey.moved[of]))
    figures: dict[str, Any] = {"cells": count, "tried": tried, "moved": moved}
    parts = [*_longer(survey, cells, share, figures, deadline)]
    if many:
        parts += _other_cells(survey, cells, moved, figures, bool(parts))
    if not parts and many:
        parts += _much_longer(survey, moved, figures)
    if not parts:
        return  # the map itself stays, or a longer step helps nothing
    far = f"moves {moved:.2g} widths of a cell"
    text = (
        f"in {count} of {tried} cells tried no control moves any sample out of its cell, so they "
        f"are trapped; under the control that moves it most the median sample of these {far}"
        if many
        else f"under the control that moves it most the median sample {far}, and from "
        f"{100 * (share or 0.0):.3g} % of the cells can the attractor be reached without loss; "
        "over a longer step controls tell more apart"
    )
    where = "system.step" if "step" in figures else "system"
    yield Finding("short_step", where, text, "; or ".join(parts), figures)


def _longer(
    survey: Survey, cells: Indices, share: float | None, figures: dict[str, Any], deadline: Deadline
) -> Iterator[str]:
    """Yield a longer step that helps, by its share where that is cheap to know."""
    if share is not None:
        better = remedies.better_step(survey.problem, share, deadline)
        if better is not None:
            longer: Any = better[0].system
            figures |= _step(longer) | {"share": share, "share_then": better[1]}
            yield (
                f"write {_json(_step(longer))} in system: then {100 * better[1]:.3g} % of the "
                f"cells can be stabilized instead of {100 * share:.3g} %"
            )
            return
    for factor in remedies.FACTORS if len(cells) else ():
        problem = remedies.longer_step(survey.problem, factor)
        if problem is None:
            return
        left = int(survey.of(problem).stuck_share(cells) * len(cells) + 0.5)
        if left <= CURED * len(cells):
            figures |= _step(problem.system) | {"left": left}
            yield f"write {_json(_step(problem.system))} in system: then {_left(left, len(cells))}"
            return


def _much_longer(survey: Survey, moved: float, figures: dict[str, Any]) -> Iterator[str]:
    """Yield about how much longer a step must be that is far too short for all that was tried."""
    if not 0 < moved < 1 / remedies.FACTORS[-1]:
        return
    if remedies.longer_step(survey.problem, 1) is None:
        yield f"let the system be about {1 / moved:.2g} steps of its map at once"
        return
    system: Any = survey.problem.system
    figures["step"] = float(f"{system.step / moved:.2g}")
    yield (
        f'write "step": {figures["step"]!r} in system, about {1 / moved:.2g} times as long: then '
        "that sample moves by about a width"
    )


def _step(system: Any) -> dict[str, Any]:
    return {"step": float(f"{system.step:.12g}"), "substeps": system.substeps}


def _other_cells(
    survey: Survey, cells: Indices, moved: float, figures: dict[str, Any], longer: bool
) -> Iterator[str]:
    """Yield more cells, or several steps at once."""
    finer = _more_cells(survey, cells)
    if finer is not None:
        figures |= {"cells_needed": finer[0]}
        yield f"write {_cells(finer[0])} in state_box: then {_left(finer[1], len(cells))}"
        if not longer:
            steps = max(int(np.ceil(1 / moved)), 2) if moved > 0 else 2
            yield f"let the system be {steps} steps of its map at once"


def _more_cells(survey: Survey, cells: Indices) -> tuple[dict[str, int], int] | None:
    """Return the smallest of some larger numbers of cells that samples of these cells leave."""
    places = survey.partition.centres(cells)
    for factor in remedies.FACTORS:
        own = {name: axis.cells * factor for name, axis in survey.problem.state_box.items()}
        if np.prod([float(n) for n in own.values()]) > MAX_CELLS:
            return None
        finer = survey.of(remedies.with_cells(survey.problem, own))
        at = finer.partition.locate(list(places.T))
        left = int(finer.stuck_share(at) * len(cells) + 0.5)
        if left <= CURED * len(cells):
            return own, left
    return None


def _left(left: int, count: int) -> str:
    return "none of these keeps its samples" if not left else f"{left} of these {count} are left"


def _json(data: Any) -> str:
    text = json.dumps(data)
    return text[1:-1] if isinstance(data, dict) else text


def _cells(cells: dict[str, int]) -> str:
    return ", ".join(f'"cells": {count} for {name}' for name, count in cells.items())


def few_substeps(survey: Survey, deadline: Deadline) -> Iterator[Finding]:
    """Find that the Runge-Kutta steps miss the differential equation, and how many do not."""
    if survey.sets is None:
        return
    error = integration_error(survey.problem, survey.sets, deadline)
    if error is None or not error.excessive:
        return
    text, enough = error.fault(), needed(survey.problem, deadline)
    if TOO_MUCH < error.largest < np.inf:
        text = (
            f"the steps are up to {error.largest:.2g} widths of a cell from the differential "
            "equation (99 % quantile), so that the answer is not about it"
        )
    figures = {"substeps": error.substeps, "widths": error.largest, "substeps_needed": enough}
    remedy = error.remedy()
    if enough > error.substeps:
        remedy = f'write "substeps": "auto" in system, which makes them {enough}'
    text = f"with {_count(error.substeps, 'substep')} {text}"
    yield Finding("few_substeps", "system.substeps", text, remedy, figures)


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def on_edges(survey: Survey) -> Iterator[Finding]:
    """Find axes on which images lie exactly on edges of cells, and numbers of cells that end it."""
    for k in np.flatnonzero(survey.on_edge >= EDGES):
        name, share = survey.partition.names[k], float(survey.on_edge[k])
        text = (
            f"{100 * share:.3g} % of the images of samples lie exactly on an edge between two "
            f"cells of {name}, so that rounding decides where they go"
        )
        figures: dict[str, Any] = {"axis": name, "share": share}
        found = _off_edges(survey, int(k))
        if found is None:
            remedy = "move low and high a little, or take random sample points"
        else:
            figures |= {"cells": found[0], "share_then": found[1]}
            remedy = (
                f'write "cells": {found[0]} for {name}: then {100 * found[1]:.3g} % do; or take '
                'random sample points: "sampling": {"kind": "random", "points": 16, "seed": 0}'
            )
        yield Finding("on_edges", f"state_box.{name}.cells", text, remedy, figures)


def _off_edges(survey: Survey, axis: int) -> tuple[int, float] | None:
    name = survey.partition.names[axis]
    count = survey.problem.state_box[name].cells
    for cells in (count + 1, count + 2, count + 3, max(count - 1, 1)):
        problem = remedies.with_cells(survey.problem, {name: cells})
        share = survey.of(problem).edge_share(axis, survey.partition.centres(survey.cells))
        if share <= CURED * float(survey.on_edge[axis]):
            return cells, share
    return None

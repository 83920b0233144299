"""Findings about the attractor, what noise does to arriving, and how much can be stabilized."""

import json
import math
import re
from collections.abc import Iterator
from itertools import product

import numpy as np

from lmdsl.advice.declaration import unsteered
from lmdsl.advice.jumps import beside
from lmdsl.advice.report import Finding
from lmdsl.advice.sizes import Level
from lmdsl.advice.survey import Survey
from lmdsl.common.types import Bools
from lmdsl.explanation.meanings import meanings
from lmdsl.explanation.trials import some
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.axis import AxisCells
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.sets import attractor_note
from lmdsl.problem.problem import Problem

KEPT = 0.75  # part of a declared box below which whole cells have left too little of it
FIT = 0.97  # part of an axis of a box that whole cells shall keep
MORE = 2.0  # how many times the cells of an axis are tried
FEW = 0.1  # share of cells that can be stabilized below which little is
REMEDY = re.compile(r"[:;] (?=use |shorten |enlarge )")  # where what to do begins
PLACES, MOST_NOISE = 64, 6  # number of cells at which noise is tried, and of its variables

LOOK = {
    "escapes": "what leaves the box from there: state_box too small, control_grid too weak, or a "
    "wrong sign or unit in system",
    "trapped": "whether any control moves states towards the attractor: which formula stands at "
    "which state in system, its signs, and how far control_grid goes",
    "leads to these": "what the lost cells beside these lose: with more cells or controls, less "
    "noise, or another step they may be avoided",
}


def shrunk(problem: Problem, partition: Partition) -> Iterator[Finding]:
    """Find that whole cells leave too little of a box of the attractor, and cells that fit it."""
    for i, box in enumerate(problem.attractor.boxes):
        where = f"attractor.boxes[{i}]"
        block = partition.inside_box(box, where)
        if not all(block):
            continue
        kept, then, cells, wide = 1.0, 1.0, {}, {}
        for axis, name, inside in zip(partition.axes, partition.names, block, strict=True):
            if name not in box:
                continue
            low, high = (min(max(x, axis.low), axis.high) for x in box[name])
            if high <= low:  # across the seam of a circle
                continue
            own = len(inside) * axis.width / (high - low)
            kept *= min(own, 1.0)
            if own >= FIT:
                then *= min(own, 1.0)
            else:
                cells[name], part = _fitting(axis, low, high)
                then *= part
                wide[name] = _outside(axis, low, high)
        if kept >= KEPT:
            continue
        one = problem.replaced(attractor={"boxes": [dict(box)]})
        note = attractor_note(one, partition).partition(" asked for ")[2]
        written = ", ".join(f'"cells": {count} for {name}' for name, count in cells.items())
        yield Finding(
            "shrunk_attractor",
            where,
            f"the cells inside are {100 * kept:.3g} % of the box: {note}",
            f"write {written} in state_box: then {100 * then:.3g} % are; or the box of whole cells "
            f"around it, {json.dumps(wide)}",
            {"kept": kept, "kept_then": then, "cells": cells, "around": wide},
        )


def _fitting(axis: AxisCells, low: float, high: float) -> tuple[int, float]:
    """Return the smallest of some numbers of cells that keeps an interval nearly, and its part."""
    length, own = axis.high - axis.low, int(axis.cells)
    best = (0.0, -own)
    for count in range(own + 1, int(MORE * own) + 1):
        first, last = (count * (x - axis.low) / length for x in (low, high))
        kept = (math.floor(last + 1e-6) - math.ceil(first - 1e-6)) / (last - first)
        if kept >= FIT:
            return count, min(kept, 1.0)
        best = max(best, (kept, -count))
    return -best[1], best[0]


def _outside(axis: AxisCells, low: float, high: float) -> list[float]:
    first = math.floor((low - axis.low) / axis.width + 1e-6)
    last = math.ceil((high - axis.low) / axis.width - 1e-6)
    return [float(f"{axis.low + k * axis.width:.12g}") + 0.0 for k in (first, last)]


def chance(survey: Survey) -> Iterator[Finding]:
    """Find that noise is wider than the attractor on an axis, wherever it was tried."""
    problem, p, noises = survey.problem, survey.partition, survey.problem.noise
    if not noises or survey.sets is None or problem.judged == "path" or len(noises) > MOST_NOISE:
        return
    ends = [(float(a.min()), float(b.max())) for a, b in (x.parts() for x in noises.values())]
    corners = np.array(list(product(*ends)))
    near = beside(p, survey.sets.attractor, survey.sets.free)  # where noise may be narrower
    cells = np.union1d(some(survey.cells, PLACES), some(near, PLACES))
    if not len(cells):
        return
    noise = list(np.ascontiguousarray(corners.T)[:, None, None, None, :])
    middle = [x[:, None, :, None] for x in p.samples(cells, np.full((1, p.dimension), 0.5))]
    with np.errstate(all="ignore"):
        images = survey.true_map(middle, survey.vectors(), noise, survey.guard)
        spans = [np.broadcast_to(x, (*x.shape[:3], len(corners))) for x in images]
        spread = [np.ptp(x, axis=3).ravel() / p.width[k] for k, x in enumerate(spans)]
    for k, name in enumerate(p.names):
        known = spread[k][np.isfinite(spread[k])]
        run = _longest(survey.sets.attractor.reshape(p.shape), k, bool(p.periodic[k]))
        if not len(known) or run == p.cells[k] or float(known.min()) <= run * (1 + 1e-6):
            continue
        wide = float(known.min())
        yield Finding(
            "noise_too_wide",
            "noise",
            f"in all cells tried a step spreads noise over {wide:.3g} cells of {name} or more, "
            f"and the attractor is {run} long there: under no control does a step surely arrive, "
            "only by chance, so that `prove` can prove nothing",
            f"make the attractor longer along {name} than {math.ceil(wide)} cells, or noise "
            "narrower",
            {"axis": name, "noise": wide, "attractor": run},
        )


def _longest(mask: Bools, axis: int, periodic: bool) -> int:
    """Return the length of the longest row of cells of a set along an axis."""
    rows = np.moveaxis(mask, axis, -1)
    count = rows.shape[-1]
    rows = np.concatenate([rows, rows], axis=-1) if periodic else rows
    ended = np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(1, 0)]).ravel()
    gaps = np.flatnonzero(~np.append(ended, False))
    return min(int(np.diff(gaps).max(initial=1)) - 1, int(count))


def little(problem: Problem, known: list[Level], deadline: Deadline) -> Iterator[Finding]:
    """Find that no cell of the problem's own can be stabilized, or few, and what dominates."""
    own = {name: axis.cells for name, axis in problem.state_box.items()}
    for level in known:
        if level.cells != own or not level.found.free or level.found.share >= FEW:
            continue
        if level.found.stabilizable:
            yield _few(problem, level)
            continue
        said = _unheld(problem, deadline)
        if said is not None:
            text, remedy = REMEDY.split(said, maxsplit=1)
            yield Finding(
                "nothing_holds", "local_controller", text,
                remedy,
                {"cells": level.found.free},
            )  # fmt: skip
        yield Finding(
            "nothing_stabilizable",
            "state_box",
            f"none of the {level.found.free} cells outside attractor and avoid can be stabilized"
            f"{_astray(problem)}",
            "`lmdsl explain FILE` says why, region by region, and what would help",
            {"cells": level.found.free},
        )


def _few(problem: Problem, level: Level) -> Finding:
    found, meaning = level.found, meanings(problem)
    causes = dict(sorted(found.lost.items(), key=lambda x: -x[1]))
    main = next(iter(causes))
    counted = ", ".join(f"{count} {name}" for name, count in causes.items() if count)
    return Finding(
        "few_stabilizable",
        "system",
        f"only {found.stabilizable} of {found.free} cells outside attractor and avoid can be "
        f"stabilized; most of the others ({counted}) by this cause, {main}: {meaning[main]}"
        f"{_astray(problem)}",
        f"look at {LOOK[main]}; `lmdsl explain FILE` goes region by region",
        {"stabilizable": found.stabilizable, "free": found.free, "causes": causes},
    )


def _astray(problem: Problem) -> str:
    """Return which states no control acts on, to go after a sentence."""
    names = unsteered(problem)
    return (
        f"; no control acts on {' and '.join(names)}, not even through other states"
        if (names)
        else ""
    )


def _unheld(problem: Problem, deadline: Deadline) -> str | None:
    """Return why no attractor cell holds; None where some does or none is asked to."""
    partition = Partition.of(problem)
    return holding.unheld(problem, partition, Deadline(deadline.left))

"""Findings about what is declared: names that nothing uses, angles, their units, order."""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from lmdsl.advice.report import Finding
from lmdsl.advice.survey import Survey
from lmdsl.explanation import remedies
from lmdsl.explanation.trials import MapTrial
from lmdsl.machine.deadline import Deadline
from lmdsl.problem.problem import Problem
from lmdsl.slabs.graph import cuts
from lmdsl.systems import MatrixSystem
from lmdsl.systems.named import NamedSystem

NAME = re.compile(r"[A-Za-z_]\w*")
TURN = remedies.TURN
SLACK = 1e-6  # part of a turn
RANKS = 4  # of which it is told what they know of each other's cells
CLEARLY = 1 / 2  # the part of that for which axes are reordered: what is in C is not known yet
FEW = 5  # blocks of an axis below which they tell too little


def unused(problem: Problem) -> Iterator[Finding]:
    """Find parameters, controls, noise and subexpressions that no formula uses."""
    if problem.functions:
        return  # who knows what they use
    formulas: list[str] = []
    parameters: Any = problem.system.parameters
    if isinstance(problem.system, NamedSystem):
        formulas += problem.system.formulas.values()
        parameters = ()  # its own formulas use them all
    data = problem.to_dict()
    formulas += _texts({key: data[key] for key in data if key not in ("format", "name")})
    used = set(NAME.findall(" ".join(formulas)))
    kinds = {
        "system.parameters": parameters,
        "let": data.get("let") or {},
        "control_grid": problem.controls,
        "noise": problem.noises,
    }
    for where, names in kinds.items():
        for name in names:
            if name not in used:
                yield Finding(
                    "unused",
                    f"{where}.{name}",
                    f"no formula uses {name}",
                    "remove it, or correct the formula in which it was meant",
                    {"name": name},
                )


def idle(problem: Problem) -> Iterator[Finding]:
    """Find controls that stand in formulas, of the cost say, and change no next state."""
    steps = _steps(problem)
    if not steps:
        return
    data, acting = problem.to_dict(), set[str]().union(*steps.values())
    kept = {key: data[key] for key in data if key not in ("format", "name", "system", "let")}
    let = data.get("let") or {}
    found = {}
    for name in problem.controls:
        keys = [key for key, part in kept.items() if name in _used(_texts(part), let)]
        if name not in acting and keys:
            found[name] = keys
    every = len(found) == len(problem.controls)
    for name, keys in found.items():
        whole = "no control changes any next state: " if every else ""
        yield Finding(
            "idle_control",
            f"control_grid.{name}",
            f"{whole}{name} {'stands' if every else 'changes no next state: it stands'} only in "
            f"{' and '.join(keys)}",
            f"write {name} into the formulas of system where it acts, or remove it",
            {"name": name, "stands_in": keys},
        )


def unsteered(problem: Problem) -> list[str]:
    """Return the states on which no control acts, not even through other states."""
    steps = _steps(problem)
    acting, before = set(problem.controls), set[str]()
    while acting != before:
        before = set(acting)
        acting |= {name for name, used in steps.items() if used & acting}
    return [name for name in steps if name not in acting]


def _steps(problem: Problem) -> dict[str, set[str]]:
    """Return the names that the formulas of each state use; empty where these are not known."""
    system: Any = problem.system
    formulas = None
    if isinstance(system, NamedSystem):
        formulas = system.formulas
    elif not problem.functions and not isinstance(system, MatrixSystem):
        data = problem.to_dict()["system"]
        formulas = data.get("derivative") or data.get("next")
    if not isinstance(formulas, Mapping) or set(formulas) != set(problem.states):
        return {}
    let = problem.to_dict().get("let") or {}
    return {name: _used(_texts([text]), let) for name, text in formulas.items()}


def _used(texts: list[str], let: Mapping[str, Any]) -> set[str]:
    """Return the names in formulas, also through subexpressions."""
    found, new = set[str](), set(NAME.findall(" ".join(texts)))
    while new:
        found |= new
        new = set(NAME.findall(" ".join(_texts([let[x] for x in new if x in let])))) - found
    return found


def _texts(data: Any) -> list[str]:
    """Return all strings in plain data."""
    if isinstance(data, str):
        return [data]
    if isinstance(data, Mapping):
        return [text for value in data.values() for text in _texts(value)]
    if isinstance(data, list):
        return [text for value in data for text in _texts(value)]
    return []


def angles(trial: MapTrial, share: float | None, deadline: Deadline) -> Iterator[Finding]:
    """Find axes that look like circles and are not declared so.

    ``share`` is that of the problem's cells that can be stabilized, None if it is not known.
    """
    for k, period in remedies.hidden_periods(trial):
        name = trial.partition.names[k]
        figures: dict[str, Any] = {
            "axis": name, "period": period, "length": float(trial.span[k])
        }  # fmt: skip
        remedy = f"write {remedies.circle_words(trial.problem, name, period)}"
        then = remedies.share_on_circle(trial.problem, name, period, deadline)
        if share is not None and then is not None:
            figures |= {"share": share, "share_then": then}
            remedy += (
                f": then {100 * then:.3g} % of the cells can be stabilized instead of "
                f"{100 * share:.3g} %"
            )
        yield Finding(
            "not_periodic",
            f"state_box.{name}",
            f"the map is the same when {name} is moved by {period:.7g}, and the axis is "
            f"{trial.span[k]:.7g} long: {name} looks like an angle, and leaving the axis counts "
            "as leaving the box",
            remedy,
            figures,
        )


def degrees(trial: MapTrial) -> Iterator[Finding]:
    """Find coordinates of an attractor that are no radians though the map takes these."""
    p = trial.partition
    circles = {
        name: (float(p.low[k]), float(p.high[k]))
        for k, name in enumerate(p.names)
        if abs(trial.span[k] - TURN) <= SLACK * TURN or remedies.repeats(trial, k, TURN)
    }
    for path, name, value in _coordinates(trial.problem):
        low, high = circles.get(name, (-math.inf, math.inf))
        if not low <= value <= high and abs(value) > TURN * (1 + SLACK):
            radians = math.radians(value)
            yield Finding(
                "degrees",
                path,
                f"{value:.6g} is {abs(value) / TURN:.3g} turns of {name}, whose formulas take "
                "radians; it looks like degrees",
                f"write {radians!r}",
                {"axis": name, "value": value, "radians": radians},
            )
    for k, name in enumerate(p.names):
        if abs(trial.span[k] - 360) <= 1 and remedies.repeats(trial, k, TURN):
            yield Finding(
                "degrees",
                f"state_box.{name}",
                f"the axis of {name} is {trial.span[k]:.6g} long, and the map is the same when "
                f"{name} is moved by 2 pi: the axis looks like degrees, the formulas take radians",
                f'write "low": {math.radians(p.low[k])!r}, "high": {math.radians(p.high[k])!r}, '
                f"or pi/180*{name} in the formulas",
                {"axis": name, "length": float(trial.span[k])},
            )


def _coordinates(problem: Problem) -> Iterator[tuple[str, str, float]]:
    """Yield the numbers of points and boxes of the attractor, with path and axis."""
    attractor = problem.attractor
    for i, point in enumerate(attractor.points):
        named = point if isinstance(point, dict) else dict(zip(problem.states, point, strict=True))
        for k, (name, value) in enumerate(named.items()):
            last = f".{name}" if isinstance(point, dict) else f"[{k}]"
            yield f"attractor.points[{i}]{last}", name, float(value)
    for i, box in enumerate(attractor.boxes):
        for name, ends in box.items():
            for k, value in enumerate(ends):
                yield f"attractor.boxes[{i}].{name}[{k}]", name, float(value)


def axis_order(survey: Survey) -> Iterator[Finding]:
    """Find that over ranks another axis should be declared first, of as many cells as a survey."""
    p = survey.partition
    if p.size < cuts.LARGE or isinstance(survey.problem.system, MatrixSystem):
        return
    blocks = cuts.Blocks.of(p, survey.count)
    if any(b < min(n, FEW) for b, n in zip(blocks.shape, p.shape, strict=True)):
        return
    counted = cuts.ghosts(blocks, survey.looked(blocks), RANKS)
    found = cuts.better(p, counted, CLEARLY)
    if found is None:
        return
    name, few, now = found
    told = ", ".join(f"{x:.2g} along {axis}" for axis, x in counted.items())
    yield Finding(
        "axis_order",
        "state_box",
        f"over {RANKS} ranks, which divide the cells along the first axis, each would know about "
        f"{now:.2g} cells of others for each own one ({told}); one process does not care",
        f"declare {name} first in state_box: then about {few:.2g}",
        {"ranks": RANKS, "by_axis": counted, "axis": name, "now": now, "then": few},
    )

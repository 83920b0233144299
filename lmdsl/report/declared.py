"""The problem as it was declared: what it says in words, and in mathematics."""

from collections.abc import Collection, Iterable, Mapping
from itertools import islice
from typing import Any

import numpy as np

from lmdsl.model.discretization import control_count, sample_points
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.consistency.endings import numbered
from lmdsl.problem.noise import NoiseNormal, NoiseUniform
from lmdsl.problem.problem import Problem
from lmdsl.problem.sampling import Grid
from lmdsl.problem.sets import Attractor, Avoid, Measure
from lmdsl.report import mathematics as m
from lmdsl.results.result import Result
from lmdsl.systems import FunctionSystem, MapSystem, MatrixSystem, NamedSystem, OdeSystem
from lmdsl.systems.matrices.data import DataSystem

MOST = 8  # boxes, points or formulas of a set that are written out
LONGEST = 60  # formulas and parameters that are written out
MOST_ROWS = 200  # of the table

DeclaredRow = dict[str, Any]  # ``name``, ``text`` and, where there is mathematics, ``math``


def problem_of(result: Result) -> dict[str, Any]:
    """Return what a problem says as plain data: a summary, equations, and a table."""
    problem = result.problem
    rows = [*_states(problem), *_controls(problem), *_noises(problem), *_sets(result),
            *_rest(problem)]  # fmt: skip
    return {
        "summary": _summary(problem),
        "equations": _equations(problem),
        "objective": _objective(problem),
        "rows": rows[:MOST_ROWS],
    }


def _names(problem: Problem) -> frozenset[str]:
    """Return every name that a formula of the problem may hold."""
    own = (*problem.states, *problem.controls, *problem.noises)
    return frozenset((*own, *problem.system.constants(), *(problem.let or {})))


def _kind(problem: Problem) -> str:
    system = problem.system
    if isinstance(system, DataSystem):
        return "a finite model of recorded transitions"
    if isinstance(system, MatrixSystem):
        return "a finite model, given by its rows"
    if isinstance(system, FunctionSystem):
        return "a map written as a Python function"
    if problem.flow(cost=False) is None:
        return "a discrete-time map"
    return "a differential equation, its control held during each sampling time"


def _summary(problem: Problem) -> str:
    cells, d = _cells(problem), len(problem.states)
    what = f"The system is {_kind(problem)}"
    what += ", with noise. " if problem.noise else ". "
    if problem.controls:
        count = control_count(problem)
        goal = "A feedback law is sought that chooses "
        what_ = "action" if numbered(problem) else "control value"
        goal += f"one of {count:,} {what_}s" if count > 1 else f"the one {what_}"
    else:
        goal = "It has no control, so this is an analysis of its stability. Every cell has one row"
    goal += f" in each of {cells:,} "
    goal += "states" if numbered(problem) else f"cells of the {d}-dimensional state box"
    if problem.attractor.empty:
        return f"{what}{goal}, so that the discounted cost is least: there is no target to reach."
    return f"{what}{goal}: it must reach the attractor A from as many cells as possible, at the " \
        "least expected cost."  # fmt: skip


def _cells(problem: Problem) -> int:
    found = 1
    for axis in problem.state_box.values():
        found *= axis.cells
    return found


def _equations(problem: Problem) -> list[str]:
    """Return the system and what ``let`` defines, MathML by block."""
    system, names, found = problem.system, _names(problem), []
    if isinstance(system, NamedSystem):
        system = system.definition()
    if isinstance(system, MapSystem | OdeSystem):
        right, left = (
            (system.next, _raised) if isinstance(system, MapSystem) else (system.derivative, _rate)
        )
        rows = [m.equation(left(k), m.shown(right[k], names)) for k in problem.states if k in right]
        found.append(m.table(rows[:LONGEST]))
    else:
        letters = ["x", "u"] if problem.controls else ["x"]
        inside = "<mo>,</mo>".join(f"<mi>{k}</mi>" for k in letters + ["w"] * bool(problem.noise))
        image = f"<mi>T</mi><mo>(</mo>{inside}<mo>)</mo>"
        found.append(m.block(f"<msup><mi>x</mi><mo>+</mo></msup><mo>=</mo>{image}"))
    if problem.let:
        rows = [
            m.equation(m.name(k), m.shown(v, names))
            for k, v in islice(problem.let.items(), LONGEST)
        ]
        found.append(m.table(rows))
    return found


def _raised(state: str) -> str:
    return f"<msup><mrow>{m.name(state)}</mrow><mo>+</mo></msup>"


def _rate(state: str) -> str:
    """Return a derivative as a fraction: dots above letters run into them in some browsers."""
    d = '<mi mathvariant="normal">d</mi>'
    return f"<mfrac><mrow>{d}{m.name(state)}</mrow><mrow>{d}<mi>t</mi></mrow></mfrac>"


def _objective(problem: Problem) -> str:
    """Return what is minimised, as MathML."""
    gamma = "<msup><mi>γ</mi><mi>n</mi></msup>" * (problem.gamma != 1)
    if problem.discount is not None:
        gamma += "<msup><mi>b</mi><mi>n</mi></msup>"
    until = "<mi>∞</mi>" if problem.attractor.empty else "<mi>N</mi><mo>−</mo><mn>1</mn>"
    total = f"<munderover><mo>∑</mo><mrow><mi>n</mi><mo>=</mo><mn>0</mn></mrow><mrow>{until}" \
        "</mrow></munderover>"  # fmt: skip
    at = "<msub><mi>x</mi><mi>n</mi></msub>"
    if problem.controls:
        at += "<mo>,</mo><msub><mi>u</mi><mi>n</mi></msub>"
    if problem.noise:
        at += "<mo>,</mo><msub><mi>w</mi><mi>n</mi></msub>"
    end = ""
    if problem.terminal_cost is not None and not problem.attractor.empty:
        weight = gamma.replace("<mi>n</mi>", "<mi>N</mi>")
        end = f"<mo>+</mo>{weight}<mi>F</mi><mo>(</mo><msub><mi>x</mi><mi>N</mi></msub><mo>)</mo>"
    least = "<mi>min</mi><mspace width='0.3em'/>" * bool(problem.controls)
    mean = f"<mi>E</mi><mo>[</mo>{total}{gamma}<mi>G</mi><mo>(</mo>{at}<mo>)</mo>{end}<mo>]</mo>"
    start = "<mo>,</mo><mspace width='0.8em'/><msub><mi>x</mi><mn>0</mn></msub><mo>∼</mo><mi>m</mi>"
    return m.block(f"{least}{mean}{start}")


def _row(name: str, text: str, *math: str) -> DeclaredRow:
    return {"name": name, "text": text, "math": list(math)}


def _states(problem: Problem) -> Iterable[DeclaredRow]:
    if numbered(problem):
        for state, axis in problem.state_box.items():
            yield _row("state", f"{axis.cells:,} of them", m.block(m.name(state), False))
        return
    for state, axis in problem.state_box.items():
        ends = f"{m.number(axis.low)} to {m.number(axis.high)}"
        circle = ", a circle" if axis.periodic else ""
        width = (axis.high - axis.low) / axis.cells
        text = f"{ends}{circle}; {axis.cells:,} cells of width {m.number(width, 4)}"
        yield _row("state", text, m.block(m.name(state), False))


def _controls(problem: Problem) -> Iterable[DeclaredRow]:
    for control, grid in problem.control_grid.items():
        low, high = grid.ends()
        count = grid.count()
        text = f"{count:,} values from {m.number(low)} to {m.number(high)}"
        if count <= MOST:
            text = ", ".join(m.number(float(x)) for x in grid.vector())
        yield _row("control", text, m.block(m.name(control), False))
    if problem.admissible is not None:
        math = m.block(m.shown(problem.admissible, _names(problem), True), False)
        yield _row("admissible", "only pairs of state and control with", math)


def _noises(problem: Problem) -> Iterable[DeclaredRow]:
    for name, noise in (problem.noise or {}).items():
        if isinstance(noise, NoiseNormal):
            text = f"normal, standard deviation {m.number(noise.normal.std)}"
        elif isinstance(noise, NoiseUniform):
            text = f"uniform from {m.number(noise.uniform.low)} to {m.number(noise.uniform.high)}"
        else:
            text = f"one of {len(noise.values)} values"
        text += f"; {noise.count()} nodes in the model"
        yield _row("noise", text, m.block(m.name(name), False))


def _sets(result: Result) -> Iterable[DeclaredRow]:
    problem = result.problem
    if problem.attractor.empty:
        yield _row("attractor A", "none")
    else:
        text, *math = _set(problem, problem.attractor, _which(problem.attractor))
        yield _row("attractor A", f"{_counted(result, CellStatus.ATTRACTOR)} {text}", *math)
    if problem.avoid is not None:
        text, *math = _set(problem, problem.avoid, "all that meet")
        yield _row("avoid Z", f"{_counted(result, CellStatus.AVOID)} {text}", *math)
    measure = problem.measure
    if measure is None:
        yield _row("starts m", "every stabilizable cell with the same weight")
        return
    text, *math = _set(problem, measure, "cells inside") if _some(measure) else ("all cells",)
    if measure.density is not None:
        text += "; with the density"
        math.append(m.block(m.shown(measure.density, _names(problem)), False))
    elif measure.weights is not None:
        text += f"; with a weight for each of {len(measure.weights):,} cells"
    yield _row("starts m", text, *math)


def _which(attractor: Attractor) -> str:
    """Return which cells points, boxes and conditions make the attractor."""
    words = ["those around the points"] if attractor.points else []
    words += ["those wholly inside a box"] if attractor.boxes else []
    words += ["those on all of which a condition certainly holds"] if attractor.where else []
    return ", ".join(words)


def _counted(result: Result, status: CellStatus) -> str:
    """Return how many cells there are of a kind, and how many attractor cells hold."""
    count = int(np.count_nonzero(result.cell_status == status))
    text, local = f"{count:,} cell{'s' * (count != 1)}", result.local_controller
    if status == CellStatus.ATTRACTOR and local is not None and local.holding is not None:
        if local.holding == count:  # the others, if any, are ordinary cells
            return f"{text} that hold{'s' * (count == 1)} what arrives, of"
        text += f", of which {local.holding:,} hold{'s' * (local.holding == 1)} what arrives"
    return f"{text}:"


def _some(measure: Measure) -> bool:
    return bool(measure.boxes) or measure.where is not None


def _set(problem: Problem, part: Attractor | Avoid | Measure, how: str) -> list[str]:
    """Return a set in words, and the mathematics of its points, boxes and conditions."""
    names, math, left = problem.states, [], 0
    points = getattr(part, "points", ())
    for place in points[:MOST]:
        values = [place[k] for k in names] if isinstance(place, Mapping) else place
        math.append(m.block(m.point(names, values), False))
    boxes = part.boxes or ()
    for box in boxes[:MOST]:
        math.append(m.block(_box(box), False))
    conditions = (part.where,) if isinstance(part.where, str) else part.where or ()
    for text in conditions[:MOST]:
        math.append(m.block(m.shown(text, _names(problem), True), False))
    for listed in (points, boxes, conditions):
        left += max(len(listed) - MOST, 0)
    cells = len(getattr(part, "cells", ()))
    words = [how] if math and how else []
    words += [f"{cells:,} cells by their indices"] if cells else []
    words += [f"{left:,} more are not listed here"] if left else []
    return ["; ".join(words), *math]


def _box(box: Mapping[str, tuple[float, float]]) -> str:
    parts = [
        f"{m.name(k)}<mo>∈</mo><mo>[</mo><mn>{m.number(a)}</mn><mo>,</mo><mn>{m.number(b)}</mn>"
        "<mo>]</mo>"
        for k, (a, b) in box.items()
    ]
    return "<mo>,</mo><mspace width='0.5em'/>".join(parts)


def _rest(problem: Problem) -> Iterable[DeclaredRow]:
    names = _names(problem)
    yield from _costs(problem, names)
    constants = problem.system.constants()
    if constants:
        left = len(constants) - LONGEST
        values = (
            m.block(f"{m.name(k)}<mo>=</mo><mn>{m.number(v, 9)}</mn>", False)
            for k, v in islice(constants.items(), LONGEST)
        )
        yield _row("parameters", f"{left:,} more are not listed here" if left > 0 else "", *values)
    step = getattr(problem.system, "step", None)
    if isinstance(step, int | float):
        judged = "judged all along its path" if problem.judged == "path" else "judged at its end"
        parts = getattr(problem.system, "substeps", 1)
        text = f"{m.number(step)}, by {parts} classical Runge-Kutta step{'s' * (parts != 1)}"
        yield _row("sampling time", f"{text}; {judged}")
    if not isinstance(problem.system, MatrixSystem):
        yield _row("samples", _samples(problem))
    leaving = "is forbidden" if problem.on_exit == "forbid" else "moves a state back to its edge"
    yield _row("leaving the box", leaving)
    if problem.local_controller is not None:
        yield _row("inside A", f"local controller of kind {problem.local_controller.kind}")


def _costs(problem: Problem, names: Collection[str]) -> Iterable[DeclaredRow]:
    if problem.cost_rate is not None:
        math = m.block(m.shown(problem.cost_rate, names), False)
        yield _row("cost G", "the integral along the step of", math)
    elif callable(problem.stage_cost):
        yield _row("cost G", "a Python function")
    elif numbered(problem) and str(problem.stage_cost).strip() == "0":
        yield _row("cost G", "given with the rows")
    else:
        beside = "given with the rows, and" if numbered(problem) else ""
        yield _row("cost G", beside, m.block(m.shown(str(problem.stage_cost), names), False))
    reward = getattr(problem.system, "best_reward", None)
    if reward is not None:
        yield _row("rewards", f"are maximised: G is {m.number(reward, 9)} minus the reward")
    if problem.terminal_cost is not None:
        math = m.block(m.shown(problem.terminal_cost, names), False)
        yield _row("terminal cost F", "on entering A:", math)
    if problem.gamma != 1:
        weighed = "later costs weigh more" if problem.gamma > 1 else "later costs weigh less"
        yield _row("weight γ", f"{problem.gamma!r}: {weighed}")
    if problem.discount is not None:
        yield _row("discount b", f"{problem.discount!r}: a run goes on with this probability")


def _samples(problem: Problem) -> str:
    sampling = problem.sampling
    kind = "a grid" if isinstance(sampling, Grid) else f"{sampling.kind} points"
    corners = ", corners included" if sampling.corners else ""
    count = f"{sample_points(problem):,} points of each cell ({kind}{corners})"
    if problem.successors == "enclosed":
        return f"{count}; a pair survives by all that the image of its whole cell can meet"
    return f"{count}; a pair survives by where these go"

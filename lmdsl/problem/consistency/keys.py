"""Whether the keys of a problem fit together: names, and what is counted by axis or by point."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from lmdsl.common import spelling
from lmdsl.common.faults import require_all, written
from lmdsl.errors import BadInput, shown
from lmdsl.problem.consistency import enclosing, endings, texts
from lmdsl.problem.local_control import (
    ConstantControl,
    HoldControl,
    LinearFeedback,
    LqrFeedback,
)
from lmdsl.systems import MapSystem, MatrixSystem, OdeSystem
from lmdsl.systems.named import NamedOde

if TYPE_CHECKING:
    from lmdsl.problem.problem import Problem


PLACES = {
    key: f"it is a key of {where}; move it there"
    for where, keys in {
        "system": ("step", "substeps", "judged", "next", "derivative", "parameters"),
        "sampling": ("per_axis", "corners", "seed"),
        "an axis of state_box": ("periodic", "cells"),
        "attractor, avoid or measure": ("where", "boxes"),
        "measure": ("density",),
    }.items()
    for key in keys
}


def require_writable(problem: "Problem") -> None:
    """Refuse a problem that no file can hold."""
    for key in problem.functions:
        raise BadInput("a FunctionSystem or function cannot be written; use formulas", key)
    if isinstance(problem.system, MatrixSystem):
        raise BadInput("a file holds no matrices; save the result of solving it", "system")


def require_consistent(problem: "Problem") -> None:
    """Refuse a problem whose keys do not fit together; every fault is named."""
    checks = (
        _unique_names, endings.require_fit, endings.require_end, _one_cost, _sets_named,
        _local_named, enclosing.require_enclosable, enclosing.require_constants,
    )  # fmt: skip
    require_all(
        [
            *(partial(check, problem) for check in checks),
            partial(problem.sampling.check, problem.states),
            *_formulas(problem),
        ]
    )


def _formulas(problem: "Problem") -> Iterator[Callable[[], object]]:
    """Yield what finds the faults of formulas, and of functions that stand for some."""
    for fault in texts.faults(problem):
        yield partial(_refuse, fault)
    if not isinstance(problem.system, MapSystem | OdeSystem):
        yield problem.step
    if callable(problem.stage_cost):
        yield problem.stage


def _refuse(fault: BadInput) -> None:
    raise fault


def _unique_names(problem: "Problem") -> None:
    kinds = {
        "state_box": problem.states,
        "control_grid": problem.controls,
        "noise": problem.noises,
        "system.parameters": tuple(problem.system.constants()),
        "let": tuple(problem.let or ()),
    }
    owner: dict[str, str] = {}
    for kind, names in kinds.items():
        for name in names:
            if name in owner:
                raise BadInput(f"the name {name!r} is also used in {owner[name]}", kind)
            owner[name] = kind


def _one_cost(problem: "Problem") -> None:
    if problem.stage_cost is None and problem.cost_rate is None:
        raise BadInput(
            "required key is missing; write the cost of a step as a formula", "stage_cost"
        )
    if problem.cost_rate is None:
        return
    if problem.stage_cost is not None:
        raise BadInput("stage_cost is given as well; keep one of them", "cost_rate")
    if not isinstance(problem.system, OdeSystem | NamedOde):
        what = "finite model" if isinstance(problem.system, MatrixSystem) else "map"
        raise BadInput(
            f"a {what} has no time between its steps; write a stage_cost, or an ode", "cost_rate"
        )


def _sets_named(problem: "Problem") -> None:
    states = problem.states
    checks: list[Callable[[], None]] = [
        partial(_points_named, problem.attractor.points, states, "attractor.points"),
        partial(_cells_named, problem.attractor.cells, states),
    ]
    for where in ("attractor", "avoid", "measure"):
        part = getattr(problem, where)
        for i, box in enumerate((part.boxes or ()) if part else ()):
            checks.append(partial(_box_named, box, states, f"{where}.boxes[{i}]"))
    require_all(checks)


def _cells_named(cells: Any, states: tuple[str, ...]) -> None:
    for i, cell in enumerate(cells):
        if len(cell) != len(states):
            raise BadInput(f"{len(cell)} indices for {len(states)} axes", f"attractor.cells[{i}]")


def _points_named(points: Any, states: tuple[str, ...], where: str) -> None:
    for i, point in enumerate(points):
        if isinstance(point, dict) and set(point) != set(states):
            other = next((name for name in point if name not in states), "")
            near = spelling.hint(other, states).replace("; did you mean", "; is", 1)
            near = near and f"{near[:-1]} meant by {shown(other)}?"
            fault = f"{written(dict(point))}: a point names every axis once: {', '.join(states)}"
            raise BadInput(fault + near, f"{where}[{i}]")
        if len(point) != len(states):
            raise BadInput(f"{len(point)} coordinates for {len(states)} axes", f"{where}[{i}]")


def _box_named(box: Mapping[str, tuple[float, float]], states: tuple[str, ...], where: str) -> None:
    for name, (a, b) in box.items():
        if name not in states:
            near = spelling.hint(name, states) or ";"
            axes = ", ".join(states)
            raise BadInput(f"{shown(name)} is not an axis{near} the axes are {axes}", where)
        if not a < b:
            raise BadInput(f"[{a!r}, {b!r}] is empty; write [a, b] with a < b", f"{where}.{name}")


def _local_named(problem: "Problem") -> None:
    local, top = problem.local_controller, "local_controller"
    if local is None or isinstance(local, HoldControl):
        return
    orbit = () if isinstance(local, ConstantControl) else local.orbit
    _points_named(orbit, problem.states, f"{top}.orbit")
    tables: list[tuple[str, Any, Any]] = [("control", local.control, problem.controls)]
    if isinstance(local, LqrFeedback):
        tables.append(("state_weights", local.state_weights, problem.states))
        tables.append(("control_weights", local.control_weights, problem.controls))
    if isinstance(local, LinearFeedback):
        tables.append(("gain", local.gain, problem.controls))
        tables += [(f"gain.{u}", row, problem.states) for u, row in local.gain.items()]
    for key, table, known in tables:
        for name in table:
            if name not in known:
                choice = f"one of {', '.join(known)}" if known else "nothing: there is none"
                near = spelling.hint(name, known) or ";"
                raise BadInput(f"{shown(name)} is unknown{near} write {choice}", f"{top}.{key}")
    along = {"control": local.control}
    if isinstance(local, LinearFeedback):
        along |= {f"gain.{u}": row for u, row in local.gain.items()}
    for key, table in along.items():
        for name, values in table.items():
            if isinstance(values, tuple) and len(values) != len(orbit):
                raise BadInput(
                    f"{len(values)} values for {len(orbit)} orbit points; give one each",
                    f"{top}.{key}.{name}",
                )

"""A problem in words: what is declared, key by key, as notebooks show it."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from lmdsl.common.html import facts
from lmdsl.common.strict_model import Declared
from lmdsl.systems import FunctionSystem, MatrixSystem, NamedSystem

MOST = 24  # lines of a key
LONG = 300  # characters of a line
# Keys that are told as they are written, where they are declared.
AS_WRITTEN = (
    "noise", "attractor", "avoid", "admissible", "stage_cost", "cost_rate", "terminal_cost",
    "sampling", "successors", "gamma", "discount", "on_exit", "measure", "local_controller",
)  # fmt: skip


def html(problem: Any) -> str:
    """Return a table of what a problem declares."""
    return facts(rows(problem), "Problem")


def rows(problem: Any) -> Iterator[tuple[str, str]]:
    """Yield the keys of a problem and what they say; defaults that say nothing are left out."""
    if problem.name:
        yield "name", problem.name
    yield "system", _lines(_system(problem.system))
    if problem.system.constants():
        yield "parameters", ", ".join(f"{k} = {v:g}" for k, v in problem.system.constants().items())
    if problem.let:
        yield "let", _lines(f"{name} = {text}" for name, text in problem.let.items())
    yield "states", _lines(_axis(name, axis) for name, axis in problem.state_box.items())
    grid = problem.control_grid
    yield "controls", _lines(_control(*each) for each in grid.items()) or "none: it is autonomous"
    for key in AS_WRITTEN:
        value, field = getattr(problem, key), type(problem).model_fields[key]
        if value is not None and (key == "gamma" or value != field.default):
            yield key, _lines(_written(value))


def _system(system: Any) -> Iterator[str]:
    if isinstance(system, MatrixSystem):
        yield "a finite model, as it is given"
        return
    if isinstance(system, FunctionSystem):
        yield _function(system.next)
        return
    if isinstance(system, NamedSystem):
        yield str(system.kind).replace("_", " ")
        system = system.definition()
    if hasattr(system, "derivative"):
        for state, text in system.derivative.items():
            yield f"d{state}/dt = {text}"
        yield f"step {system.step:g}, substeps {system.substeps}, judged by {system.judged}"
        return
    for state, text in system.next.items():
        yield f"next {state} = {text}"


def _axis(name: str, axis: Any) -> str:
    circle = ", periodic" if axis.periodic else ""
    return f"{name} from {axis.low:g} to {axis.high:g}, {axis.cells:,} cells{circle}"


def _control(name: str, control: Any) -> str:
    low, high = control.ends()
    count = control.count()
    if count == 1:
        return f"{name} = {low:g}"
    return f"{name} from {low:g} to {high:g}, {count:,} values"


def _written(value: Any) -> Iterator[str]:
    """Yield the parts of a value, as a problem file writes them."""
    if callable(value):
        yield _function(value)
        return
    if isinstance(value, Declared):
        value = value.model_dump(mode="json", exclude_none=True)
    if not isinstance(value, Mapping):
        yield value if isinstance(value, str) else f"{value:g}"
        return
    for key, part in value.items():
        if isinstance(part, Declared):
            part = part.model_dump(mode="json", exclude_none=True)
        if isinstance(part, list | tuple) and len(part) > MOST:
            yield f"{key}: {len(part):,} of them"
        elif part or (part == 0 and part is not False):
            yield f"{key}: {part if isinstance(part, str) else json.dumps(part)}"


def _function(value: Any) -> str:
    return f"a Python function, {getattr(value, '__qualname__', 'without a name')}"


def _lines(lines: Iterator[str]) -> str:
    found: list[str] = []
    for line in lines:
        if len(found) == MOST:
            return "\n".join([*found, "…"])
        found.append(line if len(line) <= LONG else line[: LONG - 1] + "…")
    return "\n".join(found)

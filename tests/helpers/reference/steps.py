"""Where the step of a sample ends, and what it costs."""

from collections.abc import Callable
from typing import Any

from reference.formulas import formula_of, value_of
from reference.grid import Axis, cell_of_image
from reference.paths import integral, journey, knots

STANDARD_MAP = {"x": "x + y + K*u*sin(2*pi*x)", "y": "y + K*u*sin(2*pi*x)"}


def next_state_function(problem: dict[str, Any]) -> Callable[[dict[str, float]], list[float]]:
    """Make the function (values of every state, control, noise variable) -> image."""
    system = problem["system"]
    states = list(problem["state_box"])
    evaluate = right_hand_side(problem)
    if system["kind"] != "ode":
        return evaluate

    def runge_kutta(names: dict[str, float]) -> list[float]:
        def slope(x: list[float]) -> list[float]:
            return evaluate({**names, **dict(zip(states, x, strict=True))})

        start = [float(names[s]) for s in states]
        return knots(slope, start, system["step"], system.get("substeps", 1))[0][-1]

    return runge_kutta


def right_hand_side(problem: dict[str, Any]) -> Callable[[dict[str, float]], list[float]]:
    """Make the function of the formulas of a map, or of the derivatives."""
    system = problem["system"]
    states = list(problem["state_box"])
    if system["kind"] == "standard_map":
        texts = STANDARD_MAP
    elif system["kind"] == "map":
        texts = system["next"]
    else:
        texts = system["derivative"]
    formulas = [value_of(problem, texts[s]) for s in states]

    def evaluate(names: dict[str, float]) -> list[float]:
        return [f(names) for f in formulas]

    return evaluate


def step_function(
    problem: dict[str, Any], axes: list[Axis], A: set[int], Z: set[int]
) -> Callable[[dict[str, float]], tuple[int | str, float]]:
    """Make the function (values of all names) -> where the sample ends, and what it costs."""
    system, clip = problem["system"], problem.get("on_exit", "forbid") == "clip"
    ode = system["kind"] == "ode"
    path = ode and system.get("judged", "path") == "path"
    image, derivative = next_state_function(problem), right_hand_side(problem)
    rate = formula_of(problem, "cost_rate")
    stage_cost, terminal = formula_of(problem, "stage_cost"), formula_of(problem, "terminal_cost")
    holds = (problem.get("local_controller") or {}).get("kind") == "hold"
    widths, states = [a.width for a in axes], [a.name for a in axes]

    def where(place: list[float], final: bool) -> int | str | None:
        cell = cell_of_image(axes, place, clip and final)
        if cell is None:
            return None if clip and not final else "escaped"
        if cell in Z:
            return "escaped"
        if cell in A and (final or not holds):
            return "absorbed"
        return cell if final else None

    def at_end(place: list[float], final: bool) -> int | str | None:
        return where(place, final) if final else None

    def step(names: dict[str, float]) -> tuple[int | str, float]:
        cost = stage_cost(names) if stage_cost else 0.0
        if not ode:
            place = image(names)
            key = where(place, True)
        else:

            def slope(x: list[float]) -> list[float]:
                here = {**names, **dict(zip(states, x, strict=False))}
                more = [rate(here)] if rate else []
                return [*derivative(here), *more]

            start = [float(names[s]) for s in states] + [0.0] * bool(rate)
            found = knots(slope, start, system["step"], system.get("substeps", 1))
            key, s, t, place = journey(*found[:2], widths, where if path else at_end)
            if rate:
                cost = integral(found[0], found[2], place, s, t)
        if key == "absorbed" and terminal:
            state = [
                a.wrapped(x) if a.periodic else min(max(x, a.low), a.high) if clip else x
                for a, x in zip(axes, place, strict=False)
            ]
            later = problem.get("gamma", 1.0) * problem.get("discount", 1.0)
            cost += later * terminal(dict(zip(states, state, strict=True)))
        return key, cost

    return step

"""The attractor cells that controls of the grid can keep, and the controls that do."""

import math
from typing import Any

from reference.formulas import value_of
from reference.grid import Axis, unflat
from reference.samples import sample_of
from reference.steps import step_function


def asks_to_hold(problem: dict[str, Any]) -> bool:
    return (problem.get("local_controller") or {}).get("kind") == "hold"


def held_cells(
    problem: dict[str, Any], axes: list[Axis], grids: tuple[list, list, list], A: set[int],
    Z: set[int],
) -> dict[int, int]:  # fmt: skip
    """The greatest set of cells of A that keep a control whose samples all end in it: cell ->
    the cheapest such control, the first of equals. `grids`: offsets, controls, noise nodes."""
    offsets, controls, noise = grids
    step = step_function(problem, axes, set(), Z)
    admissible = value_of(problem, problem.get("admissible", "0 == 0"))
    names = [*problem["state_box"], *problem["control_grid"], *problem.get("noise", {})]
    ends: dict[tuple[int, int], set] = {}
    costs: dict[tuple[int, int], float] = {}
    for cell in A:
        corner = unflat(axes, cell)
        for number, control in enumerate(controls):
            found, paid = set(), []
            for offset in offsets:
                x = [sample_of(a, i, o) for a, i, o in zip(axes, corner, offset, strict=True)]
                for w, weight in noise:
                    values = dict(zip(names, [*x, *control, *w], strict=True))
                    key, cost = step(values)
                    found.add(key if admissible(values) else "escaped")
                    paid.append((weight, cost))
            ends[cell, number] = found
            weights = math.fsum(weight for weight, _ in paid)
            costs[cell, number] = math.fsum(weight * cost for weight, cost in paid) / weights
    held = set(A)
    while True:
        kept = {cell for cell in held if any(ends[cell, k] <= held for k in range(len(controls)))}
        if kept == held:
            break
        held = kept
    return {
        cell: min((k for k in range(len(controls)) if ends[cell, k] <= held),
                  key=lambda k: (costs[cell, k], k))
        for cell in held
    }  # fmt: skip

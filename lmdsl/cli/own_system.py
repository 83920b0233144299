"""The script and the problem file that ``lmdsl init`` writes for a system of one's own."""

import ast
from typing import Any

SCRIPT = '''\
"""A system of your own: declare it, check it, solve it. Change it step by step; it runs as it is.

What is in `declared` is the problem file in Python: the same names, the same words. Every key
stands here; docs/problem-file.md says all about each.
"""

import json

import lmdsl as lm

declared = {
    "format": "lmdsl/1",
    "name": "my pendulum",  # for people
    # The system. "kind": "ode": the time derivative of every state, held control during "step"
    # (seconds, say), integrated in "substeps" parts, "auto" as many as it takes; a step should move
    # a state by about one cell. "judged": "path" (the default) also looks at what a step meets on
    # its way, "endpoint" only at where it ends. Formulas know + - * / **, sin, cos, sqrt,
    # where(x < 1, a, b) and more.
    # A map is "kind": "map" with "next" instead of "derivative", and no step:
    #     "system": {"kind": "map", "parameters": {"a": 0.9}, "next": {"x": "a*x + u"}},
    # A system known by name: "kind": "van_der_pol" and others, see `lmdsl systems`.
    # Python code instead of formulas: lm.systems.FunctionSystem, see docs/systems.md.
    "system": {
        "kind": "ode",
        "parameters": {"g": 9.81, "friction": 0.1},  # names for numbers
        "derivative": {"angle": "speed", "speed": "pull - friction*speed + u"},
        "step": 0.1,
        "substeps": "auto",
    },
    # Names for parts of formulas, in order; usable in every formula and condition.
    "let": {"pull": "g*sin(angle)"},
    # The box of states, cut into cells. Leaving it is forbidden, or with "on_exit": "clip" what
    # leaves is moved to the end. An angle is "periodic"; its unit is that of the formulas.
    "state_box": {
        "angle": {"low": -3.141592653589793, "high": 3.141592653589793, "cells": 48,
                  "periodic": True},
        "speed": {"low": -9, "high": 9, "cells": 48},
    },
    # Where to go: "boxes" (the cells inside), "points" (the cells around), "cells" (by index), or a
    # condition, as "where": "angle**2 + speed**2 < 0.2". A box does not shrink with the cells.
    "attractor": {"boxes": [{"angle": [-0.27, 0.27], "speed": [-0.76, 0.76]}]},
    # What never to enter: "avoid", by "boxes" or "where".
    #     "avoid": {"boxes": [{"speed": [7, 9]}]},
    # The controls: "low", "high" and "points", or "values" written out; {} for a system without.
    "control_grid": {"u": {"low": -4, "high": 4, "points": 9}},
    # A condition on states and controls that every pair must meet:
    #     "admissible": "abs(speed*u) < 20",
    # Random variables of the system and the cost: "values" with "weights", "uniform" from "low" to
    # "high" by "points", or "normal" (whose proofs look "within" so many standard deviations):
    #     "noise": {"w": {"normal": {"std": 0.1, "points": 3}}},
    # What a step costs, a formula >= 0. Of an ode "cost_rate" may stand instead, a cost for each
    # unit of time; "terminal_cost" is paid on entering the attractor.
    "stage_cost": "1 - cos(angle) + 0.02*speed**2 + 0.01*u**2",
    # The points of a cell from which the map is run: "kind": "grid" with "per_axis"; "random" or
    # "sobol" with "points" and "seed"; "corners": true adds the corners of the cell.
    "sampling": {"kind": "grid", "per_axis": 3},
    # To lose no run, whatever lies between the points: "enclosed" (proved; it takes longer):
    #     "successors": "enclosed",
    # The cost of the n-th step counts gamma**n times: above 1 it also asks for speed. With a
    # "discount" of 0.95 a run ends after each step with probability 0.05, and needs no attractor.
    "gamma": 1.0,
    # Where runs start, if not everywhere: "measure" with "boxes" or "where", and a "density"
    # (a formula in the states) or "weights" (a number for each cell).
    #     "measure": {"boxes": [{"angle": [-3.141592653589793, 0], "speed": [-1, 1]}]},
    # What to do once there: "local_controller", of "kind" "hold" (controls of the grid that keep
    # runs there; "partial"), "constant" ("control"), "linear" ("gain", about an "orbit") or "lqr"
    # ("state_weights", "control_weights"):
    #     "local_controller": {"kind": "lqr", "orbit": [{"angle": 0, "speed": 0}]},
}

problem = lm.Problem.model_validate(declared)
print(lm.check(problem))  # what looks wrong, before a long run

result = lm.solve(problem)
print(f"\\n{result.status}: {result.message}")
print(result.coverage)
if result.verified:
    state = {"angle": 3.0, "speed": 0.0}
    print("control at", json.dumps(state), "is", result.controller(list(state.values())))
    print(result.simulate(starts=1_000, steps=1_000))

# Further:
#   print(lm.explain(problem))            which cells are lost, why, and what would help
#   result.save("my_pendulum")            then `lmdsl verify my_pendulum`, `lmdsl plot my_pendulum`
#   problem.save("my_pendulum.json")      for `lmdsl solve my_pendulum.json`; add
#                                         "$schema": "..." (see `lmdsl schema`) for your editor
'''


def declared() -> dict[str, Any]:
    """Return the problem that the script declares, as plain data."""
    for node in ast.parse(SCRIPT).body:
        if isinstance(node, ast.Assign):
            data: dict[str, Any] = ast.literal_eval(node.value)
            return data
    raise AssertionError("the script declares nothing")

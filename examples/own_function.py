"""A system written as a Python function: the Ikeda map, whose natural form is complex.

Run:  python own_function.py
"""

import numpy as np
from scipy.optimize import fsolve

import lmdsl as lm


def ikeda(x, y, u, v, a):
    """Light going round a ring cavity; u and v change the field that is injected."""
    z = x + 1j * y
    z = 1 + u + 1j * v + a * z * np.exp(1j * (0.4 - 6 / (1 + np.abs(z) ** 2)))
    return {"x": z.real, "y": z.imag}


problem = lm.Problem(
    name="Ikeda map, unstable fixed point",
    system=lm.systems.FunctionSystem(parameters={"a": 0.9}, next=ikeda),
    state_box={
        "x": {"low": -1, "high": 2.5, "cells": 70},
        "y": {"low": -2.5, "high": 1.5, "cells": 80},
    },
    attractor={"boxes": [{"x": [0.5, 0.6], "y": [0.2, 0.3]}]},
    control_grid={"u": {"low": -0.1, "high": 0.1, "points": 3}, "v": {"values": [-0.1, 0, 0.1]}},
    stage_cost="1 + 100*(u**2 + v**2)",
    sampling={"kind": "grid", "per_axis": 4},
)

fixed = fsolve(lambda z: np.subtract([*ikeda(*z, 0, 0, 0.9).values()], z), [0.5, 0.25])
print("fixed point", fixed.round(4))

result = lm.solve(problem)
print(f"{result.status}: {result.message}")
run = result.simulate(starts=2000, steps=5000)
print(f"true map: {run.reached} of {run.starts} runs reach it, half in {run.steps['q50']} steps")

"""An epidemic (SIR) with a ceiling on infections: let it pass, never above ten per cent.

Run:  python epidemic.py
"""

import numpy as np
from _truth import beside, flow, runs

import lmdsl as lm

problem = lm.Problem(
    name="epidemic with a ceiling",
    system={
        "kind": "ode",
        "parameters": {"contact": 0.3, "recovery": 0.1},
        "derivative": {
            "well": "-contact*(1 - distance)*well*ill",
            "ill": "contact*(1 - distance)*well*ill - recovery*ill",
        },
        "step": 4,
        "substeps": "auto",
    },
    state_box={
        "well": {"low": 0, "high": 1, "cells": 100},
        "ill": {"low": 0, "high": 0.12, "cells": 60},
    },
    attractor={"boxes": [{"well": [0, 0.33], "ill": [0, 0.1]}]},
    avoid={"boxes": [{"ill": [0.1, 0.12]}]},
    control_grid={"distance": {"low": 0, "high": 0.75, "points": 7}},
    cost_rate="0.01 + distance**2",
    sampling={"kind": "grid", "per_axis": 4},
)


def derivative(x, u):
    """The right-hand side again, in NumPy."""
    new = 0.3 * (1 - u[0]) * x[0] * x[1]
    return np.stack([-new, new - 0.1 * x[1]])


result = lm.solve(problem)
truth = runs(result, flow(derivative, 4.0), lambda x: x[0] <= 0.33, lambda x: x[1] > 0.1)
beside("Epidemic", result, truth, result.simulate(4000, 1000))

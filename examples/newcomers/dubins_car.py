"""Dubins' car among two obstacles: constant speed, bounded turning rate.

Run:  python dubins_car.py [cells of the place [cells of the heading]]
"""

import sys

import numpy as np
from _truth import beside, flow, runs

import lmdsl as lm

N, H = (int(text) for text in (*sys.argv[1:], *("40", "32")[len(sys.argv) - 1 :]))
WALLS = ((3, 4, 2, 8), (6, 6.5, 0, 6))

problem = lm.Problem(
    name="Dubins' car among obstacles",
    system={
        "kind": "ode",
        "derivative": {"x": "cos(heading)", "y": "sin(heading)", "heading": "u"},
        "step": 0.5,
        "substeps": "auto",
    },
    state_box={
        "x": {"low": 0, "high": 10, "cells": N},
        "y": {"low": 0, "high": 10, "cells": N},
        "heading": {"low": -np.pi, "high": np.pi, "cells": H, "periodic": True},
    },
    attractor={"boxes": [{"x": [8, 9], "y": [8, 9]}]},
    avoid={"boxes": [{"x": [a, b], "y": [c, d]} for a, b, c, d in WALLS]},
    control_grid={"u": {"low": -1.5, "high": 1.5, "points": 5}},
    cost_rate="1",
    sampling={"kind": "grid", "per_axis": 4},
)


def derivative(x, u):
    """The right-hand side again, in NumPy."""
    return np.stack([np.cos(x[2]), np.sin(x[2]), u[0]])


def reached(x):
    """Whether a place lies in the attractor."""
    return (np.abs(x[0] - 8.5) <= 0.5) & (np.abs(x[1] - 8.5) <= 0.5)


def unsafe(x):
    """Whether a place lies in an obstacle."""
    return np.any(
        [(x[0] > a) & (x[0] < b) & (x[1] > c) & (x[1] < d) for a, b, c, d in WALLS], axis=0
    )


result = lm.solve(problem)
truth = runs(result, flow(derivative, 0.5), reached, unsafe, starts=10_000)
print(f"{truth['avoid']} of {truth['starts']:,} true paths touch an obstacle")
assert truth["avoid"] <= 0.001 * truth["starts"]
beside("Dubins' car", result, truth, result.simulate(4000, 1000))

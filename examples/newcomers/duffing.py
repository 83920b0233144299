"""Duffing oscillator x'' = x - x**3 - 0.3 x' + u: onto the hill between its two wells.

Run:  python duffing.py
"""

import numpy as np
from _truth import beside, flow, runs

import lmdsl as lm

problem = lm.Problem(
    name="Duffing oscillator, onto the hill",
    system={
        "kind": "ode",
        "parameters": {"damping": 0.3},
        "derivative": {"x": "v", "v": "x - x**3 - damping*v + u"},
        "step": 0.3,
        "substeps": "auto",
    },
    state_box={
        "x": {"low": -2, "high": 2, "cells": 64},
        "v": {"low": -2, "high": 2, "cells": 64},
    },
    attractor={"boxes": [{"x": [-0.125, 0.125], "v": [-0.125, 0.125]}]},
    control_grid={"u": {"low": -0.5, "high": 0.5, "points": 11}},
    cost_rate="x**2 + v**2 + u**2",
    sampling={"kind": "grid", "per_axis": 4},
)


def derivative(x, u):
    """The right-hand side again, in NumPy."""
    return np.stack([x[1], x[0] - x[0] ** 3 - 0.3 * x[1] + u[0]])


def reached(x):
    """Whether a place lies in the attractor."""
    return (np.abs(x) <= 0.125).all(axis=0)


result = lm.solve(problem)
beside("Duffing", result, runs(result, flow(derivative, 0.3), reached), result.simulate(4000, 1000))

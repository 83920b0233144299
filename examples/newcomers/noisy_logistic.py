"""Noisy logistic map x+ = r x (1 - x) + u + w: onto its unstable fixed point.

Run:  python noisy_logistic.py
"""

import numpy as np
from _truth import beside, runs

import lmdsl as lm

R, STD = 3.8, 0.002
POINT = 1 - 1 / R

problem = lm.Problem(
    name="noisy logistic map",
    system={"kind": "map", "parameters": {"r": R}, "next": {"x": "r*x*(1 - x) + u + w"}},
    state_box={"x": {"low": 0, "high": 1, "cells": 400}},
    attractor={"boxes": [{"x": [POINT - 0.01, POINT + 0.01]}]},
    control_grid={"u": {"low": -0.02, "high": 0.02, "points": 9}},
    noise={"w": {"normal": {"std": STD, "points": 7}}},
    stage_cost="1 + (u/0.02)**2",
    sampling={"kind": "grid", "per_axis": 8},
)
result = lm.solve(problem)
inside = np.flatnonzero(result.cell_status == 0) / 400


def path(x, u, rng):
    """One step of the true map, with normal noise."""
    return (R * x * (1 - x) + u + rng.normal(0, STD, x.shape))[None]


def reached(x):
    """Whether a place lies in an attractor cell."""
    return (x[0] >= inside.min()) & (x[0] <= inside.max() + 1 / 400)


beside("Noisy logistic map", result, runs(result, path, reached), result.simulate(4000, 1000))

"""A pendulum known from recorded data alone: brought upright by a motor too weak to lift it.

The recording is made here by SciPy, with a seed: 60,000 places and torques drawn at random, and
where the pendulum was one second later. lmdsl sees these numbers and no equation; whether its
controller brings the pendulum upright is then tried by SciPy alone.

Run:  python recorded_pendulum.py
"""

import math

import numpy as np
from _truth import beside, flow, runs

import lmdsl as lm

SECOND, HALF = 1.0, 0.75  # a step; half the width of the attractor


def derivative(x, u):
    """theta is 0 upright; holding the pendulum level takes a torque of 1."""
    return np.stack([x[1], np.sin(x[0]) - 0.1 * x[1] + u[0]])


path = flow(derivative, SECOND)
rng = np.random.default_rng(0)
start = np.stack([rng.uniform(-np.pi, np.pi, 60_000), rng.uniform(-3, 3, 60_000)])
torque = rng.choice([-0.6, -0.3, 0, 0.3, 0.6], size=(1, 60_000))
after = np.concatenate(
    [path(s, u, rng)[-1] for s, u in zip(np.hsplit(start, 10), np.hsplit(torque, 10), strict=True)],
    axis=1,
)

problem = lm.from_data(
    {"theta": start[0], "omega": start[1]},
    {"u": torque[0]},
    {"theta": after[0], "omega": after[1]},
    name="recorded pendulum",
    state_box={
        "theta": {"low": -math.pi, "high": math.pi, "cells": 24, "periodic": True},
        "omega": {"low": -3, "high": 3, "cells": 24},
    },
    control_grid={"u": {"values": [-0.6, -0.3, 0, 0.3, 0.6]}},
    stage_cost="1",  # a step costs 1: the cost is the number of steps
    attractor={"boxes": [{"theta": [-0.8, 0.8], "omega": [-HALF, HALF]}]},
    confidence=0.95,
)


def reached(x):
    """Whether a place lies in the attractor: its cells, no less and no more."""
    theta = np.abs(x[0]) <= 3 * (2 * math.pi / 24) + 1e-9
    return theta & (np.abs(x[1]) <= HALF)


def ends(x, u, rng):
    """Where the pendulum is after a step: data say nothing of what happens on the way."""
    steps.append(x.shape[1])
    return path(x, u, rng)[-1:]


steps = []  # of all runs that are underway, one number for each second
result = lm.solve(problem)
truth = runs(result, ends, reached, starts=4000)
beside("recorded pendulum", result, truth, result.simulate(4000, 1000))
way = runs(result, path, reached)
safe, there = (100 * way[key] / way["starts"] for key in ("safe", "reached"))
print(f"on the way, which was not recorded: {safe:.2f} % are never unsafe, {there:.2f} % arrive")
print(result.data)
mean, (low, high) = sum(steps) / 4000, result.data.cost
print(f"mean number of steps by SciPy alone {mean:.3f}, by the recorded rows {result.cost:.3f}")
assert low <= mean <= high

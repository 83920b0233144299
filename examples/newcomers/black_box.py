"""A black box that takes one sample at a time: a mass on a spring that hits a wall.

Between impacts the motion is a piece of a sine; how many impacts fall into a step, and when, is
found by a loop. The answer is checked by SciPy's integrator, which shares no code with the model.

Run:  python black_box.py
"""

import math

import numpy as np
from _truth import beside, runs
from scipy.integrate import solve_ivp

import lmdsl as lm

WALL, RESTITUTION, STEP = -0.6, 0.8, 0.6
PLACES = 16  # of a step, at which its way is looked at


def impact(x, v, u):
    """Move x'' = u - x for STEP; at the wall v becomes -RESTITUTION v."""
    left = STEP
    for _ in range(50):
        a, b = x - u, v
        size, phase = math.hypot(a, b), math.atan2(b, a)  # x(t) = u + size cos(t - phase)
        hit = math.inf
        if abs(WALL - u) < size:
            # Downwards through the wall; a start on it, going up, is no impact.
            hit = (phase + math.acos((WALL - u) / size)) % (2 * math.pi)
            hit = math.inf if hit < 1e-12 or hit > 2 * math.pi - 1e-12 else hit
        t = min(left, hit)
        x, v = u + a * math.cos(t) + b * math.sin(t), b * math.cos(t) - a * math.sin(t)
        left -= t
        if left <= 0:
            return {"x": x, "v": v}
        x, v = WALL, -RESTITUTION * v
    return {"x": math.nan, "v": math.nan}  # impacts without end: no image


def impact_by_scipy(x, v, u):
    """The way by an integrator that looks for the impacts itself; its last place is the next."""

    def wall(t, s):
        return s[0] - WALL

    wall.terminal, wall.direction = True, -1
    t, state, when = 0.0, [max(x, WALL), v], np.linspace(0, STEP, PLACES + 1)[1:]
    way = np.empty((PLACES, 2))
    while t < STEP:
        leg = solve_ivp(
            lambda t, s: [s[1], u - s[0]], (t, STEP), state, events=wall,
            rtol=1e-8, atol=1e-10, dense_output=True,
        )  # fmt: skip
        now = (when > t) & (when <= leg.t[-1])
        if now.any():
            way[now] = leg.sol(when[now]).T
        t, state = leg.t[-1], [*leg.y[:, -1]]
        if leg.status == 1:
            state = [WALL + 1e-12, -RESTITUTION * state[1]]
    way[-1] = state
    way[:, 0] = np.maximum(way[:, 0], WALL)  # on the wall up to rounding
    return way


def path(x, u, rng):
    """The ways of all runs."""
    each = [impact_by_scipy(*run) for run in zip(*x, u[0], strict=True)]
    return np.moveaxis(np.array(each), 0, 2)


def ends(x, u, rng):
    """Where the runs are after a step: a map has no in-between."""
    ways.append(path(x, u, rng))
    return ways[-1][-1:]


def reached(x):
    """Whether a place lies in the attractor."""
    return (np.abs(x) <= 0.15).all(axis=0)


problem = lm.Problem(
    name="mass on a spring with a wall",
    system=lm.systems.FunctionSystem(next=impact, vectorized=False),  # processes=4 shares the calls
    state_box={
        "x": {"low": WALL, "high": 1.2, "cells": 36},
        "v": {"low": -1.2, "high": 1.2, "cells": 48},
    },
    attractor={"boxes": [{"x": [-0.15, 0.15], "v": [-0.15, 0.15]}]},
    control_grid={"u": {"values": [-0.3, 0, 0.3]}},
    stage_cost=lambda u: 1 + abs(u),
    sampling={"kind": "grid", "per_axis": 3},
)


result = lm.solve(problem)
ways = []
truth = runs(result, ends, reached, starts=500, steps=200)
beside("Mass on a spring with a wall", result, truth, result.simulate(4000, 200))
fast = sum(np.count_nonzero((np.abs(way[:, 1]) > 1.2).any(axis=0)) for way in ways)
print(
    f"on the way, of which a map says nothing: {fast} steps of {truth['starts']} runs leave the box"
)

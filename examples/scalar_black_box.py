"""A black box that takes one sample at a time: a mass on a spring that hits a wall.

Between impacts the motion is a piece of a sine; how many impacts fall into a step, and when, is
found by a loop. The answer is checked by SciPy's integrator, which shares no code with the model.

Run:  python scalar_black_box.py
"""

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.stats import binomtest

import lmdsl as lm

WALL, RESTITUTION, STEP = -0.6, 0.8, 0.6


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
    """The same by an integrator that looks for the impacts itself."""

    def wall(t, s):
        return s[0] - WALL

    wall.terminal, wall.direction = True, -1
    t, state = 0.0, [max(x, WALL), v]
    while t < STEP:
        flow = solve_ivp(
            lambda t, s: [s[1], u - s[0]], (t, STEP), state, events=wall, rtol=1e-8, atol=1e-10
        )
        t, state = flow.t[-1], [*flow.y[:, -1]]
        if flow.status == 1:
            state = [WALL + 1e-12, -RESTITUTION * state[1]]
    return state


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


def arrives(result, start, steps=200):
    """Return whether the true motion enters the attractor under the controller."""
    state = start
    for _ in range(steps):
        if max(map(abs, state)) <= 0.15:
            return True
        u = result.controller(state)[0]
        if not np.isfinite(u):
            return False
        state = impact_by_scipy(*state, u)
    return False


if __name__ == "__main__":
    result = lm.solve(problem)
    print(f"{result.status}: {result.message}")
    run = result.simulate(starts=2000, steps=200)
    low, high = run.interval
    print(f"lmdsl: {run.reached / run.starts:.1%} arrive ({low:.1%} to {high:.1%})")

    rng, starts = np.random.default_rng(1), []
    while len(starts) < 200:  # uniform on the stabilized cells
        start = rng.uniform([WALL, -1.2], [1.2, 1.2])
        if np.isfinite(result.controller(start)).all():
            starts.append(start)
    true = sum(arrives(result, start) for start in starts)
    sure = binomtest(true, len(starts)).proportion_ci(0.95)
    print(f"SciPy: {true / len(starts):.1%} arrive ({sure.low:.1%} to {sure.high:.1%})")

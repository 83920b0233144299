"""With the corners of cells sampled, no run through a maze is lost: simulated by SciPy alone."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made
from scipy.integrate import solve_ivp

import lmdsl as lm

PLACES = np.linspace(0, 1, 101)[1:]


def maze(side, walls, goal, per_axis, corners, controls=7):
    """A car with bicycle dynamics among walls, on cells of 0.2 m and 0.2 rad."""
    cells = round((side + 0.2) / 0.2)
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "ode",
            "derivative": {"x": "v*cos(atan(tan(s)/2) + th)/cos(atan(tan(s)/2))",
                           "y": "v*sin(atan(tan(s)/2) + th)/cos(atan(tan(s)/2))",
                           "th": "v*tan(s)"},
            "step": 0.3,
        },
        "state_box": {"x": {"low": -0.1, "high": side + 0.1, "cells": cells},
                      "y": {"low": -0.1, "high": side + 0.1, "cells": cells},
                      "th": {"low": -3.5, "high": 3.5, "cells": 35}},
        "attractor": {"boxes": [goal]},
        "avoid": {"boxes": [{"x": [a, b], "y": [c, d]} for a, b, c, d in walls]},
        "control_grid": {"v": {"low": -0.9, "high": 0.9, "points": controls},
                         "s": {"low": -0.9, "high": 0.9, "points": controls}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": per_axis, "corners": corners},
    }  # fmt: skip


def slope(t, y, v, s):
    x, _, th = y.reshape(3, -1)
    beta = np.arctan(np.tan(s) / 2)
    return np.concatenate(
        [v * np.cos(beta + th) / np.cos(beta), v * np.sin(beta + th) / np.cos(beta),
         v * np.tan(s) + 0 * x]
    )  # fmt: skip


def lost_and_reached(data, result, starts, steps, places=PLACES):
    """Run from cells of C; of paths only the walls, the box and the goal matter, as sets."""
    rng = np.random.default_rng(0)
    low = np.array([axis["low"] for axis in data["state_box"].values()])
    high = np.array([axis["high"] for axis in data["state_box"].values()])
    shape = [axis["cells"] for axis in data["state_box"].values()]
    cell = rng.choice(np.flatnonzero(result.cell_status == 1), size=starts)
    index = np.stack(np.unravel_index(cell, shape), axis=-1)
    x = low + (index + rng.random(index.shape)) * (high - low) / shape
    lost = reached = 0
    for _ in range(steps):
        if not len(x):
            break
        u = result.controller(x)
        if np.isnan(u).any():  # a cell without control
            lost += int(np.isnan(u[:, 0]).sum())
            x, u = x[~np.isnan(u[:, 0])], u[~np.isnan(u[:, 0])]
        found = solve_ivp(
            slope, (0, 0.3), x.T.ravel(), method="DOP853", rtol=1e-10, atol=1e-10,
            args=tuple(u.T), dense_output=True,
        )  # fmt: skip
        way = found.sol(0.3 * places).reshape(3, len(x), len(places))
        out = ((way < low[:, None, None]) | (way > high[:, None, None])).any(axis=0)
        for box in data["avoid"]["boxes"]:
            (a, b), (c, d) = box["x"], box["y"]
            out |= (way[0] > a) & (way[0] < b) & (way[1] > c) & (way[1] < d)
        (a, b), (c, d) = data["attractor"]["boxes"][0]["x"], data["attractor"]["boxes"][0]["y"]
        at_goal = (way[0] > a) & (way[0] < b) & (way[1] > c) & (way[1] < d)
        first_out = np.where(out.any(axis=1), out.argmax(axis=1), 10**6)
        first_in = np.where(at_goal.any(axis=1), at_goal.argmax(axis=1), 10**6)
        lost += int((first_out < first_in).sum())
        reached += int((first_in < first_out).sum())
        x = way[:, (first_in == 10**6) & (first_out == 10**6), -1].T
    return lost, reached


SMALL = (3.6, [(1.0, 1.2, 0.0, 2.4), (2.2, 2.4, 1.2, 3.6)], {"x": [2.9, 3.3], "y": [0.1, 0.5]})


def test_a_small_maze():
    lost = {}
    for corners in (False, True):
        data = maze(*SMALL, per_axis=1, corners=corners, controls=5)
        result = lm.solve(made(data))
        assert result.verified
        lost[corners], reached = lost_and_reached(data, result, 100, 80)
        mine = result.simulate(1000, 80)
        assert abs(mine.lost / 1000 - lost[corners] / 100) < 0.15
        assert reached > 20
    assert lost[True] == 0
    assert lost[False] > 10


WALLS = [
    (1.0, 1.2, 0.0, 9.0), (2.2, 2.4, 0.0, 5.0), (2.2, 2.4, 6.0, 10.0), (3.4, 3.6, 0.0, 9.0),
    (4.6, 4.8, 1.0, 10.0), (5.8, 6.0, 0.0, 6.0), (5.8, 6.0, 7.0, 10.0), (7.0, 7.2, 1.0, 10.0),
    (8.2, 8.4, 0.0, 8.5), (8.4, 9.3, 8.3, 8.5), (9.3, 10.0, 7.1, 7.3), (8.4, 9.3, 5.9, 6.1),
    (9.3, 10.0, 4.7, 4.9), (8.4, 9.3, 3.5, 3.7), (9.3, 10.0, 2.3, 2.5),
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("judged", ["path", pytest.param("endpoint", marks=pytest.mark.full)])
def test_the_published_maze(judged):
    """G. Reissig, A. Weber, M. Rungger's vehicle, 51 x 51 x 35 cells and 15 walls.

    Judged at the ends of steps, its paths still cut through walls: only the ends are free of them.
    """
    for corners in (False, True):
        data = maze(10.0, WALLS, {"x": [9, 9.5], "y": [0, 0.5]}, 2, corners)
        data["system"]["judged"] = judged
        result = lm.solve(made(data))
        places = PLACES if judged == "path" else PLACES[-1:]
        lost, reached = lost_and_reached(data, result, 300, 400, places)
        if corners:
            assert lost == 0
            assert reached > 250
        else:
            assert lost > 150  # more than half of 300

"""An inventory with random demand: orders that bring the stock back into its band.

Run:  python inventory.py
"""

import numpy as np
from _truth import beside, runs

import lmdsl as lm

DEMAND, CHANCE = [0, 1, 2, 3, 4], [0.1, 0.25, 0.3, 0.25, 0.1]

problem = lm.Problem(
    name="inventory",
    system={"kind": "map", "next": {"stock": "stock + order - demand"}},
    state_box={"stock": {"low": -20.5, "high": 40.5, "cells": 61}},
    attractor={"boxes": [{"stock": [9.5, 14.5]}]},
    control_grid={"order": {"values": list(range(11))}},
    noise={"demand": {"values": DEMAND, "weights": CHANCE}},
    stage_cost="0.1*max(stock, 0) + 2*max(-stock, 0) + where(order > 0, 3, 0) + 0.5*order",
    sampling={"kind": "grid", "per_axis": 1},
)


def path(x, u, rng):
    """One day."""
    return (np.round(x) + u - rng.choice(DEMAND, size=x.shape, p=CHANCE))[None]


def reached(x):
    """Whether the stock lies in its band."""
    return (x[0] >= 10) & (x[0] <= 14)


result = lm.solve(problem)
beside("Inventory", result, runs(result, path, reached), result.simulate(4000, 1000))

"""Swing up a pendulum with motors of different strength.

Run:  python pendulum_swing_up.py [figure.png]
"""

import sys
from math import pi

import numpy as np

import lmdsl as lm


def pendulum(torque: float) -> lm.Problem:
    """Holding the pendulum level takes 9.81 N m; theta is 0 upright and pi hanging."""
    return lm.Problem(
        name=f"pendulum, at most {torque} N m",
        system={
            "kind": "inverted_pendulum",
            "parameters": {"m": 1, "l": 1, "g": 9.81, "d": 0.1},
            "step": 0.1,
            "substeps": "auto",
        },
        state_box={
            "theta": {"low": -pi, "high": pi, "cells": 64, "periodic": True},
            "omega": {"low": -9, "high": 9, "cells": 64},
        },
        attractor={"points": [{"theta": 0, "omega": 0}]},
        control_grid={"u": {"low": -torque, "high": torque, "points": 9}},
        stage_cost="1 - cos(theta) + 0.02*omega**2 + 0.01*u**2",
        sampling={"kind": "grid", "per_axis": 4},
    )


paths = {}
for torque in (2.0, 3.0, 5.0):
    result = lm.solve(pendulum(torque))
    path = paths[torque] = result.closed_loop.path([pi - 0.05, 0.0], steps=500)
    turns = np.count_nonzero(np.diff(np.sign(path[1:, 1])))
    print(
        f"{torque} N m: {result.status}, {result.stabilizable_cells} of {result.cells} cells; "
        f"from rest upright after {0.1 * (len(path) - 1):.1f} s and {turns} turning points"
    )

if len(sys.argv) > 1:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots(layout="constrained")
    for torque, path in paths.items():
        ax.plot(path[:, 0], path[:, 1], ".", label=f"{torque} N m")
    ax.set(xlabel="theta (rad)", ylabel="omega (rad/s)")
    ax.legend()
    figure.savefig(sys.argv[1])

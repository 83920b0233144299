"""Cart and pole in four dimensions: catch the falling pole, keep the cart on its rail.

In four dimensions cells are large. Sampled inside alone (12 x 12 x 12 x 14 cells, 2 an axis), a
quarter of the box is verified, but one run in ten leaves by the faces of cells that no sample saw.
With the corners sampled as well a twentieth of the box is left, from which the runs do arrive.

Run:  python cart_pole.py
"""

import numpy as np
from _truth import beside, flow, runs

import lmdsl as lm

PUSH = "(u + 0.05*rate**2*sin(angle))/1.1"
FALL = f"(9.81*sin(angle) - cos(angle)*{PUSH})/(0.5*(4/3 - 0.1*cos(angle)**2/1.1))"

problem = lm.Problem(
    name="cart and pole",
    system={
        "kind": "ode",
        "derivative": {
            "place": "speed",
            "speed": f"(u + 0.05*(rate**2*sin(angle) - {FALL}*cos(angle)))/1.1",
            "angle": "rate",
            "rate": FALL,
        },
        "step": 0.1,
        "substeps": "auto",
    },
    state_box={
        "place": {"low": -2.4, "high": 2.4, "cells": 12},
        "speed": {"low": -3, "high": 3, "cells": 24},
        "angle": {"low": -0.3, "high": 0.3, "cells": 12},
        "rate": {"low": -2.1, "high": 2.1, "cells": 24},
    },
    attractor={
        "boxes": [
            {"place": [-1.2, 1.2], "speed": [-1, 1], "angle": [-0.1, 0.1], "rate": [-0.525, 0.525]}
        ]
    },
    control_grid={"u": {"low": -10, "high": 10, "points": 11}},
    stage_cost="1 + 0.01*u**2",
    sampling={"kind": "grid", "per_axis": 1, "corners": True},
)


def derivative(x, u):
    """The right-hand side again, in NumPy."""
    _, speed, angle, rate = x
    sine, cosine = np.sin(angle), np.cos(angle)
    fall = 9.81 * sine - cosine * (u[0] + 0.05 * rate**2 * sine) / 1.1
    fall = fall / (0.5 * (4 / 3 - 0.1 * cosine**2 / 1.1))
    return np.stack([speed, (u[0] + 0.05 * (rate**2 * sine - fall * cosine)) / 1.1, rate, fall])


def reached(x):
    """Whether a place lies in the attractor."""
    ends = np.array([1.2, 1, 0.1, 0.525]).reshape(4, *[1] * (x.ndim - 1))
    return (np.abs(x) <= ends).all(axis=0)


result = lm.solve(problem)
truth = runs(result, flow(derivative, 0.1), reached)
assert truth["reached"] >= 0.99 * truth["starts"]
beside(
    "Cart and pole",
    result,
    truth,
    result.simulate(4000, 1000),
)

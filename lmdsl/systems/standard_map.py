"""The controlled standard map, the example of the paper."""

from typing import Literal

from lmdsl.systems.named import NamedMap


class StandardMap(NamedMap):
    """Chirikov's standard map on the torus, driven through its kick.

    x+ = x + y + K u sin(2 pi x), y+ = y + K u sin(2 pi x), both modulo 1 (declare both axes
    periodic on [0, 1]). States x (angle / 2 pi), y (action); control u scales the kick.
    """

    kind: Literal["standard_map"] = "standard_map"
    defaults = {"K": 0.25}
    formulas = {"x": "x + y + K*u*sin(2*pi*x)", "y": "y + K*u*sin(2*pi*x)"}
    summary = "Chirikov's standard map: stabilize the period-two orbit at y = 1/2 (the paper)"
    source = (
        "U. Vaidya and I. Mezic, Controllability for a class of area preserving twist maps, "
        "Physica D 189 (2004) 234-246"
    )
    problem = {
        "name": "standard map, period-two orbit",
        "state_box": {
            "x": {"low": 0, "high": 1, "cells": 50, "periodic": True},
            "y": {"low": 0, "high": 1, "cells": 50, "periodic": True},
        },
        "attractor": {"points": [{"x": 0.25, "y": 0.5}, {"x": 0.75, "y": 0.5}]},
        "control_grid": {"u": {"low": -0.5, "high": 0.5, "points": 21}},
        "stage_cost": "x**2 + y**2 + u**2",
        "sampling": {"kind": "random", "points": 10, "seed": 0},
        "gamma": 1.02,
    }

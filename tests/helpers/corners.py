"""A model of which one corner limits gamma."""

from __future__ import annotations


def corner(gamma_value: float) -> dict:
    """Six cells: 1 and 2 reach A = cell 0 surely; 3 escapes itself with probability 1/2 a step.

    4 chooses between going through 3 and going to 2 for a higher price; 5 must go through 3.
    gamma_bar = 2, and only 3 and 5 limit it.
    """
    half = "where(w > 0, x, x - 1)"
    formula = f"where(x < 3, x - 1, where(x < 4, {half}, where(x < 5, x - 1 - u, x - 2)))"
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": formula}},
        "state_box": {"x": {"low": 0, "high": 6, "cells": 6}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0, 1]}},
        "noise": {"w": {"values": [-1, 1], "weights": [0.5, 0.5]}},
        "stage_cost": "1 + u",
        "sampling": {"kind": "grid", "per_axis": 1},
        "gamma": gamma_value,
    }

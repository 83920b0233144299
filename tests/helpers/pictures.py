"""Results to be drawn, and what an axis shows."""

from __future__ import annotations


def maze(**more):
    """Nothing is symmetric; every cause occurs: x rises, y drifts, a wall is to be avoided."""
    return {
        "format": "lmdsl/1",
        "name": "maze",
        "system": {
            "kind": "map",
            "next": {
                "x": "where(y > 0.95, x + 2, where(x > 0.85, x, x + 0.1*u))",
                "y": "where(x > 0.85, y, where(x < 0.05, y + 0.2, y + 0.1*v))",
            },
        },
        "state_box": {
            "x": {"low": 0, "high": 1, "cells": 10},
            "y": {"low": 0, "high": 1.2, "cells": 12},
        },
        "attractor": {"cells": [[3, 1]]},
        "avoid": {"boxes": [{"x": [0.5, 0.6], "y": [0, 0.6]}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}, "v": {"low": -1, "high": 0, "points": 2}},
        "stage_cost": "1 + 0.1*u**2 + x*y",
        "sampling": {"kind": "grid", "per_axis": 2},
        **more,
    }


def lorenz():
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "ode",
            "derivative": {"x": "10*(y - x)", "y": "28*x - y - x*z + u", "z": "x*y - 8/3*z"},
            "step": 0.1,
            "substeps": 10,
        },
        "state_box": {
            "x": {"low": -20, "high": 20, "cells": 10},
            "y": {"low": -28, "high": 28, "cells": 8},
            "z": {"low": 0, "high": 50, "cells": 6},
        },
        "attractor": {"cells": [[6, 5, 3]]},
        "control_grid": {"u": {"low": -60, "high": 60, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
    }


def cart(**more):
    """A pole on a cart in four dimensions, among walls of which one ends below an angle."""
    ranges = {"x": (-1.2, 1.2, 9), "theta": (-0.5, 0.5, 7), "v": (-2, 2, 6), "omega": (-2, 2, 7)}
    near = {"x": [-0.5, 0.5], "theta": [-0.25, 0.25], "v": [-1.5, 1.5], "omega": [-0.9, 0.9]}
    return {
        "format": "lmdsl/1",
        "name": "cart",
        "system": {
            "kind": "ode",
            "derivative": {
                "x": "v",
                "theta": "omega",
                "v": "u",
                "omega": "9.8*sin(theta) - u*cos(theta)",
            },
            "step": 0.15,
            "substeps": 1,
        },
        "state_box": {k: {"low": a, "high": b, "cells": n} for k, (a, b, n) in ranges.items()},
        "attractor": {"boxes": [near]},
        "avoid": {"boxes": [{"x": [0.7, 0.8], "theta": [0.2, 0.5]}, {"x": [-1.2, -1.0]}]},
        "control_grid": {"u": {"low": -12, "high": 12, "points": 5}},
        "stage_cost": "0.1 + x**2 + theta**2",
        "sampling": {"kind": "grid", "per_axis": 1},
        **more,
    }


def logistic():
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "4.3*x*(1 - x) + u"}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 100}},
        "attractor": {"points": [[1 - 1 / 4.3]]},
        "control_grid": {"u": {"low": -0.05, "high": 0.05, "points": 11}},
        "stage_cost": "1 + u**2",
        "sampling": {"kind": "grid", "per_axis": 5},
    }


def patches(ax):
    return {patch.get_label(): patch for patch in ax.patches}

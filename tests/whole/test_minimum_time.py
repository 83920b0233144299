"""Minimum-time problems beside their closed forms, judged at endpoints and along paths.

A step pays for all of itself where only its end is judged. Along the path it pays until it enters
the attractor, so that what is left is the price of cells and of controls held during a step.
``python tests/whole/test_minimum_time.py double_integrator 240 0.1`` prints larger cases.
"""

import sys

import numpy as np
import pytest

import lmdsl as lm


def double_integrator(n, step, judged):
    """x'' = u, |u| <= 1, to a square of half width 0.1."""
    return {
        "system": {"kind": "ode", "derivative": {"x": "v", "v": "u"}, "step": step},
        "state_box": {name: {"low": -2, "high": 2, "cells": n} for name in ("x", "v")},
        "attractor": {"boxes": [{"x": [-0.1, 0.1], "v": [-0.1, 0.1]}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}},
        "sampling": {"kind": "grid", "per_axis": 3},
    }


def bang_bang(x, v, half=0.1):
    """Least time to the square: over points of its edge, u = s and then -s, with one switch."""
    edge = np.linspace(-half, half, 21)
    best = np.full(x.shape, np.inf)
    ends = [(a, b) for a in edge for b in edge if max(abs(a), abs(b)) > half - 1e-12]
    for a, b in ends:
        for s in (1, -1):
            with np.errstate(invalid="ignore"):
                peak = np.sqrt((v * v + b * b) / 2 + s * (a - x))
            for w in (peak, -peak):
                first, second = (w - v) * s, (w - b) * s
                fits = (first >= -1e-12) & (second >= -1e-12)
                best = np.fmin(best, np.where(fits, first + second, np.inf))
    return best


def dubins(n, step, judged):
    """Speed 1, turning rate at most 1, to a square of half width 0.5 with any heading."""
    return {
        "system": {
            "kind": "ode",
            "derivative": {"x": "cos(h)", "y": "sin(h)", "h": "u"},
            "step": step,
        },
        "state_box": {
            "x": {"low": -5, "high": 5, "cells": n},
            "y": {"low": -5, "high": 5, "cells": n},
            "h": {"low": -np.pi, "high": np.pi, "cells": 48, "periodic": True},
        },
        "attractor": {"boxes": [{"x": [-0.5, 0.5], "y": [-0.5, 0.5]}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}},
        "sampling": {"kind": "grid", "per_axis": 3},
    }


def turn_and_go(x, y, h, half=0.5):
    """Least time to the square with any heading: turn, then straight ahead (from far away)."""
    edge = np.linspace(-half, half, 11)
    best = np.full(x.shape, np.inf)
    for a, b in [(a, b) for a in edge for b in edge if max(abs(a), abs(b)) > half - 1e-12]:
        for s in (1, -1):  # left, right, on the circle about the centre c
            cx, cy = x - s * np.sin(h), y + s * np.cos(h)
            away = np.hypot(a - cx, b - cy)
            with np.errstate(invalid="ignore"):
                ahead = np.sqrt(away**2 - 1)
            leave = np.arctan2(b - cy, a - cx) - s * np.arctan2(ahead, 1) + s * np.pi / 2
            best = np.fmin(best, np.mod(s * (leave - h), 2 * np.pi) + ahead)
    return best


CASES = {"double_integrator": (double_integrator, bang_bang), "dubins": (dubins, turn_and_go)}


def excess(name, n, step, judged):
    """Mean cost above the least time, relative, over what is stabilizable and far from A."""
    declare, least = CASES[name]
    data = declare(n, step, judged)
    data["system"]["judged"] = judged
    data |= {"cost_rate": "1"} if judged == "path" else {"stage_cost": repr(step)}
    result = lm.solve(lm.Problem(**data))
    assert result.certificate.verified
    cells = np.flatnonzero(result.cell_status == lm.CellStatus.STABILIZED)
    states = result.partition.centres(cells)
    far = np.hypot(states[:, 0], states[:, 1]) > (2.5 if name == "dubins" else 0)
    time = least(*states[far].T)
    assert np.isfinite(time).all()
    return result.value[cells][far].mean() / time.mean() - 1


@pytest.mark.parametrize(
    ("name", "n", "step"), [("double_integrator", 80, 0.2), ("dubins", 20, 0.8)]
)
def test_paths_come_nearer_to_the_least_time(name, n, step):
    ends, paths = (excess(name, n, step, judged) for judged in ("endpoint", "path"))
    assert 0 < paths < 0.8 * ends


if __name__ == "__main__":
    name, n, step = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    for judged in ("endpoint", "path"):
        print(f"{name} {n} {step} {judged}: {100 * excess(name, n, step, judged):+.2f} %")

"""The stand-alone checker of claim 7, and problems that it is asked about."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2] / "tools"))

from claim_7 import axes, formulas, intervals, jets, judge, true_map

__all__ = ["PROBLEMS", "axes", "declared", "formulas", "intervals", "jets", "judge", "true_map"]


def declared(system: Any, box: Any, attractor: Any, **more: Any) -> dict[str, Any]:
    return {
        "format": "lmdsl/1",
        "system": system,
        "state_box": box,
        "attractor": attractor,
        "control_grid": {"u": {"values": [-0.3, 0.0, 0.25]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2, "corners": True},
        "successors": "enclosed",
        **more,
    }


def line(low: float, high: float, cells: int, periodic: bool = False) -> dict[str, Any]:
    return {"low": low, "high": high, "cells": cells, "periodic": periodic}


BAND = {"boxes": [{"y": [-0.5, 0.5]}]}
CIRCLE = {"x": line(0.0, 1.0, 7, True), "y": line(-1.0, 1.5, 5)}
PROBLEMS = {
    "line": declared(
        {"kind": "map", "parameters": {"a": 0.7}, "next": {"x": "shrunk + u*(1 - x**2)"}},
        {"x": line(-1, 1, 9)}, {"boxes": [{"x": [-0.34, 0.34]}]}, let={"shrunk": "a*x"},
    ),
    "circle": declared(
        {"kind": "map", "next": {"x": "x + 0.3*y + u*sin(2*pi*x)", "y": "0.8*y + 0.2*u"}}, CIRCLE,
        BAND,
    ),
    "seam": declared(  # round the circle, a cell at a time, and a bit back
        {"kind": "map", "next": {"x": "x - 0.125 + 0.001*u", "y": "0.5*y"}},
        {"x": line(0, 1, 8, True), "y": line(-1, 1, 3)}, {"cells": [[4, 1]]},
    ),
    "choice": declared(
        {"kind": "map", "next": {"x": "where(x > 0 and not x > 2, 0.4*x, -0.3*abs(x)) + 0.1*u"}},
        {"x": line(-1, 1, 9)}, {"boxes": [{"x": [-0.34, 0.34]}]},
        admissible="x*u < 0.4 and x + u > -1.4",
    ),
    "nodes": declared(
        {"kind": "map", "next": {"x": "0.6*x + u*w"}}, {"x": line(-1, 1, 9)},
        {"boxes": [{"x": [-0.34, 0.34]}]},
        noise={"w": {"values": [-1, 0, 1.5], "weights": [0.2, 0.5, 0.3]}},
    ),
    "uniform": declared(
        {"kind": "map", "next": {"x": "0.6*x + u + w*x + w**2", "y": "0.5*y - w"}}, CIRCLE, BAND,
        noise={"w": {"uniform": {"low": -0.2, "high": 0.3, "points": 3}}},
    ),
    "clip": declared(
        {"kind": "map", "next": {"x": "1.4*x + u", "y": "y + 0.5*u"}},
        {"x": line(-1, 1, 6), "y": line(0, 1, 5)}, {"boxes": [{"y": [0.8, 1]}]}, on_exit="clip",
        avoid={"boxes": [{"x": [0.3, 0.7], "y": [0.0, 0.3]}]},
    ),
    "edges": declared(  # images that lie on edges
        {"kind": "map", "next": {"x": "x + u", "y": "-y"}},
        {"x": line(0, 1, 10), "y": line(-0.3, 0.3, 6)}, {"boxes": [{"x": [0, 0.2]}]},
        control_grid={"u": {"values": [-0.1, 0.0, 0.2]}},
    ),
    "endpoint": declared(
        {"kind": "ode", "derivative": {"x": "y", "y": "-sin(x) + 4*u"}, "step": 0.2,
         "substeps": 2, "judged": "endpoint"},
        {"x": line(-1, 1, 20), "y": line(-1, 1, 17)},
        {"boxes": [{"x": [-0.5, 0.5], "y": [-0.55, 0.55]}]},
    ),
    "named": declared(
        {"kind": "van_der_pol", "substeps": 1}, {"x": line(-1, 1, 20), "v": line(-1, 1, 20)},
        {"boxes": [{"x": [-0.5, 0.5], "v": [-0.5, 0.5]}]},
        control_grid={"u": {"values": [-2, 0, 2]}},
    ),
    "walls": declared(
        {"kind": "ode", "derivative": {"x": "cos(a)", "y": "sin(a)"}, "step": 0.5, "substeps": 1},
        {"x": line(0, 3, 15), "y": line(0, 3, 15)}, {"boxes": [{"x": [2.4, 3], "y": [2.4, 3]}]},
        control_grid={"a": {"low": -2.4, "high": 2.4, "points": 9}},
        avoid={"boxes": [{"x": [1.4, 1.6], "y": [0, 2.2]}]},
    ),
}  # fmt: skip

"""Problems to be checked, and what is found."""

from __future__ import annotations

import json
import math

from problems import made

import lmdsl as lm

PI = math.pi


def pendulum(step=0.1, *, periodic=True, attractor=None, **more):
    """A pendulum, upright at 0."""
    box = {"th": [-0.3, 0.3], "om": [-0.8, 0.8]}
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "ode",
            "parameters": {"g": 9.81},
            "derivative": {"th": "om", "om": "g*sin(th) + u"},
            "step": step,
            "substeps": 1,
        },
        "state_box": {
            "th": {"low": -PI, "high": PI, "cells": 30, "periodic": periodic},
            "om": {"low": -8, "high": 8, "cells": 30},
        },
        "attractor": attractor or {"boxes": [box]},
        "control_grid": {"u": {"low": -4, "high": 4, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 3},
        **more,
    }


def shift(move="0.5*u", low=-4, high=4, cells=16, controls=(-1, 0, 1), per_axis=1, **more):
    """x+ = x + a move, A around 0."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": f"x + {move}"}},
        "state_box": {"x": {"low": low, "high": high, "cells": cells}},
        "attractor": {"boxes": [{"x": [-0.5, 0.5]}]},
        "control_grid": {"u": {"values": list(controls)}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": per_axis},
        **more,
    }


def found(data):
    report = lm.check(made(data))
    json.dumps(report.to_dict(), allow_nan=False)
    assert str(report) == report.text()
    for finding in report.findings:
        assert finding.text in str(report)
        assert finding.remedy in str(report)
    return {finding.code: finding for finding in report.findings}

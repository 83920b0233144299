"""Small problems with known answers, as plain data."""

from __future__ import annotations

import copy
from typing import Any

import lmdsl as lm


def steps(gamma: float = 1.0, cost: str = "1", **more: Any) -> dict[str, Any]:
    """x+ = x - 0.25 u on 4 cells: V = 1, 1 + gamma, 1 + gamma + gamma^2 for cost 1."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x - 0.25*u"}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 4}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0, 1]}},
        "stage_cost": cost,
        "sampling": {"kind": "grid", "per_axis": 2},
        "gamma": gamma,
        **more,
    }


def doubling(gamma: float = 1.0, **more: Any) -> dict[str, Any]:
    """x+ = 2x modulo 1 on 2 cells, A = cell 0: V = 1/(1 - gamma/2), gamma_bar = 2."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "2*x"}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 2, "periodic": True}},
        "attractor": {"cells": [[0]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 4},
        "gamma": gamma,
        **more,
    }


def standard_map(cells: int = 50, gamma: float = 1.02, **more: Any) -> dict[str, Any]:
    """The paper's example."""
    data = copy.deepcopy(dict(lm.systems.StandardMap.problem))
    for axis in data["state_box"].values():
        axis["cells"] = cells
    return {**data, "gamma": gamma, **more}


def made(data: dict[str, Any]) -> lm.Problem:
    """Validate plain data."""
    return lm.Problem.model_validate(data)

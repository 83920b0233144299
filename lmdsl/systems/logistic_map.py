"""The controlled logistic map."""

from typing import ClassVar, Literal

from lmdsl.systems.named import NamedMap


class LogisticMap(NamedMap):
    """The logistic map with a small additive control: control of chaos in one dimension.

    x+ = r x (1 - x) + u. State x (population as a share of its maximum, dimensionless); control u
    (individuals added or removed per generation, same unit); r is the growth rate. For r > 3 the
    fixed point 1 - 1/r is unstable.
    """

    kind: Literal["logistic_map"] = "logistic_map"
    defaults: ClassVar = {"r": 3.9}
    formulas: ClassVar = {"x": "r*x*(1 - x) + u"}
    summary = "logistic map: stabilize the unstable fixed point with at most 2 % control"
    source = (
        "R. M. May, Simple mathematical models with very complicated dynamics, "
        "Nature 261 (1976) 459-467; control of chaos by small perturbations: E. Ott, C. Grebogi "
        "and J. A. Yorke, Controlling chaos, Physical Review Letters 64 (1990) 1196-1199"
    )
    # The fixed point is 0.7436. u enters the cost relative to its bound 0.02.
    problem: ClassVar = {
        "name": "logistic map, unstable fixed point",
        "state_box": {"x": {"low": 0, "high": 1, "cells": 200}},
        "attractor": {"boxes": [{"x": [0.74, 0.75]}]},
        "control_grid": {"u": {"low": -0.02, "high": 0.02, "points": 9}},
        "stage_cost": "1 + (u/0.02)**2",
        "sampling": {"kind": "grid", "per_axis": 8},
    }

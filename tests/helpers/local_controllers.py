"""Problems with local controllers."""

from __future__ import annotations

import numpy as np

from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController
from lmdsl.model.sets import CellSets

ORBIT = [{"x": 0.25, "y": 0.5}, {"x": 0.75, "y": 0.5}]


def local_of(problem):
    partition = Partition.of(problem)
    return LocalController.of(problem, partition, CellSets.of(problem, partition).attractor)


def linear_system(A, B, cells=8, **more):
    """x+ = A x + B u on [-1, 1]^d, A the cells around the origin."""
    d, p = np.shape(B)
    names = [f"x{i}" for i in range(d)]
    controls = [f"u{j}" for j in range(p)]
    terms = [
        [f"({A[i][k]!r})*{names[k]}" for k in range(d)]
        + [f"({B[i][j]!r})*{controls[j]}" for j in range(p)]
        for i in range(d)
    ]
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "map",
            "next": {n: " + ".join(t) for n, t in zip(names, terms, strict=True)},
        },
        "state_box": {n: {"low": -1, "high": 1, "cells": cells} for n in names},
        "attractor": {"points": [[0.0] * d]},
        "control_grid": {u: {"low": -1, "high": 1, "points": 3} for u in controls},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        **more,
    }

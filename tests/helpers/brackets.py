"""Brackets of gamma_bar: both ends in exact arithmetic, and a problem of long ways."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np

from lmdsl.certificate.bounds import exactly_below


def check_vectors(lp, found):
    """Both ends in exact arithmetic, and that the cells named are those of the vectors."""
    at = replace(lp, gamma=found.high)
    assert all(exactly_below(at, k, found.w_high, found.high, None) for k in range(lp.K))
    assert (found.w_high >= 0).all()
    assert found.w_high.any()
    np.testing.assert_array_equal(found.beyond.cells, lp.cells[found.w_high > 0])
    assert set(found.limiting.cells) <= set(found.beyond.cells)
    assert len(found.limiting) > 0
    w = [Fraction(float(x)) for x in found.w_low]
    for i, k in enumerate(found.policy):
        row = lp.rows.exact(int(k))
        ahead = sum(w[j] * s for j, s in row if j < lp.n) / lp.rows.shares.total
        assert Fraction(found.low) * ahead <= w[i]


def integrator(cells: int, gamma_value: float = 1.0) -> dict:
    """A double integrator at a short step: transport over many cells, vectors over many decades."""
    return {
        "system": {"kind": "double_integrator", "parameters": {"h": 2.4 / cells}},
        "state_box": {
            "x": {"low": -2, "high": 2, "cells": cells},
            "v": {"low": -1.5, "high": 1.5, "cells": cells * 3 // 4},
        },
        "attractor": {"points": [{"x": 0, "v": 0}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 4},
        "on_exit": "clip",
        "gamma": gamma_value,
    }

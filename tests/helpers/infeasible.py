"""Problems that cannot be stabilized everywhere."""

from __future__ import annotations

import numpy as np
from problems import made, steps


def three_causes(**more):
    """Cells 0 to 5: escapes, trapped, leads to these, two stabilized, A (see test_causes)."""
    jump = "where(x < 1, -5, where(x < 2, x, where(x < 3, where(x < 2.5, 1.5, 5.5), x + u)))"
    data = steps(1.0, **more)
    data["system"]["next"] = {"x": jump}
    data["state_box"] = {"x": {"low": 0, "high": 6, "cells": 6}}
    data["attractor"] = {"cells": [[5]]}
    return data


def line(formula, low=0.0, high=1.0, cells=10, controls=(-1, 0, 1), at=0.05, **more):
    """One axis, A at a point."""
    return made(
        {
            "format": "lmdsl/1",
            "system": {"kind": "map", "next": {"x": formula}},
            "state_box": {"x": {"low": low, "high": high, "cells": cells}},
            "attractor": {"points": [[at]]},
            "control_grid": {"u": {"values": list(controls)}},
            "stage_cost": "1",
            "sampling": {"kind": "grid", "per_axis": 4},
            **more,
        }
    )


def covered(partition, region):
    """The cells of a box, found by their centres."""
    centres = partition.centres(np.arange(partition.size))
    inside = np.ones(partition.size, dtype=bool)
    for k, name in enumerate(partition.names):
        low, high = region.box[name]
        turn = partition.high[k] - partition.low[k]
        x = centres[:, k]
        wrapped = partition.periodic[k] & (low <= x + turn) & (x + turn <= high)
        inside &= ((low <= x) & (x <= high)) | wrapped
    return inside

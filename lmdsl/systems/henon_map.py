"""The controlled Henon map."""

from typing import ClassVar, Literal

from lmdsl.systems.named import NamedMap


class HenonMap(NamedMap):
    """The Henon map with a small additive control of its first state.

    x+ = 1 - a x^2 + y + u, y+ = b x. States x, y and control u are dimensionless. With a = 1.4 and
    b = 0.3 the attractor is chaotic, |x| < 1.3, and carries the saddle fixed point
    (0.6314, 0.1894); orbits from |x| > 1.35 or so run off to minus infinity.
    """

    kind: Literal["henon_map"] = "henon_map"
    defaults: ClassVar = {"a": 1.4, "b": 0.3}
    formulas: ClassVar = {"x": "1 - a*x**2 + y + u", "y": "b*x"}
    summary = "Henon map: stabilize the saddle on the strange attractor with small control"
    source = (
        "M. Henon, A two-dimensional mapping with a strange attractor, "
        "Communications in Mathematical Physics 50 (1976) 69-77"
    )
    # y in b times the range of x: only x can leave the box.
    problem: ClassVar = {
        "name": "Henon map, saddle fixed point",
        "state_box": {
            "x": {"low": -1.4, "high": 1.4, "cells": 70},
            "y": {"low": -0.42, "high": 0.42, "cells": 48},
        },
        "attractor": {"boxes": [{"x": [0.6, 0.68], "y": [0.175, 0.21]}]},
        "control_grid": {"u": {"low": -0.1, "high": 0.1, "points": 11}},
        "stage_cost": "1 + (u/0.1)**2",
        "sampling": {"kind": "grid", "per_axis": 4},
    }

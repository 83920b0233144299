"""The double integrator, sampled exactly."""

from typing import ClassVar, Literal

from lmdsl.systems.named import NamedMap


class DoubleIntegrator(NamedMap):
    """A unit mass on a line, pushed by a force that is held for h seconds.

    x+ = x + h v + h^2 u / 2, v+ = v + h u: the exact sampling of x'' = u. States x (position, m),
    v (velocity, m/s); control u (acceleration, m/s^2); h is the sampling time (s).
    """

    kind: Literal["double_integrator"] = "double_integrator"
    defaults: ClassVar = {"h": 0.15}
    formulas: ClassVar = {"x": "x + h*v + h**2/2*u", "v": "v + h*u"}
    summary = "double integrator: bring a mass to rest in minimum time between two walls"
    source = (
        "V. G. Rao and D. S. Bernstein, Naive control of the double integrator, "
        "IEEE Control Systems Magazine 21 (2001) no. 5, 86-97"
    )
    # The cost is time. Too fast towards a wall, no control can stop in time: those cells are lost.
    problem: ClassVar = {
        "name": "double integrator, minimum time",
        "state_box": {
            "x": {"low": -2, "high": 2, "cells": 80},
            "v": {"low": -1.5, "high": 1.5, "cells": 60},
        },
        "attractor": {"boxes": [{"x": [-0.05, 0.05], "v": [-0.05, 0.05]}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 5}},
        "stage_cost": "h",
        "sampling": {"kind": "grid", "per_axis": 4},
    }

"""The Lorenz system, controlled through the Rayleigh number."""

from typing import ClassVar, Literal

from lmdsl.common.strict_model import Positive
from lmdsl.systems.base import Substeps
from lmdsl.systems.named import NamedOde


class Lorenz(NamedOde):
    """The Lorenz equations, a convection loop whose heating is adjusted.

    x' = sigma (y - x), y' = x (rho + u - z) - y, z' = x y - beta z. States x (rate of
    convection), y, z (horizontal and vertical temperature differences), control u (change of the
    reduced Rayleigh number rho), time, all dimensionless. The unstable equilibria
    C+ and C- are (c, c, rho - 1) and (-c, -c, rho - 1), c = sqrt(beta (rho - 1)).
    """

    kind: Literal["lorenz"] = "lorenz"
    defaults: ClassVar = {"sigma": 10.0, "rho": 28.0, "beta": 8 / 3}
    formulas: ClassVar = {"x": "sigma*(y - x)", "y": "x*(rho + u - z) - y", "z": "x*y - beta*z"}
    step: Positive = 0.1
    substeps: Substeps = 5
    summary = "Lorenz system: stabilize steady convection (C+) by adjusting the heating"
    source = (
        "E. N. Lorenz, Deterministic nonperiodic flow, Journal of the Atmospheric Sciences 20 "
        "(1963) 130-141; control by the heating: J. Singer, Y.-Z. Wang and H. H. Bau, Controlling "
        "a chaotic system, Physical Review Letters 66 (1991) 1123-1125"
    )
    # C+ is (8.485, 8.485, 27). The box holds the chaotic attractor with room to spare.
    problem: ClassVar = {
        "name": "Lorenz system, steady convection",
        "state_box": {
            "x": {"low": -24, "high": 24, "cells": 24},
            "y": {"low": -36, "high": 36, "cells": 24},
            "z": {"low": 0, "high": 60, "cells": 20},
        },
        "attractor": {"boxes": [{"x": [6, 10], "y": [6, 12], "z": [24, 30]}]},
        "control_grid": {"u": {"low": -6, "high": 6, "points": 5}},
        "stage_cost": "1 + (u/6)**2",
        "sampling": {"kind": "grid", "per_axis": 4},
    }

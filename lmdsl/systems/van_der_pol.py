"""The controlled van der Pol oscillator."""

from typing import ClassVar, Literal

from lmdsl.common.strict_model import Positive
from lmdsl.systems.base import Substeps
from lmdsl.systems.named import NamedOde


class VanDerPol(NamedOde):
    """The van der Pol oscillator with a forcing: bring it to rest against its limit cycle.

    x' = v, v' = mu (1 - x^2) v - x + u. States x (displacement), v (its rate), control u
    (forcing), all dimensionless; mu > 0 is the negative damping that feeds the limit cycle of
    amplitude 2.
    """

    kind: Literal["van_der_pol"] = "van_der_pol"
    defaults: ClassVar = {"mu": 1.0}
    formulas: ClassVar = {"x": "v", "v": "mu*(1 - x**2)*v - x + u"}
    step: Positive = 0.2
    substeps: Substeps = 4
    summary = "van der Pol oscillator: bring it to rest against its limit cycle"
    source = (
        "B. van der Pol, On relaxation-oscillations, The London, Edinburgh and Dublin "
        "Philosophical Magazine and Journal of Science, series 7, 2 (1926) 978-992"
    )
    problem: ClassVar = {
        "name": "van der Pol oscillator, to rest",
        "state_box": {
            "x": {"low": -3, "high": 3, "cells": 60},
            "v": {"low": -4, "high": 4, "cells": 60},
        },
        "attractor": {"points": [{"x": 0, "v": 0}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
        "stage_cost": "x**2 + v**2 + u**2",
        "sampling": {"kind": "grid", "per_axis": 4},
    }

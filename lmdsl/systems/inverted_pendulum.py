"""The torque-limited pendulum."""

from math import pi
from typing import ClassVar, Literal

from lmdsl.common.strict_model import Positive
from lmdsl.systems.base import Substeps
from lmdsl.systems.named import NamedOde


class InvertedPendulum(NamedOde):
    """A pendulum with a motor in its pivot, too weak to lift it without swinging.

    theta' = omega, omega' = g/l sin theta + (u - d omega)/(m l^2). States theta (angle from
    upright, rad; declare it periodic on [-pi, pi]), omega (rad/s); control u (torque, N m);
    m (kg), l (m), g (m/s^2), d (friction, N m s).
    """

    kind: Literal["inverted_pendulum"] = "inverted_pendulum"
    defaults: ClassVar = {"m": 1.0, "l": 1.0, "g": 9.81, "d": 0.1}
    formulas: ClassVar = {"theta": "omega", "omega": "g/l*sin(theta) + (u - d*omega)/(m*l**2)"}
    step: Positive = 0.1
    substeps: Substeps = 2
    summary = "pendulum with a weak motor: swing up by pumping energy, then catch"
    source = (
        "K. J. Astrom and K. Furuta, Swinging up a pendulum by energy control, "
        "Automatica 36 (2000) 287-295"
    )
    # Holding the pendulum level takes m g l = 9.81 N m; the motor gives 3.
    problem: ClassVar = {
        "name": "pendulum, swing-up with a weak motor",
        "state_box": {
            "theta": {"low": -pi, "high": pi, "cells": 64, "periodic": True},
            "omega": {"low": -9, "high": 9, "cells": 64},
        },
        "attractor": {"points": [{"theta": 0, "omega": 0}]},
        "control_grid": {"u": {"low": -3, "high": 3, "points": 9}},
        "stage_cost": "1 - cos(theta) + 0.02*omega**2 + 0.01*u**2",
        "sampling": {"kind": "grid", "per_axis": 4},
    }

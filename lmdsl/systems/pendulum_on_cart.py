"""The inverted pendulum on a cart, reduced to the pendulum."""

from typing import ClassVar, Literal

from lmdsl.common.strict_model import Positive
from lmdsl.systems.base import Substeps
from lmdsl.systems.named import NamedOde


class PendulumOnCart(NamedOde):
    """A planar pendulum on a cart that a force pushes; the cart's position is left out.

    phi'' = (g/l sin phi - m_r/2 phi'^2 sin 2 phi - m_r/(m l) u cos phi) / (4/3 - m_r cos^2 phi)
    with m_r = m/(m + M). States phi (angle from upright, rad, not wrapped), omega = phi' (rad/s);
    control u (force on the cart, N); m (pendulum, kg), M (cart, kg), l (distance of the
    pendulum's centre of mass from the pivot, m), g (m/s^2).
    """

    kind: Literal["pendulum_on_cart"] = "pendulum_on_cart"
    defaults: ClassVar = {"m": 2.0, "M": 8.0, "l": 0.5, "g": 9.8}
    formulas: ClassVar = {
        "phi": "omega",
        "omega": "(g/l*sin(phi) - m/(m + M)/2*omega**2*sin(2*phi) - u*cos(phi)/((m + M)*l))"
        " / (4/3 - m/(m + M)*cos(phi)**2)",
    }
    step: Positive = 0.1
    substeps: Substeps = 5
    summary = "inverted pendulum on a cart: the benchmark of set-oriented optimal control"
    source = (
        "O. Junge and H. M. Osinga, A set oriented approach to global optimal control, "
        "ESAIM: Control, Optimisation and Calculus of Variations 10 (2004) 259-270; "
        "L. Grune and O. Junge, A set oriented approach to optimal feedback stabilization, "
        "Systems & Control Letters 54 (2005) 169-180"
    )
    # The cost is the sources' instantaneous cost times the sampling time.
    problem: ClassVar = {
        "name": "inverted pendulum on a cart",
        "state_box": {
            "phi": {"low": -8, "high": 8, "cells": 64},
            "omega": {"low": -10, "high": 10, "cells": 64},
        },
        "attractor": {"points": [{"phi": 0, "omega": 0}]},
        "control_grid": {"u": {"low": -128, "high": 128, "points": 17}},
        "stage_cost": "0.1*(0.1*phi**2 + 0.05*omega**2 + 0.01*u**2)",
        "sampling": {"kind": "grid", "per_axis": 4},
    }

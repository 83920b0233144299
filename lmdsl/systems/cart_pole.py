"""The pole on a cart, with the cart's place: swung up and balanced on a rail."""

from math import pi
from typing import ClassVar, Literal

from lmdsl.common.strict_model import Positive
from lmdsl.systems.base import Substeps
from lmdsl.systems.named import NamedOde

# Lagrange's equations, solved for both accelerations: the force that turns, and their determinant.
PUSH = "(u - b*v + m*l*omega**2*sin(theta))"
DETERMINANT = "(4/3*(M + m) - m*cos(theta)**2)"


class CartPole(NamedOde):
    """A uniform pole, hinged to a cart on a rail that a force pushes.

    (M + m) x'' + m l (theta'' cos theta - theta'^2 sin theta) = u - b x' along the rail, and
    4/3 m l^2 theta'' + m l x'' cos theta = m g l sin theta - d theta' about the hinge. States x
    (place of the cart, m), theta (angle from upright, rad, not wrapped), v = x' (m/s),
    omega = theta' (rad/s); control u (force on the cart, N); M (cart, kg), m (pole, kg), l (half
    the pole's length, m), g (m/s^2), b (friction of the cart, N s/m), d (of the hinge, N m s).
    """

    kind: Literal["cart_pole"] = "cart_pole"
    defaults: ClassVar = {"M": 1.0, "m": 0.1, "l": 0.5, "g": 9.8, "b": 0.1, "d": 2e-6}
    formulas: ClassVar = {
        "x": "v",
        "theta": "omega",
        "v": f"(4/3*{PUSH} - cos(theta)*(m*g*sin(theta) - d*omega/l)) / {DETERMINANT}",
        "omega": f"((M + m)*(g*sin(theta) - d*omega/(m*l)) - cos(theta)*{PUSH})"
        f" / (l*{DETERMINANT})",
    }
    step: Positive = 0.15
    substeps: Substeps = 2
    summary = "cart and pole in four dimensions: swing the pole up on a rail of finite length"
    source = (
        "A. G. Barto, R. S. Sutton and C. W. Anderson, Neuronlike adaptive elements that can solve "
        "difficult learning control problems, IEEE Transactions on Systems, Man, and Cybernetics "
        "13 (1983) 834-846; the swing-up, and the cart's friction: M. P. Deisenroth and "
        "C. E. Rasmussen, PILCO: A model-based and data-efficient approach to policy search, ICML "
        "(2011) 465-472"
    )
    # A step moves every state by about a cell where it moves fast. Two samples an axis, none of
    # them near a face: with four axes most of a cell lies near its faces, and samples there leave
    # nothing stabilizable on so few cells. Being near the ends of the rail and of the speeds costs
    # more, so that true runs keep away from where cells without control begin. The attractor lies
    # on edges of cells where each number of cells is a multiple of 16; there the linear-quadratic
    # regulator balances the pole, and the law of the cells takes over again where it leaves.
    problem: ClassVar = {
        "name": "cart and pole, swing-up on a rail",
        "state_box": {
            "x": {"low": -2.4, "high": 2.4, "cells": 16},
            "theta": {"low": -pi, "high": pi, "cells": 16, "periodic": True},
            "v": {"low": -6, "high": 6, "cells": 16},
            "omega": {"low": -12, "high": 12, "cells": 16},
        },
        "attractor": {
            "boxes": [
                {
                    "x": [-0.6, 0.6],
                    "theta": [-pi / 8, pi / 8],
                    "v": [-0.75, 0.75],
                    "omega": [-1.5, 1.5],
                }
            ]
        },
        "control_grid": {"u": {"low": -20, "high": 20, "points": 5}},
        "stage_cost": "1 + (u/20)**2 + 4*((x/2.4)**4 + (v/6)**4 + (omega/12)**4)",
        "sampling": {"kind": "grid", "per_axis": 2},
        "local_controller": {"kind": "lqr", "orbit": [[0, 0, 0, 0]]},
    }

"""Controllers on the attractor cells."""

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Tag

from lmdsl.common.strict_model import Declared, Number, Numbers, Positive, frozen_dict, plain
from lmdsl.problem.sets import Point
from lmdsl.problem.unions import kinds

MAX_ORBIT = 64  # number of points above which an orbit is refused

NamedNumbers = Annotated[dict[str, Number], BeforeValidator(plain), frozen_dict]

PositiveNumbers = Annotated[dict[str, Positive], BeforeValidator(plain), frozen_dict]

# One number for all points of an orbit, or one for each.
PerPoint = Annotated[
    Annotated[Number, Tag("<a>")] | Annotated[Numbers, Tag("<b>")],
    Discriminator(lambda v: "<b>" if isinstance(v, list | tuple | np.ndarray) else "<a>"),
]

AlongOrbit = Annotated[dict[str, PerPoint], BeforeValidator(plain), frozen_dict]

Gain = Annotated[dict[str, AlongOrbit], BeforeValidator(plain), frozen_dict]

Orbit = Annotated[
    tuple[Point, ...],
    Field(min_length=1, max_length=MAX_ORBIT, fail_fast=True),
    BeforeValidator(plain),
]


class ConstantControl(Declared):
    """A local controller that holds one control vector on the attractor cells.

    Attributes
    ----------
    control
        Control name to value; controls left out are 0.
    """

    kind: Literal["constant"] = "constant"
    control: NamedNumbers = Field(default_factory=dict, validate_default=True)


class LinearFeedback(Declared):
    """A local controller u = u_k - K (x - x_k) around the nearest point of an orbit.

    Attributes
    ----------
    orbit
        The fixed point (one), or the points of a periodic orbit in the order visited.
    control
        Control name to its value along the orbit (a number, or one per point); default 0.
    gain
        Control name to axis name to an entry of K (a number, or one per point); entries left out
        are 0.
    """

    kind: Literal["linear"] = "linear"
    orbit: Orbit
    control: AlongOrbit = Field(default_factory=dict, validate_default=True)
    gain: Gain


class LqrFeedback(Declared):
    """A local controller u = u_k - K_k (x - x_k), K_k by the linear-quadratic regulator (LQR).

    The system is linearised along the orbit; K minimises the sum of x'Qx + u'Ru of the deviations,
    Q and R diagonal.

    Attributes
    ----------
    orbit
        The fixed point (one), or the points of a periodic orbit in the order visited.
    control
        Control name to its value along the orbit (a number, or one per point); default 0.
    state_weights
        Axis name to its entry of Q, > 0; default 1 / (cell width)^2 (Bryson's rule).
    control_weights
        Control name to its entry of R, > 0; default 1 / (largest |value - control|)^2.
    """

    kind: Literal["lqr"] = "lqr"
    orbit: Orbit
    control: AlongOrbit = Field(default_factory=dict, validate_default=True)
    state_weights: PositiveNumbers = Field(default_factory=dict, validate_default=True)
    control_weights: PositiveNumbers = Field(default_factory=dict, validate_default=True)


class HoldControl(Declared):
    """A local controller that keeps runs in the attractor cells by controls of the grid.

    The cells that hold are the greatest set of attractor cells in each of which some control keeps
    all successors in the set. The other attractor cells become ordinary ones.

    Attributes
    ----------
    partial
        Whether the other attractor cells remain a goal; a run that enters one may leave it again.
    """

    kind: Literal["hold"] = "hold"
    partial: bool = False


if TYPE_CHECKING:
    LocalUnion = ConstantControl | LinearFeedback | LqrFeedback | HoldControl
else:
    LocalUnion = kinds(ConstantControl, LinearFeedback, LqrFeedback, HoldControl)


def without_orbit(local: "LocalUnion | None") -> dict[str, None]:
    """Return the change by which a problem names no orbit, which other cells might not hold."""
    return {} if isinstance(local, HoldControl) else {"local_controller": None}


def absorbed_on_way(local: "LocalUnion | None") -> bool:
    """Return whether a path ends where it meets the attractor on the way.

    It goes on where controls of the grid are to hold it: they are chosen at the ends of steps.
    """
    return not isinstance(local, HoldControl)

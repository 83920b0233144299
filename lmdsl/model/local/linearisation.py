"""The true map along an orbit: whether it is one, and the derivatives there."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput
from lmdsl.formulas.enclosures import Jet
from lmdsl.formulas.intervals import Interval
from lmdsl.model.discretization import noise_nodes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.true_map import TrueMap

ON_ORBIT = 1e-3  # cell widths above which a point that misses its successor is on no orbit


def points(orbit: Sequence[Any], partition: Partition) -> Floats:
    """Return the points of a declared orbit, shape (q, d)."""
    return np.array(
        [[x[name] for name in partition.names] if isinstance(x, dict) else x for x in orbit]
    )


def along(
    true_map: TrueMap, orbit: Floats, control: Floats, reach: Floats, guard: Guard
) -> tuple[Floats, Floats]:
    """Return the derivatives along an orbit (q, d) under controls (q, p); NaN at a kink.

    Returns
    -------
    A, B
        By states, shape (q, d, d), and by controls, shape (q, d, p), per unit of each variable:
        cell widths, and the reach of the controls.

    Raises
    ------
    BadInput
        The map does not send each point to the next.
    """
    noise = [np.full(len(orbit), mean) for mean in noise_nodes(true_map.problem).mean()]
    _refuse_unless_orbit(true_map, orbit, control, noise, guard)
    unit, d = np.concatenate([true_map.partition.width, reach]), orbit.shape[1]
    slopes = _jacobian(true_map, orbit, control, noise, unit, guard)
    return slopes[:, :, :d], slopes[:, :, d:]


def _refuse_unless_orbit(
    true_map: TrueMap, orbit: Floats, control: Floats, noise: list[Floats], guard: Guard
) -> None:
    images, partition = true_map.images(orbit, control, noise, guard), true_map.partition
    with np.errstate(invalid="ignore"):
        miss = partition.deviation(images, np.roll(orbit, -1, axis=0))
    off = np.abs(miss / partition.width).max(axis=1)
    for k in range(len(orbit)):
        if not off[k] <= ON_ORBIT:
            raise BadInput(
                f"point {k} is mapped to {[float(y) for y in images[k]]}, {off[k]:.3g} cell widths "
                "from the next point; give the orbit more precisely, in the order visited, with "
                "its controls",
                "local_controller.orbit",
            )


def reach(low: Floats, high: Floats, control: Floats) -> Floats:
    """Return the largest distance from a control of the orbit to a value; 1 where it is 0."""
    far = np.maximum(np.abs(low - control), np.abs(high - control)).max(axis=0)
    return np.where(far > 0, far, 1.0)


def _jacobian(
    true_map: TrueMap,
    orbit: Floats,
    control: Floats,
    noise: list[Floats],
    unit: Floats,
    guard: Guard,
) -> Floats:
    """Return the derivatives by states and controls, shape (q, d, d + p); NaN at a kink."""
    at, d = np.concatenate([orbit, control], axis=1), orbit.shape[1]
    jets = [Jet.variable(Interval.point(y), j, len(at.T)) for j, y in enumerate(at.T)]
    fixed = [Jet.constant(y, len(at.T)) for y in noise]
    images = true_map.enclose(jets[:d], jets[d:], fixed, guard)
    if images is None:
        return np.moveaxis(_differences(true_map, at, noise, unit), 2, 0)
    slopes = []
    with np.errstate(invalid="ignore", over="ignore"):
        for image, own in zip(images, unit, strict=False):
            per = (unit / own)[:, None]
            low, high = (per * np.broadcast_to(end, at.T.shape) for end in image.slope)
            sharp = np.isfinite(low) & (high - low <= 1e-6 * (1 + np.abs(low)))
            slopes.append(np.where(sharp, per * image.slope.midpoint, np.nan))
    return np.moveaxis(np.stack(slopes), 2, 0)


def _differences(true_map: TrueMap, at: Floats, noise: list[Floats], unit: Floats) -> Floats:
    """Differentiate a Python function by central differences with Richardson's extrapolation."""
    q, d = len(at), true_map.partition.dimension

    def central(j: int, h: float) -> Floats:
        images = []
        for sign in (1.0, -1.0):
            moved = [y + (sign * h if i == j else 0.0) for i, y in enumerate(at.T)]
            found = true_map(moved[:d], moved[d:], noise)
            images.append(np.stack([np.broadcast_to(y, q) for y in found]))
        own = unit[:d, None]
        return np.asarray((images[0] - images[1]) / own * (unit[j] / (2 * h)))

    columns = []
    for j in range(len(at.T)):
        h = max(1e-2 * float(unit[j]), 1e-5 * float(np.abs(at[:, j]).max()))
        columns.append((4 * central(j, h / 2) - central(j, h)) / 3)
    return np.moveaxis(np.stack(columns), 1, 0)  # (d, d + p, q)

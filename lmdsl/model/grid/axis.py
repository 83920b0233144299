"""One axis of the box: what its states are, and in which cell a state lies.

One rule for compilation, controller, simulation and proofs. An image becomes a *state* first: on
a circle it is wrapped into [low, high] (-1e-20 becomes exactly 1.0 on [0, 1]), under ``clip`` it
is moved there, and what lies there already is left alone. Then it is located, in cell
floor(t + 1e-9), t = (x - low) / width. Before the modulus both steps are monotone in the image, so
the cells of all images between two are those between the cells of the two.
"""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.machine.kernels import fixed, kernel

EDGE = 1e-9  # width of an edge in cells: points this close to an edge count as lying on it

# Number of turns away from a circle above which an image counts as out: rounding decides it.
MOST_TURNS = 2.0**20

ROUNDING = 2.0**-53  # relative error of a rounded operation


class AxisCells(NamedTuple):
    """One axis in plain numbers; ``stride`` cells of the box lie between neighbours on it."""

    low: float
    high: float
    width: float
    cells: float
    stride: float
    periodic: bool

    def add_index(self, image: Floats, clip: bool, total: Floats | None) -> Floats:
        """Add the index on this axis, times the stride, to the indices on others; NaN outside.

        Without a total it is a new array in the shape of the image.
        """
        found = np.zeros(image.shape) if total is None else total
        flat, line = fixed(np.ascontiguousarray(image).reshape(-1)), found.reshape(-1)
        if self.periodic:
            circle(flat, self.low, self.high, self.width, self.cells, self.stride, line)
        else:
            interval(flat, self.low, self.high, self.width, self.cells, self.stride, clip, line)
        return found

    def state(self, image: Floats, clip: bool) -> Floats:
        """Return images as states; NaN on a circle where they are too many turns away."""
        return self._turned(image, clip)[1]

    def number(self, image: Floats, clip: bool) -> Floats:
        """Return the index on this axis before the modulus, NaN outside; it grows with the image.

        On a circle, every turn adds ``cells``.
        """
        image = np.asarray(image, dtype=np.float64)
        flat, found = fixed(np.ascontiguousarray(image).reshape(-1)), np.zeros(image.size)
        if self.periodic:
            turned(flat, self.low, self.high, self.width, self.cells, found)
        else:
            interval(flat, self.low, self.high, self.width, self.cells, 1.0, clip, found)
        return found.reshape(image.shape)

    @property
    def margin(self) -> float:
        """Cell widths by which a state, sample point or corner of a cell may lie beyond it.

        The width of an edge, and what rounding adds to it here and where the ends are computed.
        """
        reach = max(abs(self.low), abs(self.high)) / self.width
        return EDGE + 8 * ROUNDING * (self.cells + reach)

    def _turned(self, image: Floats, clip: bool) -> tuple[Floats, Floats]:
        """Return how many turns away from the axis images are, and the states they become.

        The arithmetic of :func:`circle` and :func:`interval`, to the same bits.
        """
        if not self.periodic:
            if clip:  # what is not finite stays out
                image = np.where(np.isfinite(image), np.clip(image, self.low, self.high), image)
            return np.zeros(()), image
        with np.errstate(all="ignore"):
            away, span = image - self.low, self.high - self.low
            turns = np.floor(away / span)
            rest = np.minimum(np.maximum(away - turns * span, 0.0), span)
            wrapped = np.minimum(self.low + rest, self.high)
            at_home = (image >= self.low) & (image <= self.high)
            near = np.abs(turns) <= MOST_TURNS
        x = np.where(at_home, image, np.where(near, wrapped, np.nan))
        return np.where(at_home, 0.0, turns), x


# The kernels have no branch in the loop, so that they run on vectors of doubles.
@kernel
def on_circle(x, low, high, width, cells):  # type: ignore[no-untyped-def]
    """Wrap into [low, high] and return k mod cells, k = floor((x - low)/width + EDGE).

    NaN beyond MOST_TURNS turns. A state near ``high`` may have k = cells.
    """
    span = high - low
    away = x - low
    turns = np.floor(away / span)
    rest = away - turns * span
    rest = rest if rest > 0.0 else 0.0
    rest = rest if rest < span else span
    wrapped = low + rest
    wrapped = wrapped if wrapped < high else high
    x = x if (x >= low) & (x <= high) else wrapped
    k = np.floor((x - low) / width + EDGE)
    k = k if k < cells else 0.0
    return k if abs(turns) <= MOST_TURNS else np.nan


@kernel
def turned(image, low, high, width, cells, index):  # type: ignore[no-untyped-def]
    """Fill in the indices on a circle before the modulus; every turn adds ``cells``."""
    span = high - low
    for i in range(len(image)):
        x, away = image[i], image[i] - low
        home = (x >= low) & (x <= high)
        turns = np.floor(away / span)
        rest = away - turns * span
        rest = rest if rest > 0.0 else 0.0
        rest = rest if rest < span else span
        wrapped = low + rest
        wrapped = wrapped if wrapped < high else high
        k = np.floor(((x if home else wrapped) - low) / width + EDGE)
        k = k if home else turns * cells + k
        index[i] = k if home | (abs(turns) <= MOST_TURNS) else np.nan


@kernel
def on_interval(x, low, high, width, cells, clip):  # type: ignore[no-untyped-def]
    """Return k = floor((x - low)/width + EDGE) for 0 <= k < cells; NaN elsewhere.

    The last cell has all images up to ``high``, and up to EDGE above itself. With ``clip`` a
    finite image is moved into the interval first.
    """
    finite = abs(x) < np.inf
    if clip:
        x = low if x < low else x
        x = high if x > high else x
    t = (x - low) / width
    k = np.floor(t + EDGE)
    last = (k >= cells) & ((t - cells <= EDGE) | (x <= high))
    k = cells - 1.0 if last else k
    return k if finite & (k >= 0.0) & (k < cells) else np.nan


@kernel
def number_on(axes, k, x):  # type: ignore[no-untyped-def]
    """Return what x on axis k adds to the number of a cell, NaN outside; ``axes`` as an array."""
    low, high, width, cells, stride = axes[k, 0], axes[k, 1], axes[k, 2], axes[k, 3], axes[k, 4]
    if axes[k, 5] > 0.0:
        return stride * on_circle(x, low, high, width, cells)
    return stride * on_interval(x, low, high, width, cells, False)


@kernel
def circle(image, low, high, width, cells, stride, index):  # type: ignore[no-untyped-def]
    """Add the indices on a circle, times the stride."""
    for i in range(len(image)):
        index[i] += stride * on_circle(image[i], low, high, width, cells)


@kernel
def interval(image, low, high, width, cells, stride, clip, index):  # type: ignore[no-untyped-def]
    """Add the indices on an interval, times the stride."""
    for i in range(len(image)):
        index[i] += stride * on_interval(image[i], low, high, width, cells, clip)

"""Perron vectors of classes, by Noda's iteration."""

from dataclasses import replace
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, TimeUp
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.directions import Directions
from lmdsl.optimize.linear import classes, equations
from lmdsl.optimize.linear.gauss_seidel import SplitMatrix

LEAST_ENTRY = 1e-250  # least entry of the vector of a class whose largest is 1

# How much slower than the slowest class one is known to be before its exact rate is left open.
SLOWER = 1e-3

# Number of steps of Noda's iteration above which it fails, and relative width that ends it.
STEPS, FINE = 100, 1e-11

# First relative step down to a rate that may be too low; then four times as far each time.
REACH = 1e-4

SMALLEST, LARGEST = 1e-280, 1e300  # range of w


def _perron(
    inner: Any,
    time_up: TimeUp,
    slowest: float = 0.0,
    directions: Directions | None = None,
    start: Floats | None = None,
    enough: float = FINE,
) -> tuple[Floats, float, float]:
    """Return x > 0, the largest (M x)_i / x_i, and the least, for an irreducible M >= 0.

    For a bound at > rho, y = (I - M/at)^-1 x is positive and (M y)_i / y_i < at. Noda's iteration
    takes for ``at`` the largest (M x)_i / x_i so far: it falls to rho, quadratically in the end.
    Where it falls slowly, as it does if x spans many decades, ``at`` is taken halfway down to a
    lower bound: the least (M x)_i / x_i, or an ``at`` that gave no positive y. Whatever x > 0 it
    ends with, max (M x)_i / x_i >= rho holds. It ends early where that is below ``slowest``, the
    rate of another class. In a large class, with its ``directions``, y is found by Krylov's method;
    a y that is not exact only takes a step more.
    """
    n = inner.shape[0]
    dense = inner.toarray() if n <= classes.DENSE else None
    M = inner if dense is None else dense
    slow_fall = 0.1 if directions is None else 0.9
    x = np.ones(n)
    ahead = M @ x
    if start is not None and (M @ start < float(ahead.max()) * start).all():
        x = start / start.max()
        ahead = (M @ x) / x
    top, bottom = float(ahead.max()), float(ahead.min())
    least, halve, reach = bottom, False, REACH
    for _ in range(STEPS):
        width = top - bottom
        if width <= enough * top or top < slowest * (1 - SLOWER):
            break
        # A little off top, so that the last steps are not singular.
        middle = max((top + bottom) / 2, top * (1 - reach))
        at = middle if halve else top * (1 + 1e-9)
        y = _solved(M / at, x, time_up, directions)
        if y is None:
            if not halve:
                break
            bottom, reach = at, 1.0
            continue
        reach *= 4 if halve else 1
        ahead_y = M @ y
        ratio = ahead_y / y
        least = max(least, float(ratio.min()))
        bottom = max(bottom, least)
        if ratio.max() < top:
            x, top = y, float(ratio.max())
        elif not halve:
            break
        else:
            bottom = at  # rounding ends here
        halve = not top - bottom < slow_fall * width
    return x, top, least


def _solved(M: Any, x: Floats, time_up: TimeUp, directions: Directions | None) -> Floats | None:
    """Return y = x + M y, largest entry 1, None where it is not positive or leaves doubles."""
    if isinstance(M, np.ndarray):
        try:
            y: Any = np.linalg.solve(np.eye(len(x)) - M, x)
        except np.linalg.LinAlgError:
            return None
    elif directions is None:
        y = equations.solve(M, x, time_up)
    else:
        scaled = M.copy()  # all sizes alike, as a Krylov method wants them
        scaled.data *= x[M.indices] / np.repeat(x, np.diff(M.indptr))
        y = equations.guess(
            replace(SplitMatrix.of(scaled), directions=directions), np.ones(len(x)), time_up
        )
        y = None if y is None else x * y
    if y is None or not np.isfinite(y).all() or not y.min() > 0:
        return None
    y = x + M @ y  # sums of positive numbers: every entry to its own precision
    y = y / y.max()
    return np.asarray(y, dtype=np.float64) if y.min() >= LEAST_ENTRY else None


@kernel(allocates=True)
def _scale(indptr, indices, data, order, ends, x, bound, w):  # type: ignore[no-untyped-def]
    """Scale the vector of each class so that P w <= bound w; False where doubles end.

    Classes are met after all they lead to. In class c, with w = s x: inner + outer <= bound s x
    asks s >= outer / (bound x - inner), inner = (P x) within the class, outer = (P w) beyond it.
    """
    label = np.full(len(order), -1)
    begin = 0
    for c in range(len(ends)):
        for p in range(begin, ends[c]):
            label[order[p]] = c
        scale = 0.0
        for p in range(begin, ends[c]):
            i = order[p]
            scale = max(scale, SMALLEST / x[i])
            inner, outer = 0.0, 0.0
            for e in range(indptr[i], indptr[i + 1]):
                j = indices[e]
                if label[j] == c:
                    inner += data[e] * x[j]
                else:
                    outer += data[e] * w[j]
            margin = bound * x[i] - inner
            if margin <= 0.0:
                return False
            scale = max(scale, outer / margin)
        if not scale < LARGEST:
            return False
        for p in range(begin, ends[c]):
            w[order[p]] = scale * (1 + 1e-12) * x[order[p]]
        begin = ends[c]
    return True

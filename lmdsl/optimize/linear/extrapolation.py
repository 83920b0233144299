"""Where sweeps stall: extrapolation along one mode, and BiCGSTAB, a Krylov method, on sweeps.

One mode, such as the slow escape from a well-mixed set, is what hinders most. The first two take a
few Jacobi steps, after which the residual is nearly that mode, and go as far along it as every
component allows: down to just above the solution of x = b + M x, or up to above it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.optimize.linear.gauss_seidel import CEILING, SplitMatrix

SWEEPS, STEPS = 4, 16  # number of sweeps, and of Jacobi steps, before extrapolating
# Relative fall below which, and number of Jacobi steps above which, rounding would decide.
LEAST_FALL, FARTHEST = 1e-10, 1e4
ROUNDING = 1e-13  # relative rise up to which x counts as above b + M x


def extrapolate(system: SplitMatrix, b: Floats, x: Floats) -> float:
    """Lower x >= b + M x in place, mostly along the mode in which sweeps stall; return how far.

    A few sweeps, then Jacobi steps, which take r = x - (b + M x) from x and turn it into M r: soon
    along the slowest mode. x - t r >= b + M (x - t r) is t (r - M r) <= r, so the largest t that
    all components allow is safe; it is 1 / (1 - rate) for a mode alone. Returns t, 1 where nothing
    was gained over a Jacobi step or x is not above b + M x, up to rounding. (With the diagonal of M
    solved for, as in sweeps.)
    """
    system.sweep(b, x, SWEEPS)
    r = x - system.inverse * b - _moved(system, x)
    if not ((r >= -ROUNDING * x).all() and (r > LEAST_FALL * x).any()):
        return 1.0
    np.maximum(r, 0.0, out=r)
    for _ in range(STEPS):
        x -= r
        r = _moved(system, r)
    if not (r > LEAST_FALL * x).any():
        return 1.0
    rate = np.divide(_moved(system, r), r, out=np.ones(len(r)), where=r > 0).min()
    t = min(1.0 / max(1.0 - float(rate), 1e-300), FARTHEST)
    x -= (t * (1 - 1e-6)) * r
    return t


def lift(system: SplitMatrix, b: Floats, x: Floats) -> bool:
    """Raise x in place to x >= b + M x, mostly along the slowest mode; False where that fails.

    Jacobi steps x <- x + r, r <- M r begin with r >= b + M x - x, which stays true and brings r
    near the slowest mode, or a pair of them that alternates. With R = r + M r it follows from
    t (R - M R) = t (r - M^2 r) >= r that x + t R >= b + M (x + t R): t = 1 / (1 - rate) serves
    where M^2 r <= rate r with rate < 1. (With the diagonal of M solved for, as in sweeps.)
    """
    with np.errstate(all="ignore"):
        r = np.maximum(system.inverse * b + _moved(system, x) - x, 0.0)
        for _ in range(STEPS):
            x += r
            r = _moved(system, r)
        following = _moved(system, r)
        rate = np.nanmax(_moved(system, following) / r, initial=0.0)
        if not rate < 1:
            return False
        x += (1 + 1e-6) / (1 - rate) * (r + following)
    return bool((x < CEILING).all())


def _moved(system: SplitMatrix, v: Floats) -> Floats:
    """Return D^-1 (M - own) v with D = 1 - own, own the diagonal of M: one Jacobi step."""
    return system.inverse * system.times(v)


def bicgstab(
    applied: Callable[[Floats], Floats],
    b: Floats,
    x: Floats,
    steps: int,
    time_up: TimeUp,
    enough: float,
    dot: Callable[[Floats, Floats], Any] = lambda u, v: (u * v).sum(),
    anywhere: Callable[[bool], bool] = bool,
) -> Floats:
    """Solve applied(x) = b to a relative residual ``enough``, or make so many steps.

    Of parts of vectors ``dot`` and ``anywhere`` are told, and answer for the whole.
    """
    x = np.where(np.isfinite(x), x, 0.0)
    r = b - applied(x)
    shadow, p, rho = r, r, dot(r, r)
    least = enough * enough * dot(b, b)
    for _ in range(steps):
        if not dot(r, r) > least or rho == 0.0:
            break
        if time_up():
            raise Stopped
        q = applied(p)
        alpha = rho / dot(shadow, q)
        s = r - alpha * q
        t = applied(s)
        omega = dot(t, s) / dot(t, t) if anywhere(bool(t.any())) else np.float64(0.0)
        following = x + alpha * p + omega * s
        if anywhere(not np.isfinite(following).all()):
            break
        x = following
        r = s - omega * t
        before, rho = rho, dot(shadow, r)
        p = r + (rho / before) * (alpha / omega) * (p - omega * q)
    return x

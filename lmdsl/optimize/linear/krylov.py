"""Krylov's method BiCGSTAB on a cycle of sweeps."""

from collections.abc import Callable
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, TimeUp
from lmdsl.machine.deadline import Stopped


def _bicgstab(
    applied: Callable[[Floats], Floats],
    b: Floats,
    x: Floats,
    steps: int,
    time_up: TimeUp,
    enough: float,
) -> Floats:
    """Solve applied(x) = b to a relative residual ``enough``, or make so many steps."""

    def dot(u: Floats, v: Floats) -> Any:
        return (u * v).sum()

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
        omega = dot(t, s) / dot(t, t) if t.any() else np.float64(0.0)
        following = x + alpha * p + omega * s
        if not np.isfinite(following).all():
            break
        x = following
        r = s - omega * t
        before, rho = rho, dot(shadow, r)
        p = r + (rho / before) * (alpha / omega) * (p - omega * q)
    return x

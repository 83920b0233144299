"""Solving x = b + M x for a nonnegative sparse M: the evaluation of a fixed policy.

For b >= 0 the smallest nonnegative solution is sum M^k b, finite for every b exactly when the
spectral radius of M is below 1. Jacobi sweeps from 0 rise to it and keep every iterate >= 0. Where
they converge slowly a sparse LU factorisation takes over (unless fill would be costly); its answer
is polished by one refinement step. Whether an answer is good enough is judged by the certificate.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TRIAL_SWEEPS = 60
MAX_SWEEPS = 200_000
MAX_FACTORED = 100_000
TOLERANCE = 2e-15


def solve(M: Any, b: Floats, start: Floats | None = None) -> Floats | None:
    """Return x >= 0 with x = b + M x, or None where there is none (as far as rounding can tell).

    Parameters
    ----------
    M
        Sparse array of shape (n, n), entries >= 0.
    b
        Shape (n,), entries >= 0.
    start
        A guess, shape (n,), >= 0.
    """
    x = np.array(b if start is None else start, dtype=np.float64)
    x, change, rate = _sweep(M, b, x, TRIAL_SWEEPS)
    if change <= TOLERANCE:
        return x
    if len(b) <= MAX_FACTORED and not _soon(change, rate):
        return _factor(M, b)
    ceiling = 1e290
    for _ in range(MAX_SWEEPS // TRIAL_SWEEPS):
        x, change, rate = _sweep(M, b, x, TRIAL_SWEEPS)
        if change <= TOLERANCE:
            return x
        if not np.isfinite(change) or x.max() > ceiling:
            return None
    return _factor(M, b)


def _soon(change: float, rate: float) -> bool:
    return rate < 1 and np.log(TOLERANCE / change) / np.log(max(rate, 1e-300)) < 300


def _sweep(M: Any, b: Floats, x: Floats, count: int) -> tuple[Floats, float, float]:
    """Sweep; return x, its last relative change, and the factor by which a sweep shrinks it."""
    halfway = last = np.inf
    for k in range(count):
        y = b + M @ x
        if k in (count // 2, count - 1):
            top = float(y.max(initial=0.0))
            with np.errstate(all="ignore"):
                relative = np.abs(y - x) / np.maximum(y, 1e-14 * top + 1e-300)
            halfway, last = last, float(relative.max(initial=0.0))
        x = y
    rate = (last / halfway) ** (2 / count) if 0 < halfway < np.inf else 0.0
    return x, last, rate


def _factor(M: Any, b: Floats) -> Floats | None:
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    system = (eye_array(len(b), format="csr") - M).tocsc()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            factors = splu(system)
    except (RuntimeError, Warning, MemoryError):
        return None
    x = factors.solve(b)
    x += factors.solve(b - (x - M @ x))
    if not np.isfinite(x).all():
        return None
    top = float(x.max(initial=0.0))
    if float(x.min(initial=0.0)) < -1e-9 * max(top, 0.0) or (top <= 0 and b.any()):
        return None
    x = np.maximum(x, 0.0)
    residual = np.abs(b + M @ x - x).max(initial=0.0)
    return x if residual <= 1e-6 * (top + b.max(initial=0.0)) else None

"""The linear-quadratic regulator of a periodic system, whatever the scale of its weights.

The periodic system is solved as one in cyclic form: its state holds one block per point, block k
moves to block k + 1 by A_k, B_k. The stabilizing solution of its Riccati equation is block diagonal
with the periodic solution (Bittanti and Colaneri, Periodic Systems, 2009). A doubling algorithm
(Chu, Fan, Lin, Wang 2004) for unit weights gives a first stabilizing gain, Newton's method (Hewer
1971) leads from there to any weights: its gains all stabilize, and each step only solves a Lyapunov
equation, a sum of matrices >= 0.
"""

import numpy as np

from lmdsl.common.types import Floats

STEPS, DOUBLINGS = 200, 64  # number of Newton steps, and of doublings, above which it fails
# Relative change of the gain that ends the work, and below which it only has to stop falling: near
# a mode that hardly decays Newton halves it.
ENOUGH, ROUNDING, FALLING = 1e-13, 1e-6, 0.9
RESIDUAL = 1e-8  # residual relative to the solution above which it is refused
# Modulus of a mode under feedback above which rounding in 1 - K leaves no digits of it.
STABLE = 1 - 1e-11
# Least power of two that a weight may have beside the largest: smaller ones are as good as it.
LEAST = -1000.0


class Unstabilizable(Exception):
    """A mode that does not decay is out of reach of the controls; ``multiplier`` is its modulus."""

    def __init__(self, multiplier: float) -> None:
        super().__init__()
        self.multiplier = multiplier


class Unsolved(Exception):
    """The equation has a solution, but doubles do not hold it."""


def regulator(A: Floats, B: Floats, Q: Floats, R: Floats) -> Floats:
    """Return the gains K_k of the optimal u = -K_k x, shape (q, p, d).

    Parameters
    ----------
    A, B
        Shapes (q, d, d) and (q, d, p), in units in which states and controls are of size 1.
    Q, R
        Diagonals of the weights of states and controls, as binary logarithms: of any size.

    Raises
    ------
    Unstabilizable, Unsolved
        There is no stabilizing gain, or it could not be found.
    """
    q, d, p = B.shape
    with np.errstate(all="ignore"):
        size = np.sqrt((B**2).sum(axis=1)).max(axis=0)
        size[~(size > 0)] = 1.0
        R = R - 2 * np.log2(size)
        top = max(Q.max(), R.max())
        Q, R = (np.tile(np.exp2(np.maximum(x - top, LEAST)), q) for x in (Q, R))
        F, G = _cyclic(A), _cyclic(B / size)
        gain = _newton(F, G, Q, R)
    if gain is None:
        _refuse_unstabilizable(F, G, q)
        raise Unsolved
    blocks = [gain[k * p : (k + 1) * p, k * d : (k + 1) * d] for k in range(q)]
    return np.asarray(np.stack(blocks) / size[:, None])


def _cyclic(blocks: Floats) -> Floats:
    q, rows, columns = blocks.shape
    matrix = np.zeros((q, rows, q, columns))
    for k in range(q):
        matrix[(k + 1) % q, :, k, :] = blocks[k]
    return matrix.reshape(q * rows, q * columns)


def _newton(A: Floats, B: Floats, Q: Floats, R: Floats) -> Floats | None:
    """Return the gain, None where no step leads to one or the residual is not small."""
    try:
        K, change = _first(A, B), np.inf
        for _ in range(STEPS):
            C = A - B @ K
            X = _lyapunov(C, np.diag(Q) + K.T @ (R[:, None] * K))
            last, before, K = change, K, _gain(X, A, B, R)
            change = np.abs(K - before).max() / np.abs(K).max() if K.any() else 0.0
            if change <= ENOUGH or FALLING * last < change <= ROUNDING:
                break
        C = A - B @ K
        left = np.diag(Q) + K.T @ (R[:, None] * K) + C.T @ X @ C - X
        stable = bool(np.abs(np.linalg.eigvals(C)).max() <= STABLE)
    except np.linalg.LinAlgError:
        return None
    good = stable and bool(np.abs(left).max() <= RESIDUAL * np.abs(X).max())
    return K if good else None


def _first(A: Floats, B: Floats) -> Floats:
    """Return the gain for unit weights."""
    unit = np.eye(len(A))
    F, G, H = A, B @ B.T, unit
    for _ in range(DOUBLINGS):
        W = np.linalg.solve(unit + G @ H, np.hstack([F, G]))
        onto, through = np.hsplit(W, 2)
        more = F.T @ H @ onto
        G, H, F = G + F @ through @ F.T, H + more, F @ onto
        G, H = (G + G.T) / 2, (H + H.T) / 2
        if not np.isfinite(H).all() or np.abs(more).max() <= ENOUGH * np.abs(H).max():
            break
    return _gain(H, A, B, np.ones(B.shape[1]))


def _gain(X: Floats, A: Floats, B: Floats, R: Floats) -> Floats:
    """Return (R + B'XB)^-1 B'XA; scaled to a unit diagonal, the matrix is as regular as can be."""
    M = np.diag(R) + B.T @ X @ B
    scale = 1 / np.sqrt(np.diag(M))
    return np.asarray(
        scale[:, None] * np.linalg.solve(scale[:, None] * M * scale, scale[:, None] * (B.T @ X @ A))
    )


def _lyapunov(C: Floats, M: Floats) -> Floats:
    """Return X = M + C'XC by squaring (Smith 1968); C must decay."""
    X, P = M, C
    for _ in range(DOUBLINGS):
        more = P.T @ X @ P
        X = X + more
        if np.abs(more).max() <= 1e-17 * np.abs(X).max() < np.inf:
            return X
        P = P @ P
    raise np.linalg.LinAlgError


def _refuse_unstabilizable(A: Floats, B: Floats, q: int) -> None:
    """Raise where [A - z, B] loses rank at an eigenvalue z, |z| >= 1 (Popov, Belevitch, Hautus)."""
    for z in np.linalg.eigvals(A):
        if abs(z) >= 1 - 1e-9:
            values = np.linalg.svd(np.hstack([A - z * np.eye(len(A)), B]), compute_uv=False)
            if values[-1] <= 1e-13 * max(values[0], 1.0):
                raise Unstabilizable(float(abs(z) ** q))

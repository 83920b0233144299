"""Models in which sweeps are slow, and their exact values."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp


def mixing(n, escape, rng, spread=4):
    """Return a sparse matrix whose rows sum to 1 - escape, with targets anywhere."""
    target = rng.integers(0, n, (n, spread))
    weight = rng.random((n, spread))
    weight *= (1 - escape) / weight.sum(axis=1, keepdims=True)
    M = sp.csr_array((weight.ravel(), (np.repeat(np.arange(n), spread), target.ravel())), (n, n))
    M.sum_duplicates()
    return M


def transport(n, rng):
    """Return a walk to the left with a little spread: no single slow mode."""
    back, stay = rng.uniform(0.0, 0.1, n), rng.uniform(0.3, 0.5, n)
    M = sp.dia_array((np.array([1 - back - stay, stay, back]), [-1, 0, 1]), shape=(n, n))
    return sp.csr_array(M)


def exact(M, b):
    return sp.linalg.spsolve(sp.eye_array(M.shape[0], format="csc") - M.tocsc(), b)


def above(M, b, rng):
    """Return an x >= b + M x, neither near the solution nor parallel to it."""
    return exact(M, b * rng.uniform(1.0, 3.0, len(b)))

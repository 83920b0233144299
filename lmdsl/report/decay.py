"""The closed loop of the finite model: its spectrum, and how fast the mass of m enters A.

P_u, the rows of the policy on C, is substochastic: what is missing enters A, or ends by discount.
Its spectrum is the union of those of its strongly connected parts. They are taken one by one: of a
cell that returns to itself through no other, the eigenvalue is its own entry, 0 where nothing
stays. So what is nilpotent, as closed loops that always make progress are, has the spectrum {0},
where the eigenvalues of the whole matrix, computed at once, are far off.
"""

from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.machine.deadline import Deadline
from lmdsl.model.lp import StabilizationLP
from lmdsl.report.browser import columns_of
from lmdsl.results.result import Result

DENSE = 400  # cells of a part up to which all of its eigenvalues are computed
LEADING = 16  # eigenvalues of a larger part, and all that a page shows
WORK = 1e9  # operations for those of one part, about
PARTS = 200  # parts of which eigenvalues are computed, largest first
LEFT = 1e-9  # share of the mass at which the decay ends
LONGEST = 5_000  # steps after which it ends
POINTS = 400  # of its curve that a page draws


def closed_loop_of(
    result: Result, lp: StabilizationLP, deadline: Deadline
) -> dict[str, Any] | None:
    """Return spectrum and decay of the closed loop as plain data; None without a policy."""
    columns = columns_of(result, lp)
    if columns is None:
        return None
    P = lp.rows.take(columns).matrix()
    radius, found, complete = spectrum(P, deadline)
    steps, left, mean = decay(P, lp.weight, deadline)
    return {
        "cells": lp.n,
        "transitions": int(P.nnz),
        "radius": radius,
        "complete": complete,
        "eigenvalues": [[float(z.real), float(z.imag)] for z in found],
        "contraction": result.contraction,
        "growth": lp.growth,
        "steps": steps,
        "left": left,
        "mean": mean,
    }


def spectrum(P: Any, deadline: Deadline) -> tuple[float | None, Any, bool]:
    """Return the spectral radius, the largest eigenvalues, and whether no larger one is missed.

    P is a SciPy sparse array of shape (n, n). The radius is None where nothing could be computed.
    """
    from scipy.sparse.csgraph import connected_components

    _, part = connected_components(P, directed=True, connection="strong")
    size = np.bincount(part)
    alone = P.diagonal()[size[part] == 1]
    values = [np.unique(alone[alone > 0]).astype(complex)[::-1][:LEADING], np.zeros(1, complex)]
    complete = True
    order = np.argsort(part, kind="stable")
    start = np.concatenate([[0], np.cumsum(size)])
    large = np.flatnonzero(size > 1)
    large = large[np.argsort(-size[large], kind="stable")]
    for k in large[:PARTS]:
        if deadline():
            complete = False
            break
        cells = order[start[k] : start[k + 1]]
        found, all_of_them = _eigenvalues(P[cells][:, cells])
        complete &= all_of_them
        values.append(found)
    together = np.concatenate(values)
    together = together[np.lexsort((-together.imag, -together.real, -np.abs(together).round(12)))]
    complete &= len(large) <= PARTS
    radius = float(np.abs(together).max()) if complete or len(together) > 1 else None
    shown = _leading(together) if np.abs(together).max() else together[:1]
    return radius, shown, complete


def _leading(values: Any) -> Any:
    """Return the first LEADING of sorted values, and the conjugates of those, which P has too.

    Where Arnoldi's method ends between the two of a pair, it finds one of them.
    """
    some = values[:LEADING]
    near = 1e-6 * np.abs(some)
    real = np.abs(some.imag) <= near
    alone = ~real & (np.abs(some[:, None] - some.conj()[None, :]).min(axis=0) > near)
    return np.concatenate([some, some[alone].conj()])


def _eigenvalues(block: Any) -> tuple[Any, bool]:
    """Return the largest eigenvalues of a strongly connected part, and whether all converged."""
    n = block.shape[0]
    if n <= DENSE:
        return np.linalg.eigvals(block.toarray()).astype(complex), True
    from scipy.sparse.linalg import ArpackError, ArpackNoConvergence, eigs

    each = 2 * LEADING * (block.nnz + 4 * LEADING * n)  # of a restart
    restarts = int(np.clip(WORK / each, 20, 2000))
    try:
        found = eigs(
            block, LEADING, which="LM", v0=np.ones(n), maxiter=restarts, tol=1e-9,
            return_eigenvectors=False,
        )  # fmt: skip
        return found, True
    except ArpackNoConvergence as error:
        return np.asarray(error.eigenvalues, dtype=complex), False
    except (ArpackError, RuntimeError, ValueError):
        return np.zeros(0, complex), False


def decay(
    P: Any, weight: Floats, deadline: Deadline
) -> tuple[list[int], list[float], float | None]:
    """Return how much of the mass of m is left after so many steps, and the mean time to leave.

    The mean is None where mass is left at the end.
    """
    transposed = P.T.tocsr()
    mass, left = weight.copy(), [float(weight.sum())]
    while left[-1] > LEFT and len(left) <= LONGEST and not deadline():
        mass = transposed @ mass
        left.append(float(mass.sum()))
    total = float(np.sum(left))
    steps = np.arange(len(left))
    if len(left) > POINTS:
        steps = np.unique(np.geomspace(1, len(left) - 1, POINTS).round().astype(np.int64))
        steps = np.append(0, steps)
    done = left[-1] <= LEFT
    return [int(n) for n in steps], [left[n] for n in steps], total if done else None

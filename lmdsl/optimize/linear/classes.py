"""x = b + M x class by class, each communicating class after those it leads to."""

from collections.abc import Callable
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, Indices, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.optimize.linear.gauss_seidel import CEILING

MAX_FACTORED = 100_000  # number of cells above which a class is not factored
DENSE = 50  # number of cells above which a class is factored as a sparse matrix


def solve_by_class(M: Any, b: Floats, time_up: TimeUp = never) -> tuple[Floats | None, bool]:
    """Solve class by class; return x or None, and whether every class was small enough to try."""
    order, ends = classes(M)
    lengths = np.diff(ends, prepend=0)
    count = len(ends)
    if lengths.max(initial=0) > MAX_FACTORED:
        return None, False
    x = np.zeros(len(b))
    begun = 0
    for k in np.append(np.flatnonzero(lengths > 1), count):
        until = ends[k - 1] if k else 0
        if not _substitute(M.indptr, M.indices, M.data, order[begun:until], b, x):
            return None, True
        if k == count:
            break
        if time_up():
            raise Stopped
        cells = order[until : ends[k]]
        if not _solve_class(M, b, x, cells):
            return None, True
        begun = ends[k]
    return x, True


def classes(M: Any) -> tuple[Indices, Indices]:
    """Return the cells ordered by strongly connected class, and where each class ends.

    Every class comes after all it leads to: class k is ``order[ends[k - 1]:ends[k]]``.
    """
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(M, directed=True, connection="strong")
    rank = _topological(M.indptr, M.indices, label, count)
    lengths = np.empty(count, dtype=np.int64)
    lengths[rank] = np.bincount(label, minlength=count)
    return np.argsort(rank[label], kind="stable"), np.cumsum(lengths)


def _solve_class(M: Any, b: Floats, x: Floats, cells: Indices) -> bool:
    """Solve one strongly connected class in place; False where it has no finite solution."""
    rows = M[cells]
    known = b[cells] + rows @ x
    scale = float(known.max())
    if scale == 0.0:
        return True  # no cost is incurred here or after: 0, whatever the class does
    if not np.isfinite(scale):
        return False
    inner = rows[:, cells]
    known /= scale
    try:
        solver = _dense(inner) if len(cells) <= DENSE else _factors(inner)
        y = solver(known)
        y += solver(known - (y - inner @ y))
    except (RuntimeError, MemoryError, np.linalg.LinAlgError):
        return False
    # An irreducible class has a nonnegative solution only if its spectral radius is below 1.
    if not np.isfinite(y).all() or y.min() < 0 or y.max() > CEILING / scale:
        return False
    residual = np.abs(known + inner @ y - y)
    if not (residual <= 1e-6 * (y + known)).all():
        return False
    x[cells] = scale * y
    return True


def _factors(inner: Any) -> Callable[[Floats], Floats]:
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import splu

    system = (eye_array(inner.shape[0], format="csr") - inner).tocsc()
    solver: Callable[[Floats], Floats] = splu(system).solve
    return solver


def _dense(inner: Any) -> Callable[[Floats], Floats]:
    system = np.eye(inner.shape[0]) - inner.toarray()
    return lambda known: np.linalg.solve(system, known)


@kernel(allocates=True)
def _spread(begin, end, indices, marked):  # type: ignore[no-untyped-def]
    """Mark everything that can reach a marked node."""
    queue = np.flatnonzero(marked)
    queue = np.append(queue, np.empty(len(marked) - len(queue), dtype=queue.dtype))
    last = marked.sum()
    at = 0
    while at < last:
        j = queue[at]
        at += 1
        for e in range(begin[j], end[j]):
            i = indices[e]
            if not marked[i]:
                marked[i] = True
                queue[last] = i
                last += 1


@kernel(allocates=True)
def _topological(indptr, indices, label, count):  # type: ignore[no-untyped-def]
    """Rank the classes so that every class comes after all it leads to (Kahn's algorithm)."""
    waits = np.zeros(count, dtype=np.int64)
    start = np.zeros(count + 1, dtype=np.int64)
    for i in range(len(label)):
        for e in range(indptr[i], indptr[i + 1]):
            if label[i] != label[indices[e]]:
                waits[label[i]] += 1
                start[label[indices[e]] + 1] += 1
    for c in range(count):
        start[c + 1] += start[c]
    before = np.empty(start[count], dtype=np.int64)
    used = start[:-1].copy()
    for i in range(len(label)):
        for e in range(indptr[i], indptr[i + 1]):
            c = label[indices[e]]
            if label[i] != c:
                before[used[c]] = label[i]
                used[c] += 1
    rank = np.empty(count, dtype=np.int64)
    queue = np.empty(count, dtype=np.int64)
    end = 0
    for c in range(count):
        if waits[c] == 0:
            queue[end] = c
            end += 1
    for k in range(count):
        c = queue[k]
        rank[c] = k
        for e in range(start[c], start[c + 1]):
            waits[before[e]] -= 1
            if waits[before[e]] == 0:
                queue[end] = before[e]
                end += 1
    return rank


@kernel
def _substitute(indptr, indices, data, cells, b, x):  # type: ignore[no-untyped-def]
    """Solve single-cell classes in order; False where staying alone already diverges."""
    for i in cells:
        own, known = 0.0, b[i]
        for e in range(indptr[i], indptr[i + 1]):
            j = indices[e]
            if j == i:
                own += data[e]
            else:
                known += data[e] * x[j]
        if known == 0.0:
            x[i] = 0.0
        elif own >= 1.0 or known / (1.0 - own) > CEILING:
            return False
        else:
            x[i] = known / (1.0 - own)
    return True

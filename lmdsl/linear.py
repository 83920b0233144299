"""Solving x = b + M x for a nonnegative sparse M: the evaluation of a fixed policy.

For b >= 0 the smallest nonnegative solution is sum M^k b, finite for every b exactly when the
spectral radius of M is below 1. Gauss-Seidel sweeps converge to it, from any x >= 0, at least as
fast as Jacobi's, and keep every iterate >= 0. Where they converge slowly the system is solved
directly, class by class: the strongly connected classes of M are visited in an order in which
everything a class leads to is known, single cells by substitution, larger classes by sparse LU.
Values may then span hundreds of decades, as a chain of slow classes makes them do, and each class
is still solved to its own precision. Whether an answer is good enough is judged by the certificate.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl import threads

Floats = NDArray[np.float64]

TRIAL_SWEEPS = 60
MAX_SWEEPS = 200_000
MAX_FACTORED = 100_000
DENSE = 50
TOLERANCE = 2e-15
CEILING = 1e305
NEVER = 1e308
SPLIT = 100_000
ONE = np.uint64(1)

Stop = Callable[[], bool]


class Stopped(Exception):
    """The caller's time is up: no answer, which is not the same as no solution."""


def never() -> bool:
    """Return False: nothing ends the work early."""
    return False


@dataclass(frozen=True)
class System:
    """x = b + M x with the diagonal solved for: x_i = (b_i + sum over j != i of M_ij x_j) / own_i.

    Attributes
    ----------
    begin, end, indices, data
        The rows of M without its diagonal: row i is ``begin[i]:end[i]``.
    inverse
        1 / (1 - M_ii), huge where M_ii >= 1: no finite x_i > 0 satisfies such a row.
    b
        Shape (n,), entries >= 0.
    """

    begin: NDArray[np.uint64]
    end: NDArray[np.uint64]
    indices: NDArray[np.uint32]
    data: Floats
    inverse: Floats
    b: Floats

    @classmethod
    def of(cls, M: Any, b: Floats) -> System:
        """Split a CSR array."""
        n, entries = len(b), len(M.data)
        end = np.empty(n, dtype=np.uint64)
        indices, data = np.empty(entries, dtype=np.uint32), np.empty(entries)
        inverse = np.empty(n)
        begin = M.indptr[:-1].astype(np.uint64)
        _split(M.indptr, M.indices, M.data, end, indices, data, inverse)
        return cls(begin, end, indices, data, inverse, b)

    def sweep(
        self, x: Floats, count: int, enough: float = TOLERANCE, flat: float = 0.0
    ) -> tuple[float, float]:
        """Make Gauss-Seidel sweeps in place; see :func:`_gauss_seidel`."""
        if len(x) >= SPLIT:  # by size alone: the result does not depend on the threads
            return _in_halves(self, x, count, enough, flat)
        halfway, last = _gauss_seidel(
            self.begin, self.end, self.indices, self.data, self.inverse, self.b, x, count, enough,
            flat,
        )  # fmt: skip
        return float(halfway), float(last)


def solve(
    M: Any,
    b: Floats,
    start: Floats | None = None,
    enough: float = TOLERANCE,
    flat: float = 0.0,
    stop: Stop = never,
) -> Floats | None:
    """Return x >= 0 with x = b + M x, or None where there is none (as far as rounding can tell).

    Parameters
    ----------
    M
        Sparse CSR array of shape (n, n), entries >= 0.
    b
        Shape (n,), entries >= 0.
    start
        A guess, shape (n,), >= 0.
    enough, flat
        Relative, and absolute, change of a sweep that ends the work.
    stop
        Asked after the first few sweeps, then again and again between sweeps and classes.

    Raises
    ------
    Stopped
        ``stop`` said so.
    """
    x = np.array(b if start is None else start, dtype=np.float64)
    if (b == 0).any():
        x[~_pays(M, b)] = 0.0  # exactly: a guess would only fade there
    return solve_from(System.of(M, b), x, lambda: M, enough, flat, stop)


def solve_from(
    system: System,
    x: Floats,
    matrix: Callable[[], Any],
    enough: float = TOLERANCE,
    flat: float = 0.0,
    stop: Stop = never,
) -> Floats | None:
    """Solve from a guess, which is overwritten; ``matrix`` makes M where sweeps are slow."""
    change, rate = _trial(system, x, enough, flat)
    if change <= enough:
        return x
    if not _soon(change, rate):
        direct, small_enough = solve_by_class(matrix(), system.b, stop)
        if direct is not None or small_enough:
            return direct
    for _ in range(MAX_SWEEPS // TRIAL_SWEEPS):
        if stop():
            raise Stopped
        change, rate = _trial(system, x, enough, flat)
        if change <= enough:
            return x
        if not np.isfinite(change) or x.max() > CEILING:
            return None
    return None


def _pays(M: Any, b: Floats) -> NDArray[np.bool_]:
    """Return where x > 0: the cells from which some b > 0 can be reached."""
    pays = b > 0
    before = M.T.tocsr()
    before.eliminate_zeros()
    _spread(before.indptr, before.indices, pays)
    return pays


def _soon(change: float, rate: float) -> bool:
    if not (change < np.inf and rate < 1):
        return False
    return bool(np.log(TOLERANCE / change) / np.log(max(rate, 1e-300)) < 300)


def _trial(system: System, x: Floats, enough: float, flat: float) -> tuple[float, float]:
    """Sweep; return the last relative change, and the factor by which a sweep shrinks it."""
    halfway, last = system.sweep(x, TRIAL_SWEEPS, enough, flat)
    rate = (last / halfway) ** (2 / TRIAL_SWEEPS) if 0 < halfway < np.inf else 0.0
    return last, rate


def solve_by_class(M: Any, b: Floats, stop: Stop = never) -> tuple[Floats | None, bool]:
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
        if stop():
            raise Stopped
        cells = order[until : ends[k]]
        if not _solve_class(M, b, x, cells):
            return None, True
        begun = ends[k]
    return x, True


def classes(M: Any) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the cells ordered by strongly connected class, and where each class ends.

    Every class comes after all it leads to: class k is ``order[ends[k - 1]:ends[k]]``.
    """
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(M, directed=True, connection="strong")
    rank = _topological(M.indptr, M.indices, label, count)
    lengths = np.empty(count, dtype=np.int64)
    lengths[rank] = np.bincount(label, minlength=count)
    return np.argsort(rank[label], kind="stable"), np.cumsum(lengths)


def _solve_class(M: Any, b: Floats, x: Floats, cells: NDArray[np.int64]) -> bool:
    """Solve one strongly connected class in place; False where it has no finite solution."""
    rows = M[cells]
    known = b[cells] + rows @ x
    scale = float(known.max())
    if scale == 0.0:
        return True  # nothing is paid here or after: 0, whatever the class does
    if not np.isfinite(scale):
        return False
    inner = rows[:, cells]
    known /= scale
    try:
        solver = _dense(inner) if len(cells) <= DENSE else _factors(inner)
        y = solver(known)
        y += solver(known - (y - inner @ y))
    except (RuntimeError, Warning, MemoryError, np.linalg.LinAlgError):
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

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver: Callable[[Floats], Floats] = splu(
            (eye_array(inner.shape[0], format="csr") - inner).tocsc()
        ).solve
    return solver


def _dense(inner: Any) -> Callable[[Floats], Floats]:
    system = np.eye(inner.shape[0]) - inner.toarray()
    return lambda known: np.linalg.solve(system, known)


@njit(cache=True, nogil=True)
def _split(indptr, indices, data, end, out_indices, out_data, inverse):  # type: ignore[no-untyped-def]
    for i in range(len(inverse)):
        own, used = 0.0, indptr[i]
        for e in range(indptr[i], indptr[i + 1]):
            if indices[e] == i:
                own += data[e]
            else:
                out_indices[used] = indices[e]
                out_data[used] = data[e]
                used += 1
        inverse[i] = 1.0 / (1.0 - own) if own < 1.0 else NEVER
        end[i] = used


@njit(cache=True, nogil=True)
def _gauss_seidel(begin, end, indices, data, inverse, b, x, count, enough, flat):  # type: ignore[no-untyped-def]
    """Sweep over the components, forwards and backwards in turn, using each as soon as known.

    Staying put is summed up at once, so a chain of slow cells takes one sweep in its direction.
    From x >= b + M x every sweep lowers x, from below it raises it. Returns the largest relative
    change of the sweep halfway and of the last one; ends early where that is at most ``enough``,
    where no component moved by more than ``flat`` (and calls the change 0), or where x is no longer
    finite.
    """
    halfway, change, top = np.inf, np.inf, 0.0
    for sweep in range(count):
        measured = sweep % 4 == 3 or sweep == count // 2 or sweep == count - 1
        found = _sweep(
            0, len(b), begin, end, indices, data, inverse, b, x, x, sweep % 2 == 1, measured, top
        )
        if measured:
            change, top = found[0], found[2]
            if not top < CEILING:
                return halfway, np.inf
            if sweep == count // 2:
                halfway = change
            if change <= enough:
                break
            if found[1] <= flat:
                return halfway, 0.0
    return halfway, change


@njit(cache=True, nogil=True)
def _sweep(  # type: ignore[no-untyped-def]
    first, last, begin, end, indices, data, inverse, b, old, x, backwards, measured, top
):
    """Sweep over a range: ``x`` inside it, ``old`` outside; ``top`` was the largest component.

    Returns the largest relative change, the largest absolute one, and the largest component.
    """
    floor, change, most, highest = 1e-14 * top + 1e-300, 0.0, 0.0, 0.0
    first, last = np.uint64(first), np.uint64(last)
    alone = first == np.uint64(0) and last == np.uint64(len(b))
    for t in range(last - first):
        i = last - ONE - t if backwards else first + t
        y = b[i]
        if alone:
            for e in range(begin[i], end[i]):
                y += data[e] * x[indices[e]]
        else:
            for e in range(begin[i], end[i]):
                j = indices[e]
                y += data[e] * (x[j] if first <= j < last else old[j])
        y *= inverse[i]
        if measured:
            moved = abs(y - x[i])
            if moved > change * max(y, floor):
                change = moved / max(y, floor)
            most = max(most, moved)
            highest = max(highest, y)
        x[i] = y
    return change, most, highest


def _in_halves(
    system: System, x: Floats, count: int, enough: float, flat: float
) -> tuple[float, float]:
    """Make the same sweeps in two halves at a time, each with the other's last values."""
    n = len(x)
    halves = ((0, n // 2), (n // 2, n))
    halfway, change, top = np.inf, np.inf, 0.0
    now, then = x.copy(), x

    def half(task: tuple[int, int, int, bool, float, Floats, Floats]) -> Any:
        first, last, sweep, measured, highest, old, new = task
        new[first:last] = old[first:last]
        return _sweep(
            first, last, system.begin, system.end, system.indices, system.data, system.inverse,
            system.b, old, new, sweep % 2 == 1, measured, highest,
        )  # fmt: skip

    with ThreadPoolExecutor(min(threads.count(), 2)) as pool:
        for sweep in range(count):
            measured = sweep % 4 == 3 or sweep == count // 2 or sweep == count - 1
            now, then = then, now
            tasks = [(*ends, sweep, measured, top, now, then) for ends in halves]
            found = list(pool.map(half, tasks))
            if not measured:
                continue
            change, most, top = (max(part[k] for part in found) for k in range(3))
            if not top < CEILING:
                change = np.inf
                break
            if sweep == count // 2:
                halfway = change
            if change <= enough:
                break
            if most <= flat:
                change = 0.0
                break
    x[:] = then
    return halfway, change


@njit(cache=True, nogil=True)
def _spread(indptr, indices, marked):  # type: ignore[no-untyped-def]
    """Mark everything that can reach a marked node."""
    queue = np.flatnonzero(marked)
    queue = np.append(queue, np.empty(len(marked) - len(queue), dtype=queue.dtype))
    end = marked.sum()
    start = 0
    while start < end:
        j = queue[start]
        start += 1
        for e in range(indptr[j], indptr[j + 1]):
            i = indices[e]
            if not marked[i]:
                marked[i] = True
                queue[end] = i
                end += 1


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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

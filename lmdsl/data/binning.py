"""Recorded transitions become counts: which pair was left, and into which cell."""

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput
from lmdsl.model import discretization
from lmdsl.model.grid.partition import Partition
from lmdsl.problem.problem import Problem
from lmdsl.systems.matrices.data import Recorded
from lmdsl.systems.matrices.exact import ExactShares
from lmdsl.systems.matrices.rows import GivenRows


class Recording(NamedTuple):
    """Recorded transitions: x under u led to x_next."""

    x: Floats  # shape (T, d)
    u: Floats  # shape (T, p)
    x_next: Floats  # shape (T, d); infinite where it left


class Wishes(NamedTuple):
    """How transitions are taken into the rows."""

    tolerance: float  # of a control, in parts of the distance between two values
    drop: bool  # those whose control is further away, instead of refusing
    min_count: int
    smoothing: float


def binned(
    problem: Problem, partition: Partition, given: Recording, wishes: Wishes
) -> tuple[GivenRows, Recorded]:
    """Return the rows of all pairs that were recorded often enough, and what was dropped.

    Raises
    ------
    BadInput
        A control is not on the grid, or the stage cost is none at a recorded state.
    """
    given = given._replace(x=partition.states(given.x, clip=False))
    cell = partition.locate(list(given.x.T), clip=False)
    control, off = matched(problem, given.u, wishes.tolerance)
    if off.any() and not wishes.drop:
        raise BadInput(_off_grid(problem, given.u, off, wishes.tolerance), "u")
    M, N = discretization.control_count(problem), partition.size
    inside = (cell >= 0) & ~off
    pair = cell * M + control
    _, place, count = np.unique(pair[inside], return_inverse=True, return_counts=True)
    enough = count >= wishes.min_count
    kept = np.flatnonzero(inside)[enough[place]]
    target = partition.locate(list(given.x_next[kept].T))
    rows = _rows(
        pair[kept], target, (N, M), wishes.smoothing, _costs(problem, given, kept, control)
    )
    dropped = Recorded(
        transitions=len(cell),
        used=len(kept),
        outside=int((cell < 0).sum()),
        unmatched=int(((cell >= 0) & off).sum()),
        few=int(count[~enough].sum()),
    )
    return rows, dropped


def matched(problem: Problem, u: Floats, tolerance: float) -> tuple[Indices, Bools]:
    """Return the nearest control vector of each transition, and which are too far from it."""
    index, off = np.zeros(len(u), dtype=np.int64), np.zeros(len(u), dtype=np.bool_)
    for k, values in enumerate(discretization.control_values(problem)):
        order = np.argsort(values)
        ascending = values[order]
        above = np.searchsorted(ascending, u[:, k]).clip(1, max(len(values) - 1, 1))
        above = np.minimum(above, len(values) - 1)
        below = np.maximum(above - 1, 0)
        nearer = np.abs(ascending[above] - u[:, k]) < np.abs(u[:, k] - ascending[below])
        nearest = np.where(nearer, above, below)
        off |= ~(np.abs(ascending[nearest] - u[:, k]) <= tolerance * _spacing(ascending))
        index = index * len(values) + order[nearest]
    return index, off


def _spacing(ascending: Floats) -> float:
    """Return the least distance of two values; of a single one its size."""
    if len(ascending) == 1:
        return max(1.0, abs(float(ascending[0])))
    return float(np.diff(ascending).min())


def _off_grid(problem: Problem, u: Floats, off: Bools, tolerance: float) -> str:
    first = int(np.flatnonzero(off)[0])
    said = ", ".join(f"{n} = {float(v)!r}" for n, v in zip(problem.controls, u[first], strict=True))
    return (
        f"{int(off.sum())} of {len(off)} controls are not on the grid within {tolerance:g} of the "
        f"distance between two values; the first is {said} in transition {first}: add the values, "
        'raise control_tolerance (at most 0.5), or write unmatched="drop"'
    )


def _costs(problem: Problem, given: Recording, kept: Indices, control: Indices) -> Floats:
    """Return the stage cost of transitions: at the recorded state, under the grid's control."""
    vectors = discretization.control_vectors(problem)[control[kept]]
    values = dict(zip(problem.states, given.x[kept].T, strict=True))
    values |= dict(zip(problem.controls, vectors.T, strict=True))
    with np.errstate(all="ignore"):
        (cost,) = problem.program(problem.cost())(values)
    found = np.array(np.broadcast_to(cost, len(kept)), dtype=np.float64)
    wrong = np.flatnonzero(~(np.isfinite(found) & (found >= 0)))
    if len(wrong):
        at = ", ".join(f"{name} = {float(v[wrong[0]])!r}" for name, v in values.items())
        raise BadInput(
            f"it is {float(found[wrong[0]])!r} in transition {int(kept[wrong[0]])}, {at}; it must "
            "be finite and >= 0",
            "stage_cost",
        )
    return found


def _rows(
    pair: Indices, target: Indices, sizes: tuple[int, int], smoothing: float, cost: Floats
) -> GivenRows:
    order = np.lexsort((target, pair))
    pair, target, cost = pair[order], target[order], cost[order]
    first = np.flatnonzero(_changes(pair))
    counts = np.diff(first, append=len(pair))
    entry = np.flatnonzero(_changes(pair) | _changes(target))
    start = np.searchsorted(entry, first)
    shares, total = _smoothed(np.diff(entry, append=len(pair)), start, smoothing)
    names = pair[first]
    exact = ExactShares(np.append(start, len(entry)).astype(np.int64), target[entry], shares, total)
    paid = np.add.reduceat(cost, first) / counts if len(first) else np.empty(0)
    low, high = (f.reduceat(cost, first) if len(first) else paid for f in (np.minimum, np.maximum))
    return GivenRows.of(
        *sizes, (names // sizes[1], names % sizes[1]), exact, np.clip(paid, low, high)
    )


def _changes(sorted_values: Indices) -> Bools:
    new = np.ones(len(sorted_values), dtype=np.bool_)
    new[1:] = sorted_values[1:] != sorted_values[:-1]
    return new


def _smoothed(
    counts: Indices, start: Indices, smoothing: float
) -> tuple[NDArray[np.generic], NDArray[np.generic]]:
    """Return counts plus the smoothing as integers, and their total in every row."""
    p, q = Fraction(smoothing).as_integer_ratio()
    large = max(p, q) * (len(counts) + int(counts.sum())) >= 2**62
    shares = counts.astype(object) * q + p if large else counts * q + p
    return shares, np.add.reduceat(shares, start) if len(start) else shares

"""Upper bounds of the controller's cost on finer and finer equal parts of cells.

What boxes prove is where it begins. Parts are followed for many steps, and those that were torn are
cut and followed again: the rest of a way is bounded by what is known so far.
"""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices, Progress
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline, Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.bounds.flights.following import Flights, Upper
from lmdsl.proof.bounds.optimum.averages import Arrays, volumes
from lmdsl.proof.bounds.optimum.parts import Parts, one, whole
from lmdsl.proof.loop import Loop
from lmdsl.proof.search import ARRIVES, UNDECIDED

SLACK = 2.0**-40  # by how much bounds are raised, relative: see settling.py
CLOSE = 0.05  # part of the upper bound that the lower one may lack: then it is tight enough
FEW = 2**18  # parts up to which cells are cut without a time limit
MOST = 2**26  # parts up to which they are cut at all
ROUNDS = 16  # by what is known of so many shares of the parts others are bounded in turn
SMALL = 2**17  # parts up to which it is not asked how long it takes
SWEEPS = 8  # times that the same parts are followed at most
HELPED = 1.01  # by how much that must make bounds better to be done again
BYTES = 24  # of a part, with all that is held meanwhile
DEEPEST = 20  # bisections of an axis


class Above(NamedTuple):
    """An upper bound of the cost of runs that arrive.

    Attributes
    ----------
    split
        Cells are cut into 2^``split`` equal parts by axis, shape (d,).
    bound
        By part, in C order: infinite where nothing is known, -infinite where nothing arrives.
    """

    split: NDArray[np.uint8]
    bound: Upper


def refine(
    flights: Flights, boxes: Arrays, deadline: Deadline, progress: Progress | None
) -> Above | None:
    """Return bounds on parts as fine as time and memory allow; None where there is no time."""
    loop = flights.loop
    found, todo, last = None, np.ones(0, dtype=np.bool_), 0.0
    split = np.zeros(loop.partition.dimension, dtype=np.int64)
    while True:
        parts, began = Parts.of(loop.partition, split), time.monotonic()
        if found is not None and not _fits(parts, deadline, last):
            return found
        known = begun(flights, boxes, parts)
        some = np.arange(parts.size)
        if found is not None:
            np.minimum(known, carried(loop, found, parts), out=known)
            some = finer(loop, parts, todo)
        torn = _swept(flights, parts, known, some, deadline)
        found, last = Above(split.astype(np.uint8), known), time.monotonic() - began
        if progress is not None:
            progress("refine", -1.0)
        if torn is None or not torn.any() or (split >= DEEPEST).any():
            return found
        split, todo = split + 1, torn


def _swept(
    flights: Flights, parts: Parts, known: Upper, some: Indices, deadline: Deadline
) -> Bools | None:
    """Follow parts, and those that are torn again, by what is known of others now, while it helps.

    Return which are torn still; None where time was up.
    """
    torn, before = None, _good(known)
    for _ in range(SWEEPS):
        try:
            torn = _improved(flights, parts, known, some, deadline)
        except Stopped:
            return None
        now, some = _good(known), np.flatnonzero(torn)
        if not now > HELPED * before:
            break
        before = now
    return torn


def _good(known: Upper) -> float:
    """Return how good bounds are: the mean of 1/(1 + bound), 0 where nothing is known."""
    with np.errstate(divide="ignore", over="ignore"):
        finite = known[known > -np.inf]
        return float((1.0 / (1.0 + np.abs(finite))).mean(dtype=np.float64)) if len(finite) else 0.0


def close(boxes: Arrays) -> bool:
    """Return whether the bounds of boxes are close, or there is nothing to bound."""
    arrives = boxes["class"] == ARRIVES
    weight = volumes(boxes["split"][arrives])
    low, high = ((boxes[name][arrives] * weight).sum() for name in ("lower", "cost"))
    return bool(not arrives.any() or high - low <= CLOSE * abs(high))


def _fits(parts: Parts, deadline: Deadline, last: float) -> bool:
    """Return whether there is time and memory for so many parts."""
    left, more = deadline.left, 2.0 ** (len(parts.shape) - 1)
    if left is None:
        return parts.size <= FEW
    if parts.size <= SMALL:  # what was last also compiled kernels
        return not deadline()
    fits = parts.size <= MOST and memory.fits(float(BYTES) * parts.size)
    return fits and left > 0.5 * more * last


def _improved(
    flights: Flights, parts: Parts, known: Upper, some: Indices, deadline: Deadline
) -> Bools:
    """Follow some parts; return which are torn still."""
    cell = parts.cell(flights.loop.partition, some)
    some = some[(flights.loop.status[cell] == CellStatus.STABILIZED) & (known[some] > -np.inf)]
    some = some[np.argsort(known[some], kind="stable")]
    torn = np.zeros(parts.size, dtype=np.bool_)
    size = max(len(some) // ROUNDS, 2**14)
    for start in range(0, len(some), size):
        if deadline():
            raise Stopped
        at = some[start : start + size]
        bound, whole = flights.bounds(parts, at, known, parts)
        known[at] = np.minimum(known[at], rounded(bound))
        torn[at[~whole]] = True
    return torn


def rounded(x: Floats) -> Upper:
    """Return numbers in single precision, no smaller."""
    with np.errstate(over="ignore"):
        near = x.astype(np.float32)
    return np.where(near < x, np.nextafter(near, np.float32(np.inf)), near)


def begun(flights: Flights, boxes: Arrays, parts: Parts) -> Upper:
    """Return what boxes prove of parts: the largest bound of those that meet it and may arrive."""
    loop = flights.loop
    known = np.full(parts.size, -np.inf, dtype=np.float32)
    targets = np.flatnonzero(loop.status == CellStatus.ATTRACTOR)
    cells = np.concatenate([boxes["cell"], targets])
    zeros = np.zeros((len(targets), parts.split.shape[0]), dtype=np.int64)
    split, place = (np.concatenate([boxes[n].astype(np.int64), zeros]) for n in ("split", "place"))
    cost = np.where(boxes["class"] == UNDECIDED, np.inf, -np.inf)
    cost = np.where(boxes["class"] == ARRIVES, boxes["cost"], cost)
    cost = np.concatenate([cost, flights.entry[targets]])
    index = np.stack(loop.partition.multi_index(cells), axis=-1)
    _begin(split, index, place, rounded(cost), (parts.split, parts.stride), known)
    return known


@kernel
def _begin(split, index, place, cost, grid, known):  # type: ignore[no-untyped-def]
    for b in range(len(split)):
        first, count = whole(grid, split, place, index, b)
        for j in range(count):
            at = one(grid, split, b, first, j)
            known[at] = max(known[at], cost[b])


def carried(loop: Loop, found: Above, parts: Parts) -> Upper:
    """Return what is known of larger parts, on smaller ones."""
    return spread(loop, found.bound, found.split.astype(np.int64), parts)


def spread(loop: Loop, values: NDArray[Any], split: Indices, parts: Parts) -> NDArray[Any]:
    """Return values by larger parts, by smaller ones."""
    shape = loop.partition.cells.astype(np.int64) << split
    found = values.reshape(tuple(shape))
    for k, more in enumerate((parts.split - split).tolist()):
        found = np.repeat(found, 1 << more, axis=k)
    return np.ascontiguousarray(found).ravel()


def finer(loop: Loop, parts: Parts, todo: Bools) -> Indices:
    """Return the smaller parts of larger ones that are one bisection an axis larger."""
    return np.flatnonzero(spread(loop, todo, parts.split - 1, parts))

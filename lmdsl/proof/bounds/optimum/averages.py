"""Averages by volume over boxes, and what a bound and a proof say together."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.partition import Partition
from lmdsl.proof.bounds.optimum.bracket import Optimum
from lmdsl.proof.bounds.optimum.parts import Parts, one, whole
from lmdsl.proof.loop import Loop

Arrays = dict[str, NDArray[Any]]
Split = NDArray[np.uint8]


class Bracket(NamedTuple):
    """What is said of the least cost of any law; see :class:`lmdsl.proof.record.Proof`."""

    optimum: tuple[float, float] | None = None
    nonnegative: bool | None = None
    bound: Optimum | None = None
    maps: tuple[Floats, Floats] | None = None

    @classmethod
    def of(cls, boxes: Arrays, cost: Floats, loop: Loop, bound: Optimum) -> "Bracket":
        """Return what a bound says of boxes that arrive, of which upper bounds are known."""
        weight = volumes(boxes["split"])
        below = means(bound.split, bound.bound, loop.partition, boxes)
        N = loop.partition.size
        maps = tuple(_by_cell(boxes["cell"], x, weight, N) for x in (below, cost))
        ends = (mean(below, weight), mean(cost, weight)) if len(weight) else None
        return cls(ends, bound.nonnegative, bound, (maps[0], maps[1]))


def _by_cell(cell: Indices, x: Floats, weight: Floats, N: int) -> Floats:
    with np.errstate(invalid="ignore"):
        total = np.bincount(cell, weights=x * weight, minlength=N)
        return np.asarray(total / np.bincount(cell, weights=weight, minlength=N))


def volumes(split: NDArray[np.uint8]) -> Floats:
    """Return the volumes of boxes, in cells."""
    return np.asarray(2.0 ** -split.sum(axis=1, dtype=np.float64))


def mean(x: Floats, weight: Floats) -> float:
    """Return a weighted mean, correctly rounded; infinite where a number is."""
    if not np.isfinite(x).all():
        return float(np.where(np.isfinite(x), 0.0, x).sum())
    return math.fsum(x * weight) / math.fsum(weight)


def means(split: Split, bound: NDArray[Any], partition: Partition, boxes: Arrays) -> Floats:
    """Return the means over boxes of a bound on 2^``split`` equal parts of cells, shape (B,)."""
    parts = Parts.of(partition, split.astype(np.int64))
    index = np.stack(partition.multi_index(boxes["cell"]), axis=-1)
    found = np.zeros(len(index))
    _means(bound, (parts.split, parts.stride), index, boxes["split"], boxes["place"], found)
    return found


@kernel
def _means(bound, grid, index, split, place, found):  # type: ignore[no-untyped-def]
    for b in range(len(found)):
        first, count = whole(grid, split, place, index, b)
        total = 0.0
        for j in range(count):
            total += bound[one(grid, split, b, first, j)]
        found[b] = total / count

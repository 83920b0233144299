"""From a closed loop to a lower bound of the cost of every control law, on finer and finer parts."""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Progress
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline, Stopped
from lmdsl.machine.kernels import kernel
from lmdsl.proof.loop import Loop
from lmdsl.proof.optimum.bounding import SLACK, Sweep, consistent, prepared, settle
from lmdsl.proof.optimum.moves import DEEPEST, Game, Grid, Moves

FEW = 2**22  # rows up to which cells are cut without a time limit
BEYOND = 2.0  # by how much bounds are larger than any upper bound of which they are the other end
GROWS = 1.5  # by how much more the time grows than the rows
Cut = NDArray[np.uint8]


class Optimum(NamedTuple):
    """A lower bound of the cost of every law.

    Attributes
    ----------
    split
        Cells are cut into 2^``split`` equal parts by axis, shape (d,).
    bound
        By part, in C order: at least what any law costs from there; infinite in ``avoid``.
    """

    split: Cut
    bound: Floats


def bound(
    loop: Loop, most: float, deadline: Deadline, progress: Progress | None, slack: float
) -> Optimum:
    """Return the best bound that the time allows.

    ``most`` is the largest value of use, ``slack`` by how much images are widened, in cells.
    """
    game, d = loop.game(slack), loop.partition.dimension
    split = np.zeros(d, dtype=np.int64)
    grid = Grid.of(loop.partition, split)
    known = Optimum(split.astype(np.uint8), ends(game, grid))
    order = np.arange(grid.size)
    while True:
        began = time.monotonic()
        W = _bounded(game, grid, (known, order), most, deadline)
        if W is None:
            return known
        known = Optimum(grid.split.astype(np.uint8), W)
        if progress is not None:
            progress("bound", -1.0)
        growth = _room(game, grid, time.monotonic() - began, deadline)
        if growth < 1:
            return known
        finer = grid.split.copy()
        finer[np.argsort(finer, kind="stable")[:growth]] += 1
        grid = Grid.of(loop.partition, finer)
        order = np.argsort(carried(loop, known, grid), kind="stable")


def _room(game: Game, grid: Grid, taken: float, deadline: Deadline) -> int:
    """Return how many axes can be cut once more in the time and the memory that are left."""
    rows = grid.size * len(game.control) * len(game.weight)
    for axes in range(len(grid.split), 0, -1):
        parts = 2**axes
        late = deadline.left is not None and GROWS * parts * taken > deadline.left
        many = deadline.left is None and parts * rows > FEW
        large = parts * grid.size >= 2**31 or not memory.fits(3.0 * game.row_bytes() * parts * rows)
        if not (late or many or large) and (grid.split < DEEPEST).all():
            return axes
    return 0


def _bounded(
    game: Game, grid: Grid, start: tuple[Optimum, Indices], most: float, deadline: Deadline
) -> Floats | None:
    """Return a bound on the parts of a grid; None where the time or the memory was too short."""

    def guard() -> None:
        if deadline():
            raise Stopped

    known, order = start
    above = len(game.weight) == 1 and game.factor >= 1.0
    try:
        moves = game.moves(grid, guard)
        sweep = prepared(game, grid, moves, most, SLACK)
        W = ends(game, grid)
        W[sweep.free] = most if above else carried(game, known, grid)[sweep.free]
        try:
            settle(sweep, W, order, guard, above)
        except Stopped:
            if above:
                return None
    except (Stopped, BadInput):
        return None
    return W if consistent(sweep, W, order) else None


def ends(game: Game, grid: Grid) -> Floats:
    """Return what is known of parts by their cells: of A its entry, of Z infinity, else 0."""
    cell = grid.cell(game.partition, np.arange(grid.size))
    W = np.where(game.avoided, np.inf, 0.0)[cell]
    entry = game.entry[cell]
    return np.where(np.isfinite(entry), entry * (1.0 - SLACK), W)


def carried(of: Loop | Game, known: Optimum, grid: Grid) -> Floats:
    """Return a bound on finer parts."""
    old = Grid.of(of.partition, known.split.astype(np.int64))
    index = grid.index(np.arange(grid.size)) >> (grid.split - old.split)
    return np.asarray(known.bound[(index * old.stride).sum(axis=1)])


def means(optimum: Optimum, loop: Loop, boxes: dict[str, NDArray[np.generic]]) -> Floats:
    """Return the mean of a bound over each of some boxes: arrays of a proof, shape (B,)."""
    grid = Grid.of(loop.partition, optimum.split.astype(np.int64))
    index = np.stack(loop.partition.multi_index(boxes["cell"]), axis=-1)
    found = np.zeros(len(index))
    _means(optimum.bound, (grid.split, grid.stride), index, boxes["split"], boxes["place"], found)
    return found


@kernel
def _means(bound, grid, index, split, place, found):  # type: ignore[no-untyped-def]
    fine, stride = grid
    d = len(fine)
    for b in range(len(found)):
        count, first = 1, np.int64(0)
        for k in range(d):
            s, p = np.int64(split[b, k]), np.int64(place[b, k])
            less = fine[k] - s
            at = p >> -less if less < 0 else p << less
            first += ((index[b, k] << fine[k]) + at) * stride[k]
            count *= np.int64(1) << max(less, 0)
        total = 0.0
        for j in range(count):
            rest, at = np.int64(j), first
            for k in range(d - 1, -1, -1):
                less = max(fine[k] - np.int64(split[b, k]), 0)
                at += (rest & ((np.int64(1) << less) - 1)) * stride[k]
                rest >>= less
            total += bound[at]
        found[b] = total / count

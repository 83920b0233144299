"""From a closed loop to a lower bound of the cost of every law, on finer and finer parts."""

import time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Progress
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline, Stopped
from lmdsl.proof.bounds.optimum.bounding import SLACK, consistent, prepared, settle
from lmdsl.proof.bounds.optimum.moves import DEEPEST, Game
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.proof.loop import Loop

FEW = 2**22  # rows up to which cells are cut without a time limit
SMALL = 2**19  # rows up to which it is not asked how long they take
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
    nonnegative
        Whether costs are proved not to be negative, which else is assumed.
    """

    split: Cut
    bound: Floats
    nonnegative: bool


def bound(
    loop: Loop, most: float, order: Indices, deadline: Deadline, progress: Progress | None,
    slack: float,
) -> Optimum:  # fmt: skip
    """Return the best bound that the time allows.

    ``most`` is the largest value of use, ``slack`` by how much images are widened, in cells, and
    ``order`` that in which cells are best looked at.
    """
    game, d = loop.game(slack), loop.partition.dimension
    split = np.zeros(d, dtype=np.int64)
    grid = Parts.of(loop.partition, split)
    known = Optimum(split.astype(np.uint8), ends(game, grid), not game.negative)
    while True:
        began = time.monotonic()
        W = _bounded(game, grid, (known, order), most, deadline)
        if W is None:
            return known
        known = Optimum(grid.split.astype(np.uint8), W, not game.negative)
        if progress is not None:
            progress("bound", -1.0)
        growth = _room(game, grid, time.monotonic() - began, deadline)
        if growth < 1:
            return known
        finer = grid.split.copy()
        finer[np.argsort(finer, kind="stable")[:growth]] += 1
        grid = Parts.of(loop.partition, finer)
        order = np.argsort(carried(loop, known, grid), kind="stable")


def _room(game: Game, grid: Parts, taken: float, deadline: Deadline) -> int:
    """Return how many axes can be cut once more in the time and the memory that are left."""
    rows = grid.size * len(game.control) * len(game.weight)
    for axes in range(len(grid.split), 0, -1):
        parts = 2**axes
        late = deadline.left is not None and GROWS * parts * taken > deadline.left
        late &= parts * rows > SMALL or deadline()  # what was taken also compiled kernels
        many = deadline.left is None and parts * rows > FEW
        large = parts * grid.size >= 2**31 or not memory.fits(3.0 * game.row_bytes() * parts * rows)
        if not (late or many or large) and (grid.split < DEEPEST).all():
            return axes
    return 0


def _bounded(
    game: Game, grid: Parts, start: tuple[Optimum, Indices], most: float, deadline: Deadline
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
            if not settle(sweep, W, order, guard, above):
                return None
        except Stopped:
            if above:
                return None
    except (Stopped, BadInput):
        return None
    return W if consistent(sweep, W, order) else None


def ends(game: Game, grid: Parts) -> Floats:
    """Return what is known of parts by their cells: of A its entry, of Z infinity, else 0."""
    cell = grid.cell(game.partition, np.arange(grid.size))
    W = np.where(game.avoided, np.inf, 0.0)[cell]
    entry = game.entry[cell]
    return np.where(np.isfinite(entry), entry * (1.0 - SLACK), W)


def carried(of: Loop | Game, known: Optimum, grid: Parts) -> Floats:
    """Return a bound on finer parts."""
    old = Parts.of(of.partition, known.split.astype(np.int64))
    index = grid.by_axis(np.arange(grid.size)) >> (grid.split - old.split)
    return np.asarray(known.bound[(index * old.stride).sum(axis=1)])

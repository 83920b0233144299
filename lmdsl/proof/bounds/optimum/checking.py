"""Checking a lower bound of what any law costs, part by part; see bounding.py.

Nothing of how it was found is used: W <= T W, and W at most what is paid on entering on A, make it
a bound (docs/mathematics.md). Images and costs are enclosed anew.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Guard
from lmdsl.model.grid.boxes import named
from lmdsl.proof.bounds.optimum.averages import Arrays
from lmdsl.proof.bounds.optimum.bounding import prepared, violated
from lmdsl.proof.bounds.optimum.bracket import Optimum
from lmdsl.proof.bounds.optimum.moves import DEEPEST, Game
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.proof.loop import Loop


def checked(loop: Loop, arrays: Arrays, guard: Guard) -> tuple[Optimum | None, list[str]]:
    """Return the bound among the arrays of a proof, and what does not hold of it; a few sentences.

    The bound is None where it is no bound at all.
    """
    split, W = arrays["optimum_split"], arrays["optimum"]
    small = bool((split <= DEEPEST).all())
    grid = Parts.of(loop.partition, split.astype(np.int64)) if small else None
    if grid is None or grid.size != len(W):
        return None, ["proof.npz: optimum_split does not fit the number of parts in optimum"]
    game = loop.game()
    cell = grid.cell(loop.partition, np.arange(grid.size))
    if not _sound(game, W, game.avoided[cell], game.entry[cell]):
        return None, ["proof.npz: optimum has a number that is no bound of a cost"]
    moves = game.moves(grid, guard)
    sweep = prepared(game, grid, moves, np.inf, 0.0)
    fault = np.zeros(grid.size, dtype=np.bool_)
    violated(sweep, W, float(W.min(initial=np.inf)), fault)
    wrong = [
        f"proof.npz: optimum says that every law costs at least {float(W[i])!r} from part {i}, in "
        f"{named(loop.partition, int(cell[i]))}, but one may cost less"
        for i in np.flatnonzero(fault)[:3]
    ]
    return Optimum(split, W, not game.negative), wrong


def _sound(game: Game, W: Floats, avoided: NDArray[Any], entry: Floats) -> bool:
    """Return whether numbers may be bounds: finite outside Z, on A at most what entering costs."""
    free = ~avoided
    inside = np.isfinite(entry)
    return bool(
        (W >= 0.0).all() and np.isfinite(W[free]).all() and (W[inside] <= entry[inside]).all()
    )

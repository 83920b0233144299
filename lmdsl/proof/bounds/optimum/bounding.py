"""The fixed point that bounds the cost of every law from below; compiled.

T W(b) = min over controls of [cost + factor times the sum over parts of the noise of weight times
the least W that is met]. What is found satisfies W <= T W (docs/mathematics.md).
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.machine import threads
from lmdsl.machine.kernels import kernel
from lmdsl.proof.bounds.optimum.moves import Game, Moves
from lmdsl.proof.bounds.optimum.parts import Parts

SLACK = 2.0**-40  # by how much bounds are lowered, relative: see settling.py
MOST_MET = 2**16  # parts above which a range counts as all parts
CLOSE = 1e-4  # relative rise a sweep below which a bound from below is good enough
# Sweeps at most: from below each is a bound, and small costs make it rise slowly.
FROM_BELOW, FROM_ABOVE = 500, 10_000
SWEEPS = 30  # after which a bound that has to be lowered still is given up
AT_A_TIME = 2**12  # parts that a thread sweeps at a time


class Sweep(NamedTuple):
    """What a sweep needs.

    Attributes
    ----------
    shape, stride
        Parts by axis, and what they count, shape (d,).
    weight
        Of the parts of the noise, shape (R,).
    free
        By part: whether a control is chosen there.
    numbers
        What a later cost counts; relative slack; the least that is paid on entering the attractor;
        the largest bound of use.
    """

    moves: Moves
    shape: Indices
    stride: Indices
    weight: Floats
    free: Bools
    numbers: tuple[float, float, float, float]


def rounding(parts: int) -> float:
    """Return by how much sums over parts of the noise round at most, relative, generously."""
    return (parts + 8) * 2.0**-52


def prepared(game: Game, grid: Parts, moves: Moves, most: float, slack: float) -> Sweep:
    """Return what sweeps of a grid need."""
    cell = grid.cell(game.partition, np.arange(grid.size))
    free = ~np.isfinite(game.entry[cell]) & ~game.avoided[cell]
    least = float(game.entry.min(initial=np.inf))
    slack += rounding(len(game.weight))
    return Sweep(
        moves, grid.shape, grid.stride, game.weight, free, (game.factor, slack, least, most)
    )


def settle(sweep: Sweep, W: Floats, order: Indices, guard: Guard, above: bool) -> bool:
    """Sweep until nothing changes, or nearly so; return whether W <= T W then.

    From ``above`` it is only in the end; from below it always is.
    """
    step = -1 if above else 1
    free = order[sweep.free[order]]
    for _ in range(FROM_ABOVE if above else FROM_BELOW):
        guard()
        parts = [free[i : i + AT_A_TIME] for i in range(0, len(free), AT_A_TIME)]
        one = partial(lower, sweep, W, float(W.min(initial=np.inf)), step)
        change = threads.each(one, parts)
        if max(change, default=0.0) <= (0.0 if above else CLOSE):
            return True
    return not above


def consistent(sweep: Sweep, W: Floats, order: Indices) -> bool:
    """Lower W where it exceeds T W, as it may where finer parts are enclosed worse.

    Return whether W <= T W then.
    """
    free = order[sweep.free[order]]
    for _ in range(SWEEPS):
        if lower(sweep, W, float(W.min(initial=np.inf)), -1, free) == 0.0:
            return True
    return False


@kernel
def lower(sweep, W, lowest, way, parts):  # type: ignore[no-untyped-def]
    """Replace W by T W on parts where that is lower (way -1) or higher (1).

    Return the largest relative change. ``lowest`` is at most all of W.
    """
    most, change = sweep.numbers[3], 0.0
    for j in range(len(parts)):
        b = parts[j]
        new, old = min(best(sweep, b, W, lowest), most), W[b]
        if way * (new - old) > 0.0:
            W[b] = new
            change = max(change, abs(new - old) / max(new, 1e-300))
    return change


@kernel
def violated(sweep, W, lowest, fault):  # type: ignore[no-untyped-def]
    """Note on which parts W exceeds T W."""
    for b in range(len(W)):
        if sweep.free[b]:
            fault[b] = not W[b] <= best(sweep, b, W, lowest)


@kernel
def best(sweep, b, W, lowest):  # type: ignore[no-untyped-def]
    """Return T W on a part, rounded down."""
    factor, slack, entry, _ = sweep.numbers
    moves, R = sweep.moves, len(sweep.weight)
    each = len(moves.cost) // len(moves.seam)
    found, piece = np.inf, b
    while piece >= 0:
        for row in range(piece * each, (piece + 1) * each, R):
            total = 0.0
            for w in range(R):
                cost, weight = moves.cost[row + w], sweep.weight[w]
                if not total + weight * cost < found:
                    total = np.inf
                    break
                met = least(W, moves.span[row + w], sweep.shape, sweep.stride, lowest)
                if moves.enters[row + w]:
                    met = min(met, entry)
                total += weight * (cost + factor * met)
            found = min(found, total)
        piece = moves.seam[piece]
    return found * (1.0 - slack) if found < np.inf else found


@kernel
def least(W, span, shape, stride, lowest):  # type: ignore[no-untyped-def]
    """Return the least W in a range of parts, infinite where there is none."""
    d, count = len(shape), 1
    for k in range(d):
        count *= max(np.int64(span[k, 1]) - span[k, 0] + 1, 0)
        if count > MOST_MET:
            return lowest
    found, last = np.inf, d - 1
    if count == 0:
        return found
    wide = np.int64(span[last, 1]) - span[last, 0] + 1
    first = np.int64(span[last, 0]) % shape[last]
    for j in range(count // wide):
        rest, at = j, np.int64(0)
        for k in range(last - 1, -1, -1):
            size = np.int64(span[k, 1]) - span[k, 0] + 1
            at += (span[k, 0] + rest % size) % shape[k] * stride[k]
            rest //= size
        i = first
        for _ in range(wide):
            found = min(found, W[at + i])
            i = i + 1 if i + 1 < shape[last] else 0
    return found

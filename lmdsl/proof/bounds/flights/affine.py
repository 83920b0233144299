"""Sets that are followed: images of a box under linear maps, and a remainder.

x = c + A xi + e eta, all of xi and eta in [-1, 1]: unlike boxes these turn and shear as the map
does, so that many steps widen them by little more than the map itself does.
"""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.machine.kernels import kernel

ROUNDS = 2.0**-47  # of all terms of a sum: more than what rounds in it
LEAST = 2.0**-1000


class Sets(NamedTuple):
    """Sets and boxes around them.

    Attributes
    ----------
    c, A, e
        Shapes (B, d), (B, d, d) and (B, d).
    low, high
        Ends of boxes that hold them, shape (B, d); those may cut parts off, which no image reaches.
    """

    c: Floats
    A: Floats
    e: Floats
    low: Floats
    high: Floats


def boxed(low: Floats, high: Floats) -> Sets:
    """Return boxes as sets."""
    count, d = low.shape
    found = Sets(np.empty((count, d)), np.zeros((count, d, d)), np.empty((count, d)), low, high)
    box(found)
    return found


@kernel
def box(sets):  # type: ignore[no-untyped-def]
    """Make sets of their boxes."""
    for i in range(len(sets.c)):
        _box(sets, i)


@kernel
def _box(sets, i):  # type: ignore[no-untyped-def]
    d = sets.c.shape[1]
    for k in range(d):
        low, high = sets.low[i, k], sets.high[i, k]
        c = 0.5 * low + 0.5 * high
        sets.c[i, k] = c
        for j in range(d):
            sets.A[i, k, j] = max(high - c, c - low) if j == k else 0.0
        sets.e[i, k] = (abs(c) + abs(high - low)) * ROUNDS + LEAST


@kernel
def advance(sets, found, room):  # type: ignore[no-untyped-def]
    """Replace sets by what holds their images, enclosed with slopes; ``room`` is (4 + d, d)."""
    d = sets.c.shape[1]
    for i in range(len(sets.c)):
        sound = _turn(sets, found, room, i)
        for k in range(d):
            low, high = found.low[i, k], found.high[i, k]
            if sound:
                reach = sets.e[i, k]
                for j in range(d):
                    reach += abs(sets.A[i, k, j])
                reach += (reach + abs(sets.c[i, k])) * ROUNDS
                low, high = max(low, sets.c[i, k] - reach), min(high, sets.c[i, k] + reach)
            sets.low[i, k], sets.high[i, k] = low, max(low, high)
        if not sound:
            _box(sets, i)


@kernel
def _turn(sets, found, room, i):  # type: ignore[no-untyped-def]
    """Do so with one set but for its box; return False where it may not be finite."""
    d = sets.c.shape[1]
    away, side, c, e, A = room[0], room[1], room[2], room[3], room[4:]
    for k in range(d):
        low, high = sets.low[i, k], sets.high[i, k]
        middle = 0.5 * low + 0.5 * high
        middle = low if middle < low else high if middle > high else middle
        away[k], side[k] = sets.c[i, k] - middle, sets.e[i, k]
        for j in range(d):
            side[k] += abs(sets.A[i, k, j])
    total = 0.0
    for k in range(d):
        low, high = found.middle[i, k, 0], found.middle[i, k, 1]
        c[k] = 0.5 * low + 0.5 * high
        size = abs(low) + abs(high)
        e[k] = high - c[k]
        for j in range(d):
            A[k, j] = 0.0
        for l in range(d):  # noqa: E741
            a, b = found.slope[i, k, l, 0], found.slope[i, k, l, 1]
            m = 0.5 * a + 0.5 * b
            r = b - m + (abs(a) + abs(b)) * ROUNDS
            c[k] += m * away[l]
            e[k] += r * (abs(away[l]) + side[l]) + abs(m) * sets.e[i, l]
            size += (abs(m) + r) * (abs(away[l]) + side[l] + abs(sets.c[i, l]))
            for j in range(d):
                A[k, j] += m * sets.A[i, l, j]
        e[k] += size * ROUNDS + LEAST
        total += e[k] + abs(c[k]) + size
    if not total < np.inf:
        return False
    for k in range(d):
        sets.c[i, k], sets.e[i, k] = c[k], e[k]
        for j in range(d):
            sets.A[i, k, j] = A[k, j]
    return True

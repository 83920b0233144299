"""How near something else than a free cell may be: where a path need not be looked at."""

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools

FAR = 8  # number of cells above which distances from what decides a path are not told apart


def free_room(free: Bools, periodic: Bools) -> NDArray[np.uint8]:
    """Return how near, in cells, something else than a free cell may be to each cell, at most FAR.

    Where it is r, the cells less than r away on every axis are free.
    """
    room = np.zeros(free.shape, dtype=np.uint8)
    inside = free
    for _ in range(FAR):
        room += inside
        for k in range(free.ndim):
            lines = np.moveaxis(inside, k, 0)
            first, last = (lines[:1], lines[-1:]) if periodic[k] else (False & lines[:1],) * 2
            before, after = np.concatenate([last, lines[:-1]]), np.concatenate([lines[1:], first])
            inside = np.moveaxis(lines & before & after, 0, k)
    return room.ravel()

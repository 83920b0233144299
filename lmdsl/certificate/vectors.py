"""Vectors over C as compiled loops read them, and work split over ranges of its cells."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.machine import threads
from lmdsl.model.lp import StabilizationLP

T = TypeVar("T")

# Number of transitions above which another range of cells, and thread, is worth it.
TRANSITIONS_A_RANGE = 500_000


def padded(lp: StabilizationLP, V: Floats) -> Floats:
    """Append the attractor's 0, before it the values of ghosts where cells are spread over ranks.

    Then it is collective: all ranks ask for it, the same number of times.
    """
    x = np.asarray(V, dtype=np.float64)
    return np.append(x, 0.0) if lp.mesh is None else lp.mesh.spread(x)


def over_cells(
    lp: StabilizationLP, loop: Callable[..., T], *arguments: Any, most: int = 16
) -> list[T]:
    """Call ``loop(first, last, *arguments)`` on ranges of cells that cover C, in threads or not.

    The ranges, ``most`` at most, do not depend on the number of threads; nor do the results. Over
    ranks they are those of the model.
    """
    if lp.mesh is not None:
        first, _ = lp.mesh.division.own(lp.mesh.ranks.rank)
        own = lp.mesh.division.own_ranges(lp.mesh.ranks.rank)
        return threads.each(
            lambda cells: loop(*cells, *arguments), [(a - first, b - first) for a, b in own]
        )
    count = max(1, min(len(lp.rows.target) // TRANSITIONS_A_RANGE, most, lp.n))
    return threads.each(lambda cells: loop(*cells, *arguments), threads.ranges(lp.n, count))

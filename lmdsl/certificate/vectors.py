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


def padded(V: Floats) -> Floats:
    """Append the attractor's 0."""
    return np.append(np.asarray(V, dtype=np.float64), 0.0)


def over_cells(
    lp: StabilizationLP, loop: Callable[..., T], *arguments: Any, most: int = 16
) -> list[T]:
    """Call ``loop(first, last, *arguments)`` on ranges of cells that cover C, in threads or not.

    The ranges, ``most`` at most, do not depend on the number of threads; nor do the results.
    """
    count = max(1, min(len(lp.rows.target) // TRANSITIONS_A_RANGE, most, lp.n))
    return threads.each(lambda cells: loop(*cells, *arguments), threads.ranges(lp.n, count))

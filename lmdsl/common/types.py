"""Names of types for every package: arrays by what they hold, and callables of the caller's."""

import os
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]  # whole numbers, such as cells, positions or columns
Statuses = NDArray[np.uint8]  # codes of ``CellStatus``, by cell
Policy = NDArray[np.int64]  # a column per position of C, shape (n,)

FilePath = str | os.PathLike[str]

TimeUp = Callable[[], bool]  # asked now and then by what takes long: True ends the work early
# Told what is being done, and which part of it, 0 to 1, is done.
Progress = Callable[[str, float], None]


def never() -> bool:
    """Return False: nothing ends the work early."""
    return False


Guard = Callable[[], object]  # asked during long evaluations whether to go on; it raises if not


def told(progress: Progress | bool | None) -> Progress | None:
    """Return whom to tell, once True stands for a line on stderr (see ``own_arithmetic``)."""
    return progress if callable(progress) else None

"""What the caller's settings of NumPy must not change: whether and how lmdsl computes."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

from lmdsl.errors import BadInput, shown

_P = ParamSpec("_P")
_R = TypeVar("_R")


def own_arithmetic(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Run a public function with NumPy's default handling of overflow, underflow and the like.

    Under the caller's ``np.errstate(under="raise")`` a correct rounding to zero would be an error.
    """

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        progress = kwargs.get("progress")
        if progress is not None and not callable(progress):
            raise BadInput(f"{shown(progress)} is not a function", "progress")
        with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):
            return function(*args, **kwargs)

    return run

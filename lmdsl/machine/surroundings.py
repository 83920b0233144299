"""What callers and solvers must not change: whether and how lmdsl computes."""

import contextlib
import ctypes
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import numpy as np

from lmdsl.errors import BadInput, LmdslError, shown

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


def restore_rounding(who: str) -> None:
    """Let the processor round to nearest, and keep tiny numbers, again; LmdslError if it does not.

    Libraries built for speed set it to lose denormal numbers when they are loaded, others to round
    in one direction; no bound would hold then.
    """
    if _rounds_to_nearest():
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libm.so.6").fesetenv(ctypes.c_void_p(-1))  # FE_DFL_ENV of Linux
    if not _rounds_to_nearest():
        raise LmdslError(f"{who} changed how this processor rounds; nothing can be proved now")


def _rounds_to_nearest(one: float = 1.0, half: float = 2.0**-53, least: float = 5e-324) -> bool:
    up, even, down = one + 1.5 * half, one + half, -one - half
    return up == 1 + 2.0**-52 and even == 1.0 and down == -1.0 and one * least > 0

"""What callers and solvers must not change: whether and how lmdsl computes."""

import contextlib
import ctypes
import inspect
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from lmdsl.errors import BadInput, LmdslError, shown
from lmdsl.machine.progress import followed

_P = ParamSpec("_P")
_R = TypeVar("_R")


def own_arithmetic(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Run a public function with NumPy's default handling of overflow, underflow and the like.

    Under the caller's ``np.errstate(under="raise")`` a correct rounding to zero would be an error.
    Its argument ``progress`` may be True: then a line on stderr shows it.
    """
    signature = inspect.signature(function)
    tells = "progress" in signature.parameters

    @wraps(function)
    def run(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"):
            if not tells:
                return function(*args, **kwargs)
            with _told(signature, args, kwargs) as (own, named):
                return function(*own, **named)

    return run


@contextlib.contextmanager
def _told(signature: inspect.Signature, args: Any, kwargs: Any) -> Iterator[tuple[Any, Any]]:
    """Give the arguments of a call, with somebody to tell its progress where that is asked for."""
    try:
        bound = signature.bind(*args, **kwargs)
    except TypeError:  # the function says so itself
        yield args, kwargs
        return
    progress = bound.arguments.get("progress")
    if progress is True:
        with followed() as bound.arguments["progress"]:
            yield bound.args, bound.kwargs
        return
    if progress is False:
        bound.arguments["progress"] = None
    elif progress is not None and not callable(progress):
        raise BadInput(f"{shown(progress)} is not a function, nor True", "progress")
    yield bound.args, bound.kwargs


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

"""Calls of native solvers in a process of their own, which can be ended.

A solver looks at the clock, and Python at Ctrl-C, only where native code lets them: a factorisation
may take minutes. What is large, or has a time limit, is therefore done by a child: it gets the
arguments through a pipe, and is killed a moment after the deadline, or when the caller is
interrupted. The child imports no more than the function asks for.
"""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from lmdsl.errors import LmdslError
from lmdsl.machine.deadline import Deadline

T = TypeVar("T")

# Number of entries of a matrix from which on native calls have a process of their own, with or
# without a deadline.
LARGE = 50_000

GRACE = 1.0  # seconds after the deadline in which a solver may still say what it found


class Ended(LmdslError):
    """The child was ended by somebody else."""


def call(
    function: Callable[..., T], *args: Any, deadline: Deadline, doing: str, entries: int = LARGE
) -> T:
    """Return ``function(*args)``, made by a child where that is worth it.

    The function is one of a module, the arguments can be pickled; what it prints goes to standard
    error. Few ``entries`` of a matrix are not worth a child unless there is a deadline.
    TimeLimitReached, with ``doing``: the child was ended at the deadline; Ended: it ended
    otherwise.
    """
    small = deadline.left is None and entries < LARGE
    if small or not sys.executable:  # embedded in another program there is no Python to start
        return function(*args)
    code = f"import sys; sys.path[:] = {sys.path!r}; from lmdsl.machine.apart import serve; serve()"
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert child.stdin is not None
    assert child.stdout is not None
    seconds, watch = deadline.left, None
    if seconds is not None:
        watch = threading.Timer(min(seconds + GRACE, threading.TIMEOUT_MAX), child.kill)
    reply: Any = None
    try:
        if watch is not None:
            watch.start()
        with contextlib.suppress(EOFError, OSError, pickle.UnpicklingError):
            pickle.dump((function, args), child.stdin, protocol=5)
            child.stdin.close()
            reply = pickle.load(child.stdout)
    finally:
        if watch is not None:
            watch.cancel()
        child.kill()
        with contextlib.suppress(OSError):
            child.stdin.close()
        child.stdout.close()
        status = child.wait()
    if reply is None:
        deadline.raise_if_over(doing)
        why = f"signal {-status}" if status < 0 else f"status {status}"
        raise Ended(f"the process of the solver ended ({why}), perhaps for want of memory")
    error, found = reply
    if error is not None:
        raise error
    return found  # type: ignore[no-any-return]


def serve() -> None:
    """Do the work of the child: read a call from standard input, write what it returns."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends us
    end_with_the_caller()
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no reply
    function, arguments = pickle.load(sys.stdin.buffer)
    reply: tuple[BaseException | None, Any]
    try:
        reply = None, function(*arguments)
    except BaseException as error:
        reply = error, None
    pickle.dump(reply, replies, protocol=5)
    replies.flush()


def end_with_the_caller() -> None:
    """Ask Linux to end us when whoever started us is killed."""
    with contextlib.suppress(Exception):
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)

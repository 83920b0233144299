"""One deadline for all that a call does, handed through; everything long asks it now and then."""

import math
import time

import numpy as np

from lmdsl.errors import BadInput, LmdslError, shown


class TimeLimitReached(LmdslError, TimeoutError):
    """The caller's time limit ended the work; the message says which (exit status 4)."""

    def __init__(self, doing: str) -> None:
        super().__init__(f"time limit reached while {doing}; raise the limit or make less work")


FOREVER = 1e10  # number of seconds above which a limit counts as this one: three centuries


class Deadline:
    """A moment on the monotonic clock after which no more work is wanted.

    Parameters
    ----------
    seconds
        From now on; None for no limit.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = seconds
        self._at = math.inf if seconds is None else time.monotonic() + seconds

    @classmethod
    def of(cls, limit: "float | Deadline | None") -> "Deadline":
        """Return a deadline as it is, a number of seconds as one that begins now.

        Raises
        ------
        BadInput
            It is no positive number.
        """
        if isinstance(limit, Deadline):
            return limit
        number = isinstance(limit, float | int | np.floating | np.integer) and limit is not True
        if limit is not None and not (number and limit > 0):
            raise BadInput(f"{shown(limit)} must be a number of seconds > 0", "time_limit")
        return cls(None if limit is None else float(min(limit, FOREVER)))

    def again(self) -> "Deadline":
        """Return a deadline for finishing: as long again from now on, at least two seconds."""
        return Deadline(None if self.seconds is None else max(self.seconds, 2.0))

    def __call__(self) -> bool:
        """Return whether the time is up, or nobody waits any more."""
        return time.monotonic() > self._at

    @property
    def left(self) -> float | None:
        """Seconds that are left, positive even after it; None for no limit."""
        return None if self._at == math.inf else max(self._at - time.monotonic(), 1e-9)

    def raise_if_over(self, doing: str) -> None:
        """Raise :class:`TimeLimitReached` once the time is up."""
        if self():
            raise TimeLimitReached(doing)

    def cancel(self) -> None:
        """End the work now: the caller was interrupted, and threads that help need not go on."""
        self._at = -math.inf


class Stopped(Exception):
    """The caller's time is up: no answer, which is not the same as no solution."""

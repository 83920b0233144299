"""Deadlines that also pass once another rank has failed: nobody waits for the end of vain work."""

import math
import threading
import time

from lmdsl.machine.deadline import Deadline
from lmdsl.ranks.verbs import Elsewhere, Ranks

EVERY = 0.1  # seconds after which another rank is asked again
MOMENT = 0.005  # seconds for which nothing is asked: work asks thousands of times


class Watched(Deadline):
    """A deadline of work that all ranks do together (:meth:`Ranks.agreed`).

    Only the thread of the rank asks the others; those that help it are told by it.
    """

    def __init__(self, ranks: Ranks, deadline: Deadline) -> None:
        super().__init__(None)
        self.seconds, self.ranks, self.deadline = deadline.seconds, ranks, deadline
        self._thread, self._asked, self._failed = threading.get_ident(), 0.0, False
        self._quiet = 0.0  # until when nothing is asked

    @property
    def failed(self) -> bool:
        """Whether another rank has failed."""
        now = time.monotonic()
        if threading.get_ident() == self._thread and now - self._asked > EVERY:
            self._asked, self._failed = now, self.ranks.trouble()
        return self._failed

    def __call__(self) -> bool:
        """Return whether the time is up, or nobody waits any more."""
        return super().__call__() or self.failed or self.deadline()

    @property
    def left(self) -> float | None:
        """Seconds that are left, positive even after it; None for no limit."""
        return self.deadline.left

    def raise_if_over(self, doing: str) -> None:
        """Raise :class:`Elsewhere` once another rank has failed, or that the time is up."""
        now = time.monotonic()
        if now < self._quiet:
            return
        if self.failed:
            raise Elsewhere(f"another rank has failed while {doing}")
        super().raise_if_over(doing)
        self._quiet = now + MOMENT

    def cancel(self) -> None:
        """End the work now."""
        self._quiet = -math.inf
        super().cancel()

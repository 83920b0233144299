"""What a fork of the process leaves behind: threads that are gone, and locks that they held.

A child has only the thread that called ``fork``. A lock that another thread held is never given
back, and a pool of threads of which the child knows has no members; waiting for either is for ever.
So here nothing is locked that need not be, and who keeps threads can ask.
"""

import functools
import os
import sys
import threading
from typing import TYPE_CHECKING, Any

_forks: list[int] = []


def forked() -> bool:
    """Return whether the process was forked from one that may have had threads.

    Noticed since lmdsl was imported, or of a child that ``multiprocessing`` made.
    """
    made = sys.modules.get("multiprocessing.process")
    return bool(_forks) or (
        made is not None and type(made.current_process()).__name__ == "ForkProcess"
    )


# Held while parts of lmdsl are imported: Python keeps a lock for each module.
whole = threading.RLock()

_locks: list[Any] = [whole]
_taken: list[Any] = []


def hold(lock: Any) -> None:
    """Let no fork happen while another thread holds a lock: the child could never take it.

    Who holds the lock may not import parts of lmdsl; who imports them may take it.
    """
    _locks.append(lock)


def _before() -> None:
    for lock in _locks:
        lock.acquire()
        _taken.append(lock)


def _after() -> None:
    while _taken:
        _taken.pop().release()


def _in_child() -> None:
    _forks.append(os.getpid())
    _after()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before, after_in_parent=_after, after_in_child=_in_child)


if TYPE_CHECKING or sys.version_info >= (3, 12):
    from functools import cached_property as cached_property
else:

    class cached_property(functools.cached_property):  # noqa: N801
        """Without the lock that Python 3.11 shares between all instances."""

        def __get__(self, instance: Any, owner: Any = None) -> Any:
            if instance is None:
                return self
            found = instance.__dict__
            if self.attrname not in found:
                found[self.attrname] = self.func(instance)
            return found[self.attrname]

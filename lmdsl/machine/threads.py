"""Work in several threads whose results come back in order.

The parts of a computation never depend on the number of threads, and their results are used in
the order of the parts: the outcome is the same to the last bit however many threads there are.
The environment variable ``NUMBA_NUM_THREADS`` limits their number.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from typing import Any, TypeVar

from lmdsl.machine import kernels

Part = TypeVar("Part")
Outcome = TypeVar("Outcome")
First = TypeVar("First")
Second = TypeVar("Second")

_pool: ThreadPoolExecutor | None = None
_members = 0
_making = threading.Lock()
_inside = threading.local()


def count() -> int:
    """Return the number of threads to use: the processors at hand, or fewer if so asked."""
    return max(1, min(len(processors()), int(kernels.threads)))


def processors() -> tuple[int, ...]:
    """Return the numbers of the processors at hand."""
    try:
        return tuple(sorted(os.sched_getaffinity(0)))
    except AttributeError:  # not on this operating system
        return tuple(range(os.cpu_count() or 1))


def limit(most: int) -> None:
    """Use no more threads from here on; at least one."""
    kernels.threads = max(1, min(most, int(kernels.threads)))


def ranges(total: int, count: int) -> list[tuple[int, int]]:
    """Split ``range(total)`` into ranges of nearly equal length."""
    return [(total * k // count, total * (k + 1) // count) for k in range(count)]


def each(work: Callable[[Part], Outcome], parts: Sequence[Part]) -> list[Outcome]:
    """Return ``[work(part) for part in parts]``.

    Every thread takes the next part as soon as it has finished one; the calling thread works too.
    Of several errors that of the first part is raised, when the parts begun have ended.
    """
    helpers = min(_helpers(), len(parts) - 1)
    if helpers < 1:
        return [work(part) for part in parts]
    outcomes: dict[int, Outcome] = {}
    errors: dict[int, BaseException] = {}
    left, lock = iter(range(len(parts))), threading.Lock()

    def take() -> int | None:
        with lock:
            return next(left, None)

    def pull() -> None:
        while (k := take()) is not None:
            try:
                outcomes[k] = work(parts[k])
            except BaseException as error:
                errors[k] = error
                drop()

    def drop() -> None:
        with lock:
            deque(left, maxlen=0)

    pool = _shared(helpers)
    others: list[Future[None]] = []
    with suppress(RuntimeError):  # the main thread has ended, and with it the pool
        others.extend(pool.submit(pull) for _ in range(helpers))
    try:
        pull()
    finally:
        drop()
        wait([other for other in others if not other.cancel()])  # else it has not begun
    if errors:
        raise errors[min(errors)]
    return [outcomes[k] for k in range(len(parts))]


def both(
    one: Callable[[], First], other: Callable[[], Second], parallel: bool
) -> tuple[First, Second]:
    """Return ``(one(), other())``, each in a thread of its own if ``parallel``."""
    if not parallel:
        return one(), other()
    found: list[Any] = each(lambda work: work(), (one, other))
    return found[0], found[1]


def in_order(
    work: Callable[[Part], Outcome],
    parts: Iterable[Part],
    cancel: Callable[[], object] = lambda: None,
) -> Iterator[Outcome]:
    """Yield ``work(part)`` for every part of a long series, in order, a few parts ahead.

    The calling thread works too. The first part that raises ends the iteration with its error;
    the parts begun are waited for, the others never begin. ``cancel`` is called before waiting, to
    end those begun early: an interrupt is not to wait for the end of a long part.
    """
    helpers = _helpers()
    if not helpers:
        yield from map(work, parts)
        return
    pool = _shared(helpers)
    ahead: deque[Future[Outcome]] = deque()
    try:
        for part in parts:
            if sum(not future.done() for future in ahead) < 2 * helpers:
                ahead.append(_begun(pool, work, part))
            else:
                ahead.append(_done(work, part))
            while ahead and (ahead[0].done() or len(ahead) > 8 * helpers):
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    except BaseException:
        cancel()
        raise
    finally:
        wait([future for future in ahead if not future.cancel()])


def _begun(
    pool: ThreadPoolExecutor, work: Callable[[Part], Outcome], part: Part
) -> Future[Outcome]:
    try:
        return pool.submit(work, part)
    except RuntimeError:  # the main thread has ended, and with it the pool
        return _done(work, part)


def _done(work: Callable[[Part], Outcome], part: Part) -> Future[Outcome]:
    """Do the work now; an error waits for its turn."""
    future: Future[Outcome] = Future()
    try:
        future.set_result(work(part))
    except Exception as error:
        future.set_exception(error)
    return future


def _helpers() -> int:
    """Return how many other threads may help; none helps a helper, or all might wait for all."""
    return 0 if getattr(_inside, "helping", False) else count() - 1


def _shared(helpers: int) -> ThreadPoolExecutor:
    """Return a pool of at least so many threads; starting them anew costs as much as their work."""
    global _pool, _members
    with _making:
        if _pool is None or _members < helpers:  # one that is dropped ends when nobody uses it
            _pool, _members = ThreadPoolExecutor(helpers, initializer=_begin), helpers
        return _pool


def _begin() -> None:
    _inside.helping = True


def _forget() -> None:
    """Threads do not survive a fork."""
    global _pool, _members, _making
    _pool, _members, _making = None, 0, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)

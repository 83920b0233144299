"""Work in several threads whose results come back in order.

The parts of a computation never depend on the number of threads, and their results are used in
the order of the parts: the outcome is the same to the last bit however many threads there are.
The environment variable ``NUMBA_NUM_THREADS`` limits their number.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from numba import config

Part = TypeVar("Part")
Outcome = TypeVar("Outcome")


def count() -> int:
    """Return the number of threads to use: the processors at hand, or fewer if so asked."""
    try:
        processors = len(os.sched_getaffinity(0))
    except AttributeError:  # not on this operating system
        processors = os.cpu_count() or 1
    return max(1, min(processors, int(config.NUMBA_NUM_THREADS)))


def ranges(total: int, count: int) -> list[tuple[int, int]]:
    """Split ``range(total)`` into ranges of nearly equal length."""
    return [(total * k // count, total * (k + 1) // count) for k in range(count)]


def in_order(work: Callable[[Part], Outcome], parts: Iterable[Part]) -> Iterator[Outcome]:
    """Yield ``work(part)`` for every part, in order, computed ahead by a few parts.

    The calling thread works too. The first part that raises ends the iteration with its error;
    the parts begun are waited for, the others never begin.
    """
    helpers = count() - 1
    if not helpers:
        yield from map(work, parts)
        return
    pool = ThreadPoolExecutor(helpers)
    ahead: deque[Future[Outcome]] = deque()
    try:
        for part in parts:
            if sum(not future.done() for future in ahead) < 2 * helpers:
                ahead.append(pool.submit(work, part))
            else:
                ahead.append(_done(work, part))
            while ahead and (ahead[0].done() or len(ahead) > 8 * helpers):
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _done(work: Callable[[Part], Outcome], part: Part) -> Future[Outcome]:
    """Do the work now; an error waits for its turn."""
    future: Future[Outcome] = Future()
    try:
        future.set_result(work(part))
    except Exception as error:
        future.set_exception(error)
    return future

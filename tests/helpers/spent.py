"""How much computing a block may cost; what else keeps the machine busy does not count."""

import time
from contextlib import contextmanager


@contextmanager
def at_most(seconds):
    """Assert that a block takes at most so much processor time of this thread.

    Limits are some ten times what is usual, to tell work that grows without bound, not speed.
    """
    started = time.thread_time()
    yield
    assert time.thread_time() - started < seconds

"""How a program of several ranks ends: whole on every rank, or on none.

An error that one rank meets outside :meth:`Ranks.agreed` leaves the others waiting for it; plain
MPI lets them wait for ever. So it is said once, and all ranks are ended. So do signals: Python's
own handlers wait for the end of a compiled loop, and every rank would speak.
"""

import contextlib
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator

from lmdsl.errors import LmdslError, plain_text
from lmdsl.ranks.mpi import MpiRanks
from lmdsl.ranks.verbs import Item, Ranks

INTERRUPTED, FAILED, NO_MEMORY = 130, 4, 2  # exit statuses
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
# Seconds that a rank leaves to those below it, which may have met the same, to speak and to end
# all; at most; after which what was said is on its way; and after which a process ends by itself.
TURN, LATEST, SPOKEN, PATIENCE = 0.25, 2.0, 0.1, 2.0


def together(ranks: Ranks, program: Callable[[Ranks], Item]) -> Item:
    """Return ``program(ranks)``; where it raises on some rank, end all of them.

    An error that every rank meets alike, as :meth:`Ranks.agreed` makes it, goes on to the caller:
    it bears ``agreed``.
    """
    if not isinstance(ranks, MpiRanks):
        return program(ranks)
    with _signals_end_all(ranks):
        try:
            return program(ranks)
        except BaseException as error:
            if getattr(error, "agreed", False) or isinstance(error, SystemExit):
                raise
            if os.environ.get("LMDSL_DEBUG"):
                traceback.print_exc()
            _end_all(ranks, *_said(error))
            raise


def _said(error: BaseException) -> tuple[str, int]:
    """Return what is said of an error, and the exit status."""
    if isinstance(error, KeyboardInterrupt):
        return WORDS[signal.SIGINT], INTERRUPTED
    if isinstance(error, MemoryError):
        return "out of memory; use fewer cells, controls or sample points", NO_MEMORY
    text = plain_text(error)
    if isinstance(error, LmdslError):
        return text, FAILED
    what = f"internal error: {type(error).__name__}: {text}"
    return f"{what}; please report it (LMDSL_DEBUG=1 shows where)", FAILED


def _end_all(ranks: MpiRanks, message: str, status: int) -> None:
    """Say why, unless another rank did, and end all ranks.

    Launchers end the others by SIGTERM, whose handlers come here as well.
    """
    threading.Thread(target=_leave, args=(status,), daemon=True).start()
    time.sleep(min(TURN * ranks.rank, LATEST))
    if not ranks.ending():
        ranks.tell_ending()
        text = f"lmdsl: rank {ranks.rank} of {ranks.count}: {message}\n"
        with contextlib.suppress(OSError):
            os.write(2, text.encode(errors="replace"))
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # MPI has more to say, and nothing new
        time.sleep(SPOKEN)
    ranks.abort(status)


def _leave(status: int) -> None:
    """End this process, should MPI not do it."""
    time.sleep(LATEST + SPOKEN + PATIENCE)
    os._exit(status)


@contextlib.contextmanager
def _signals_end_all(ranks: MpiRanks) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end all ranks, also in the middle of a compiled loop.

    A thread is told of them by the system's own handler. Signals that were ignored still are.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in WORDS}
    taken = [number for number, held in handlers.items() if held not in (None, signal.SIG_IGN)]
    told, tell = os.pipe()
    os.set_blocking(tell, False)
    before = signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    for number in taken:
        signal.signal(number, lambda *_: None)  # the thread ends all
    threading.Thread(target=_watch, args=(ranks, told), daemon=True).start()
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, handlers[number])
        signal.set_wakeup_fd(before)
        os.close(tell)


def _watch(ranks: MpiRanks, told: int) -> None:
    """End all ranks once this one is told of a signal; return once nobody tells any more."""
    while found := os.read(told, 1):
        if found[0] in WORDS:
            _end_all(ranks, WORDS[signal.Signals(found[0])], 128 + found[0])
    os.close(told)

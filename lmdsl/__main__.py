"""``python -m lmdsl``, and the command ``lmdsl``."""

import _thread
import contextlib
import os
import signal
import sys
import time
from types import FrameType

from lmdsl.ranks.launchers import launched

PATIENCE = 5.0  # seconds that an interrupted command has to end by itself

_ended = _interrupted = False


def run() -> int:
    """Run the command line and return its exit status; Ctrl-C ends it whatever happens.

    KeyboardInterrupt may come between the taking of a lock and the block that would release it
    (inside the standard library's thread pool, say), and a thread then waits for ever. Results
    are written whole or not at all, so the process can be ended at any moment.
    """
    global _ended
    os.environ.pop("MPLBACKEND", None)  # a notebook's; figures are drawn into files
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        from lmdsl.cli import main

        return main()
    except BaseException as error:  # before main() could take care of it
        if not (_interrupted or isinstance(error, KeyboardInterrupt)):
            raise  # else what an import makes of it that is broken off
        _say_interrupted()
        return 130
    finally:
        _ended = True
        with contextlib.suppress(OSError):  # what libraries say when the process ends
            os.dup2(2, 1)


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _interrupted
    _interrupted = True
    _thread.start_new_thread(_end, ())  # not one of threading's: these take locks
    signal.default_int_handler(number, frame)


def _end() -> None:
    time.sleep(PATIENCE)
    if not _ended:  # else it was said
        _say_interrupted()
    os._exit(130)


def _say_interrupted() -> None:
    if launched().rank:  # of several; the first one says it
        return
    with contextlib.suppress(OSError):
        os.write(2, (b"\r\x1b[K" if os.isatty(2) else b"") + b"lmdsl: interrupted\n")


if __name__ == "__main__":
    sys.exit(run())

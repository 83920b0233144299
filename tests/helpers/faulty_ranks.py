"""The command line over ranks, of which one meets a fault: ``faulty_ranks.py FAULT FOLDER ARG...``.

FAULT is PLACE:KIND[:RANK]. At that place of the work on that rank (default: the last) it happens;
where a signal is waited for, files in FOLDER with the numbers of processes say that all is ready.
"""

import ctypes
import errno
import os
import signal
import sys
import time
from importlib import import_module
from operator import attrgetter
from pathlib import Path

from lmdsl.__main__ import run
from lmdsl.errors import BadInput
from lmdsl.optimize import checkpoints
from lmdsl.ranks.launchers import launched

SIGNALS = ("waits", "blocks")


def happen(kind, folder):
    """Let it happen."""
    if kind == "nothing":
        return
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "exits":
        os._exit(3)
    if kind == "full":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    if kind == "waits":  # for a signal, in Python
        ready(folder)
        while True:
            time.sleep(0.01)
    if kind == "blocks":  # in C, where no handler of Python's runs
        ready(folder)
        while True:
            ctypes.CDLL(None).pthread_join(sleeping(), None)
    raise {"memory": MemoryError(), "bad": BadInput("spoilt", "gamma")}.get(kind, ValueError("odd"))


def sleeping():
    """A thread of the system that sleeps on: waiting for it ends by no signal."""
    import threading

    thread = threading.Thread(target=lambda: time.sleep(3600), daemon=True)
    thread.start()
    return ctypes.c_ulong(thread.ident)


def ready(folder):
    """Tell the number of this process."""
    whole = Path(folder) / f".{launched().rank}"
    whole.write_text(str(os.getpid()))
    whole.rename(Path(folder) / f"ready{launched().rank}")


def patch(place, kind, rank, folder):
    """Let a fault happen the next time that the place is passed on a rank."""
    module, owner, name = place
    owner = attrgetter(owner)(import_module(module)) if owner else import_module(module)
    true, passed = getattr(owner, name), []

    def faulty(*arguments, **named):
        passed.append(place)
        if len(passed) > (name == "keep") and (launched().rank == rank or kind in SIGNALS):
            happen(kind if launched().rank == rank else "waits", folder)
        return true(*arguments, **named)

    setattr(owner, name, faulty)


PLACES = {
    "compiling": ("lmdsl.slabs.graph.pairs", "", "assemble"),  # within agreed work
    "levels": ("lmdsl.slabs.graph.levels", "", "tree"),  # outside
    "solving": ("lmdsl.slabs.solving", "", "iterated"),
    "kept": ("lmdsl.optimize.checkpoints", "Checkpoints", "keep"),  # for the second time
    "saving": ("lmdsl.distributed.saving", "", "_written"),
    "saved": ("lmdsl.distributed.saving", "", "_finish"),
}


def main():
    fault, folder, *arguments = sys.argv[1:]
    place, kind, *rank = fault.split(":")
    which = int(rank[0]) if rank else launched().ranks - 1
    patch(PLACES[place], kind, which, folder)
    checkpoints.EVERY = 0.0
    sys.argv[1:] = arguments
    sys.exit(run())


if __name__ == "__main__":
    main()

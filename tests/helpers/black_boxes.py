"""Functions of one sample, in a module that other processes can import."""

import multiprocessing
import os
import threading
import time
from pathlib import Path


def right(x, u):
    return {"x": x - 0.25 * u}


def cost(u):
    return 1 + u


def prints(x, u):
    print("x is", x)
    return {"x": x - 0.25 * u}


def fails(x, u):
    if x > 0.6:
        raise ArithmeticError("mine")
    return {"x": x - 0.25 * u}


class Strange(Exception):
    """An error that cannot be made from its arguments."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def fails_strangely(x, u):
    raise Strange("this", "that")


def ends(x, u):
    os._exit(3)


def elsewhere(x, u, here):
    """Another answer in another process."""
    return {"x": x - 0.25 * u + 1e-3 * (os.getpid() != int(here))}


def unforked(x, u):
    if type(multiprocessing.current_process()).__name__ == "ForkProcess":
        raise ArithmeticError("forked")
    return right(x, u)


def sleeps(x, u):
    time.sleep(3600)


class Logged:
    """Writes the process of every call into a folder."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __call__(self, x, u):
        Path(self.folder, str(os.getpid())).touch()
        return {"x": x - 0.25 * u}


class Threads:
    """The threads that called."""

    def __init__(self):
        self.seen = set()

    def __call__(self, x, u):
        self.seen.add(threading.get_ident())
        return {"x": x - 0.25 * u}

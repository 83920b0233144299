"""A package with a backend that prints, and Python beside it."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

import lmdsl as lm
from lmdsl import backends

posix = pytest.mark.skipif(os.name != "posix", reason="descriptors of POSIX")
ROOT = Path(lm.__file__).parents[1]
NOISY = '''
import atexit, ctypes, os, subprocess, sys, threading
from lmdsl import backends
from lmdsl.errors import BadInput

def shout(when):
    """Print in all ways there are; C and the old stream hold back what ends no line."""
    libc = ctypes.CDLL(None)
    print("NOISE print", when)
    sys.stdout.write("NOISE write " + when)
    sys.__stdout__.write("NOISE old stream " + when)
    os.write(1, b"NOISE descriptor " + when.encode())
    libc.puts(b"NOISE puts " + when.encode())
    libc.printf(b"NOISE printf " + when.encode())
    subprocess.run([sys.executable, "-c", "print('NOISE child')"])
    os.system("echo NOISE shell")
    print("NOISE stderr", when, file=sys.stderr)

WAYS = ("print", "write", "old stream", "descriptor", "puts", "printf", "child", "shell", "stderr")

if __name__ != "__main__":
    shout("import")

def solve(lp, options):
    shout("solve")
    if options.progress:
        options.progress("of the backend", 0.5)
    if options.algorithm == "refused":
        raise BadInput("not this one", "backend")
    if options.algorithm == "fails":
        raise RuntimeError("no\\x1b[31m")
    if options.algorithm == "late":
        atexit.register(shout, "end")
    own = backends.get("policy-iteration").solve(lp, options)
    return backends.Solution(own.stop, "ok\\x1b[2J\\n{}", own.value, None, own.policy)

BACKEND = backends.Backend(
    "noisy", solve, backends.Capabilities(algorithms=("works", "refused", "fails", "late"))
)
'''


def python(tmp_path, environment, *arguments):
    done = subprocess.run(
        [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True,
        text=True, check=False, timeout=600,
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done


def shouting(text="NOISE"):
    own = backends.get("policy-iteration").solve

    def solve(lp, options):
        print(text)
        return own(lp, options)

    return backends.Backend("shouting", solve)


class Notebook(io.StringIO):
    """A stream like a notebook's: without a descriptor."""

    def fileno(self):
        raise io.UnsupportedOperation("fileno")

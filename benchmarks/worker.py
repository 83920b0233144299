"""One contestant in a process of its own: loads and builds, then solves on command.

Started as ``python -m benchmarks.worker MODULE ALGORITHM WARM MODEL``. It answers each line on
its standard input with one line of JSON: first, unasked, that it is ready. Whatever the solver
prints goes elsewhere.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.arrays import Arrays
from benchmarks.process import depend, peak

AWAKE = 0.2
"""Seconds of work before the clock starts."""


def main() -> None:
    """Answer until standard input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    depend()
    module, algorithm, warm, path = sys.argv[1:]

    def answer(**facts: Any) -> None:
        answers.write(json.dumps(facts) + "\n")

    try:
        make = importlib.import_module(module).Solver
        small = make(Arrays.load(Path(warm)), algorithm)
        small.renew()
        small.solve()
        small.value()
        model = Arrays.load(Path(path))
        started = time.perf_counter()
        solver = make(model, algorithm)
        answer(build=time.perf_counter() - started, peak=peak())
        for _ in sys.stdin:
            answer(**_timed(solver, model))
    except (Exception, SystemExit) as error:
        text = " ".join(str(error).split())
        kind = "not supported" if isinstance(error, NotImplementedError) else "failed"
        answer(failure=kind, reason=f"{type(error).__name__}: {text}"[:300])


def _timed(solver: Any, model: Arrays) -> dict[str, Any]:
    solver.renew()
    _wake()
    cpu, wall = time.process_time(), time.perf_counter()
    solver.solve()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    memory = peak()
    V = solver.value()
    error = None if V is None else model.error(np.asarray(V))
    return {"wall": wall, "cpu": cpu, "peak": memory, "error": error}


def _wake() -> None:
    """Keep the processor busy, as compiling the model would: one that has just slept is slow."""
    until = time.perf_counter() + AWAKE
    while time.perf_counter() < until:
        pass


if __name__ == "__main__":
    main()

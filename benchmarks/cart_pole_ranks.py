"""The swing-up of cart and pole on every rank that a launcher started: what it found and took.

Started as ``mpiexec -n R python -m benchmarks.cart_pole_ranks CELLS OUT``; rank 0 prints one line
of JSON. What ``lmdsl solve --no-simulate`` does under a launcher, with what each rank takes.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import lmdsl as lm
from benchmarks.cart_pole import shape
from benchmarks.process import MARK, depend, peak
from lmdsl import distributed
from lmdsl.ranks.mpi import at_hand

WARM = (8, 16, 16, 16)  # cells of the model by which kernels are loaded


def problem(cells: tuple[int, ...]) -> lm.Problem:
    """Return the swing-up on other cells."""
    declared = lm.Problem.model_validate(lm.systems.NAMED["cart_pole"].problem)
    axes = zip(declared.state_box.items(), cells, strict=True)
    return declared.replaced(state_box={name: axis.replaced(cells=n) for (name, axis), n in axes})


def measured(ranks: Any, cells: tuple[int, ...], out: str) -> dict[str, Any]:
    """Return what was found, and what every rank took."""
    distributed.solve(problem(WARM), ranks=ranks)
    base, calls, sent = peak(), ranks.traffic.calls, ranks.traffic.sent
    wall, cpu = time.perf_counter(), time.process_time()
    answer = distributed.solve(problem(cells), out=out, ranks=ranks)
    own = {
        "wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu,
        "peak": peak() - base, "calls": ranks.traffic.calls - calls,
        "sent": ranks.traffic.sent - sent,
    }  # fmt: skip
    mesh = answer.lp.mesh if answer.lp is not None else None
    if mesh is not None:
        own |= {"own": mesh.own, "ghosts": len(mesh.ghosts)}
    every = ranks.collect(own)
    seconds = answer.seconds
    return {
        "cells": cells, "status": answer.status, "gap": answer.gap, "cost": answer.cost,
        "pairs": answer.pairs, "coverage": answer.coverage and answer.coverage.share,
        "seconds": {"compile": seconds.compile, "solve": seconds.solve}, "ranks": every,
    }  # fmt: skip


def main() -> None:
    """Measure once."""
    depend()
    ranks = at_hand()
    found = measured(ranks, shape(sys.argv[1]), sys.argv[2])
    if ranks.rank == 0:
        print("\n" + MARK + json.dumps(found), flush=True)


if __name__ == "__main__":
    main()

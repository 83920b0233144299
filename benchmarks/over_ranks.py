"""A problem compiled, solved and verified on every rank that a launcher started, and what it took.

Started as ``mpiexec -n R python -m benchmarks.over_ranks CELLS MODE``. Rank 0 prints one line of
JSON: of every rank the seconds, the processor time, the memory and the messages of each stage. In
mode ``alone`` one process uses the code of one process, ``first`` and ``all`` say who evaluates.
"""

from __future__ import annotations

import json
import sys
import time
from itertools import pairwise
from typing import Any

import lmdsl as lm
from benchmarks import internals, models
from benchmarks.process import MARK, depend, peak

STAGES = ("compile", "solve", "verify")
WARM = 60  # cells an axis of the model by which kernels are loaded
MODES = ("alone", "first", "all")


class Marks:
    """What a rank has taken by the time that each stage begins, which all do together."""

    def __init__(self, ranks: Any) -> None:
        self.ranks = ranks
        self.taken: dict[str, dict[str, float]] = {}

    def __call__(self, stage: str) -> None:
        """Note that a stage begins."""
        if stage in self.taken:
            return
        said = {
            "calls": self.ranks.traffic.calls - len(self.taken),
            "sent": self.ranks.traffic.sent,
        }
        self.ranks.collect(None)  # waiting for the others belongs to the stage before
        clocks = {"wall": time.perf_counter(), "cpu": time.process_time()}
        self.taken[stage] = {**said, **clocks}

    def stages(self) -> dict[str, dict[str, float]]:
        """Return what each stage took."""
        return {
            stage: {name: after[name] - before[name] for name in before}
            for (stage, before), (_, after) in pairwise(self.taken.items())
        }


def measured(ranks: Any, cells: int, mode: str) -> list[dict[str, Any]]:
    """Return what every rank took."""
    _run(ranks, WARM, mode, Marks(ranks))
    base, marks = peak(), Marks(ranks)
    facts = _run(ranks, cells, mode, marks)
    own = {"base": base, "peak": peak() - base, "stages": marks.stages(), **facts}
    found: list[dict[str, Any]] = ranks.collect(own)
    return found


def _run(ranks: Any, cells: int, mode: str, mark: Marks) -> dict[str, Any]:
    problem = models.get(f"standard-map-{cells}").make()
    mark("compile")
    if mode != "alone":
        facts = internals.over_ranks(ranks, problem, mark, mode == "all")
        mark("end")
        return facts
    lp = lm.compile(problem)
    result = lm.solve(
        lp, progress=lambda stage, done: mark(stage) if stage in STAGES and done < 0 else None
    )
    mark("end")
    return {"cells": result.stabilizable_cells, "status": result.status, "cost": result.cost}


def main() -> None:
    """Measure once."""
    depend()
    ranks = internals.this_rank()
    found = measured(ranks, int(sys.argv[1]), sys.argv[2])
    if ranks.rank == 0:
        print("\n" + MARK + json.dumps(found), flush=True)


if __name__ == "__main__":
    main()

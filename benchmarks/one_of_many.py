"""What one of many ranks takes to compile its part of a problem that one machine may not hold.

``python -m benchmarks.one_of_many FILE CELLS --ranks R`` raises the cells of a problem file to
CELLS (such as ``31622x31622``) and compiles the part that one of R ranks owns, the middle one. How
many cells of each piece of the box are free it counts alone, where each of R would count a share.
Printed are memory above that of the imports and kernels, the part of the box whose sets it knows
in the end, and processor time.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.substeps import settled
from lmdsl.model.assembly.transitions import assemble
from lmdsl.model.grid.partition import Partition
from lmdsl.ranks.verbs import Alone
from lmdsl.slabs.graph.pieces import PieceSets


def main() -> int:
    """Compile one part, and print a row."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.one_of_many", description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("cells", help="cells of each axis, such as 31622x31622")
    parser.add_argument("--ranks", type=int, default=1024)
    asked = parser.parse_args()
    problem = lm.load(asked.file)
    numbers = dict(zip(problem.states, map(int, asked.cells.split("x")), strict=True))
    box = problem.model_dump(mode="json", exclude_none=True)["state_box"]
    for name, cells in numbers.items():
        box[name]["cells"] = cells
    lm.compile(problem)  # kernels are compiled, or loaded
    before, problem = _megabytes(), settled(problem.replaced(state_box=box))
    partition, began = Partition.of(problem), time.process_time()
    sets = PieceSets.over(Alone(), problem, partition, Deadline())
    counted, F, k = time.process_time(), len(sets.free), asked.ranks // 2
    span = F * k // asked.ranks, F * (k + 1) // asked.ranks
    own = assemble(problem, partition, sets=sets, span=span)
    done = time.process_time()
    facts = {
        "cells": f"{partition.size:,}", "own": f"{span[1] - span[0]:,}",
        "pairs": f"{len(own.control):,}", "MB": f"{_megabytes() - before:.0f}",
        "most MB": f"{_most() - before:.0f}", "known": f"{sets.pieces.known.mean():.1%}",
        "count, s of all": f"{counted - began:.1f}", "compile, s": f"{done - counted:.1f}",
    }  # fmt: skip
    print(" | ".join(facts), " | ".join(facts.values()), sep="\n")
    return 0


def _megabytes() -> float:
    """Return the memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def _most() -> float:
    """Return the most memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


if __name__ == "__main__":
    raise SystemExit(main())

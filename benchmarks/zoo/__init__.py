"""The zoo: systems with golden values, ``docs/zoo.md``; made anew by ``python -m benchmarks.zoo``.

``tests/whole/zoo.json`` holds every system: its problem file, the numbers of cells it is solved
with, coarsest first, and what came out.
"""

import json
from pathlib import Path
from typing import Any

import lmdsl as lm

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests/whole/zoo.json"
RUNS, STEPS, SEED = 1000, 2000, 0

Entry = dict[str, Any]


def entries() -> dict[str, Entry]:
    """Return the systems by name, each with ``file``, ``shown`` and its ``grids``."""
    found: dict[str, Entry] = json.loads(GOLDEN.read_text())
    return found


def problem(entry: Entry, cells: list[int] | None = None) -> lm.Problem:
    """Return the problem of a system, with other numbers of cells if given."""
    declared = lm.load(ROOT / entry["file"])
    if cells is None:
        return declared
    axes = zip(declared.state_box.items(), cells, strict=True)
    return declared.replaced(state_box={name: a.replaced(cells=n) for (name, a), n in axes})


def measured(lp: lm.StabilizationLP) -> Entry:
    """Return what is kept of a problem: counts, cost, gamma_bar, and runs of the map as compiled.

    Runs are 1,000 from random states of C. Without an attractor none is made, as none ends.
    """
    result = lm.solve(lp)
    limit = lm.gamma_max(lp)
    found: Entry = {
        "status": str(result.status),
        "attractor_cells": result.attractor_cells,
        "stabilizable_cells": result.stabilizable_cells,
        "coverage": round(result.coverage.share, 6),
        "pairs": result.pairs,
        "cost": result.cost,
        "gamma_bar": None if limit.low == float("inf") else [limit.low, limit.high],
        "runs": None,
    }
    if not result.problem.attractor.empty:
        runs = result.simulate(RUNS, STEPS, SEED, hold=100, as_compiled=True)
        found["runs"] = {"reached": runs.reached, "lost": runs.lost, "cycling": runs.cycling}
        if runs.held is not None:
            found["runs"]["stayed"] = runs.held.stayed
    return found

"""Cells of others that slabs need along each axis, counted and as some cells tell.

``python -m benchmarks.halos [FILE ...]`` compiles problems (default: those of ``examples`` with
several axes) and prints, for 2 and 4 slabs, the number for each own cell, were the box cut along
each axis; in brackets what ``Answer.ghosts_by_axis`` would say.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

import lmdsl as lm
from lmdsl.ranks.ranges import Division
from lmdsl.slabs.compiling import local
from lmdsl.slabs.graph import looking

ROOT = Path(__file__).parents[1] / "examples"
COUNTS = (2, 4)


def counted(lp: lm.StabilizationLP, count: int) -> dict[str, float]:
    """Return the ghosts of all ranks for each cell of C, were an axis declared first: counted."""
    shape, number = lp.partition.shape, lp.rows.target.astype(np.int64)
    pair = np.repeat(np.arange(lp.K), np.diff(lp.rows.pointer))
    source = np.repeat(np.arange(lp.n), np.diff(lp.pair_pointer))[pair]
    source, number = np.unique(np.stack([source, number])[:, number < lp.n], axis=1)
    found = {}
    for k, name in enumerate(lp.partition.names):
        order = [k, *(j for j in range(len(shape)) if j != k)]
        at = np.stack(np.unravel_index(lp.cells, shape))[order]
        place = np.argsort(np.ravel_multi_index(tuple(at), [shape[j] for j in order]))
        owner = np.empty(lp.n, dtype=np.int64)
        division = Division.cut(np.diff(lp.pair_pointer)[place], count)
        owner[place] = division.owner(np.arange(lp.n))
        foreign = owner[source] != owner[number]
        ghosts = np.unique(owner[source[foreign]] * lp.n + number[foreign])
        found[name] = len(ghosts) / max(lp.n, 1)
    return found


def row(problem: lm.Problem) -> str:
    """Return a line of the table."""
    lp = local(lm.compile(problem))
    texts = []
    for count in COUNTS:
        exact, begun = counted(lp, count), time.perf_counter()
        told = looking.estimated(lp, count) or {}
        taken = time.perf_counter() - begun
        texts.append(" ".join(f"{x} {exact[x]:.2f} ({told[x]:.2f})" for x in told))
    return " | ".join([f"{lp.n:,}", *texts, f"{1000 * taken:.0f}"])


def main() -> int:
    """Print the table."""
    files = [Path(name) for name in sys.argv[1:]]
    files = files or sorted([*ROOT.glob("*.json"), *ROOT.glob("zoo/*.json")])
    print("| problem | cells of C |", *(f"{count} slabs |" for count in COUNTS), "ms |")
    print("|---" * (len(COUNTS) + 3) + "|")
    for file in files:
        problem = lm.load(file)
        if len(problem.state_box) > 1:
            print(f"| {file.stem} | {row(problem)} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The swing-up of cart and pole over ranks: ``python -m benchmarks.cart_pole CELLS ...``.

Each CELLS is four numbers, of x, theta, v and omega, such as ``24x32x16x32``; multiples of 16 (8 of
x) keep the edges of the attractor on edges of cells. Each is solved by ``mpiexec -n R`` with one
thread a rank, written, verified and simulated; a row tells what it took and how it went. ``--fit
CELLS`` says what others would take, by the line through what was measured.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import lmdsl as lm
from benchmarks.process import Failed
from benchmarks.ranks import _launcher, _missing, reported

COLUMNS = (
    "cells", "pairs", "C", "arrive", "gap", "ghosts / own", "MB a rank", "B a cell", "compile s",
    "solve s", "all s", "CPU s", "calls", "B sent a cell",
)  # fmt: skip
RUNS, STEPS = 4000, 1000
Found = dict[str, Any]  # facts of all, and those of every rank


def main() -> int:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cart_pole", description=__doc__)
    parser.add_argument("cells", nargs="+", type=shape, metavar="CELLS")
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--fit", nargs="*", type=shape, default=[], metavar="CELLS")
    parser.add_argument("--limit", type=float, default=3600, help="seconds a size (3600)")
    parser.add_argument("--out", type=Path, help="keep the result directories in this folder")
    options = parser.parse_args()
    why = _missing()
    if why:
        print(f"benchmarks: {why}", file=sys.stderr)
        return 2
    print(line(COLUMNS), line(["---"] * len(COLUMNS)), sep="\n", flush=True)
    rows = []
    for cells in options.cells:
        with tempfile.TemporaryDirectory() as folder:
            place = (options.out or Path(folder)) / name(cells)
            try:
                rows.append(solved(cells, options.ranks, place, options.limit))
            except Failed as error:
                print(f"{name(cells)}: {error}", file=sys.stderr)
                return 1
        print(line(row(rows[-1])), flush=True)
    for cells in options.fit:
        print(predicted(rows, cells))
    return 0


def shape(text: str) -> tuple[int, ...]:
    """Read four numbers of cells."""
    found = tuple(int(word) for word in text.split("x"))
    if len(found) != 4 or min(found) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not four numbers such as 24x32x16x32")
    return found


def name(cells: tuple[int, ...]) -> str:
    """Return the word for a shape."""
    return "x".join(map(str, cells))


def solved(cells: tuple[int, ...], count: int, out: Path, limit: float) -> Found:
    """Return what a launched solve found and took.

    Raises
    ------
    Failed
        With the last line that was written, or the limit.
    """
    command = [_launcher() or "mpiexec", "-n", str(count), sys.executable, "-m",
               "benchmarks.cart_pole_ranks", name(cells), str(out)]  # fmt: skip
    found: Found = reported(command, limit)
    runs = lm.Result.load(out).simulate(RUNS, STEPS)
    return {**found, "runs": {"starts": runs.starts, "reached": runs.reached}}


def row(found: Found) -> list[str]:
    """Return the columns of a size."""
    ranks, cells = found["ranks"], math.prod(found["cells"])
    own = sum(rank["own"] for rank in ranks)
    runs = found["runs"]
    peak = max(rank["peak"] for rank in ranks)
    return [
        name(found["cells"]), f"{found['pairs']:,}", f"{found['coverage']:.1%}",
        f"{runs['reached'] / runs['starts']:.2%}",
        f"{found['gap']:.0e}" if found["status"] == "verified" else str(found["status"]),
        f"{max(rank['ghosts'] / max(rank['own'], 1) for rank in ranks):.2f}",
        f"{peak / 1e6:.0f}", f"{peak * len(ranks) / cells:.0f}",
        *(f"{found['seconds'][stage]:.1f}" for stage in ("compile", "solve")),
        f"{max(rank['wall'] for rank in ranks):.1f}", f"{sum(rank['cpu'] for rank in ranks):.1f}",
        f"{ranks[0]['calls']}", f"{sum(rank['sent'] for rank in ranks) / max(own, 1):.0f}",
    ]  # fmt: skip


def predicted(rows: list[Found], cells: tuple[int, ...]) -> str:
    """Return what other cells would take, by the line through what was measured."""
    sizes = [math.prod(found["cells"]) for found in rows]
    count = len(rows[-1]["ranks"])
    peak = at(sizes, [max(r["peak"] for r in found["ranks"]) for found in rows], math.prod(cells))
    time = at(sizes, [max(r["wall"] for r in found["ranks"]) for found in rows], math.prod(cells))
    return (
        f"{name(cells)} ({math.prod(cells):,} cells): about {peak / 1e9:.1f} GB beside imports on "
        f"each of {count} ranks, {time:.0f} s"
    )


def at(sizes: list[int], taken: list[float], size: int) -> float:
    """Return what a size takes, by the line of least relative errors through what was measured."""
    if len(sizes) < 2:
        return taken[0] / sizes[0] * size
    weight = 1 / np.asarray(taken, dtype=float)
    lines = np.stack([np.asarray(sizes, dtype=float), np.ones(len(sizes))], axis=1)
    slope, start = np.linalg.lstsq(lines * weight[:, None], np.ones(len(sizes)), rcond=None)[0]
    return float(slope * size + start)


def line(columns: Any) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(columns)} |"


if __name__ == "__main__":
    sys.exit(main())

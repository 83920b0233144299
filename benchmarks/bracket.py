"""How the bracket of the optimal cost shrinks with the cells, on the standard map.

``python -m benchmarks.bracket [--seconds S] [--cells 50,100] [--out FILE]`` solves, proves with a
bracket, and follows random states of what arrives under the true map; it prints a table, and
draws it into FILE, with maps of the bracket on the finest cells.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import lmdsl as lm
from lmdsl.machine.deadline import Deadline

RUNS = 200_000


class Row(NamedTuple):
    """What is found on cells of a size."""

    cells: int
    model: float
    arrives: float
    below: float
    mean: float
    above: float
    parts: int
    followed: int
    seconds: float


def measured(
    cells: int, seconds: float | None, target: float = 0.9999
) -> tuple[Row, lm.Result, Any]:
    """Return a row, and what it is of."""
    data: dict[str, Any] = dict(lm.systems.StandardMap.problem)
    box = {name: {**axis, "cells": cells} for name, axis in data["state_box"].items()}
    result = lm.solve(lm.Problem.model_validate({**data, "state_box": box, "gamma": 1.02}))
    began = time.monotonic()
    proof = result.prove(target, seconds, bracket=True)
    taken = time.monotonic() - began
    assert proof.optimum is not None
    assert proof.parts is not None
    assert result.cost is not None
    low, high = proof.optimum
    row = Row(cells, result.cost, proof.arrives, low, mean_cost(result, proof), high, proof.parts,
              proof.followed or 0, taken)  # fmt: skip
    return row, result, proof


def mean_cost(result: lm.Result, proof: Any) -> float:
    """Return the mean cost of runs of the true map from random states of what arrives."""
    rng, partition = np.random.default_rng(0), result.partition
    arrives = np.flatnonzero(proof.kind == 1)
    volume = 2.0 ** -proof.split[arrives].sum(axis=1, dtype=float)
    box = arrives[rng.choice(len(arrives), RUNS, p=volume / volume.sum())]
    index = np.stack(partition.multi_index(proof.cell[box]), axis=-1)
    place = proof.place[box] + rng.random((RUNS, partition.dimension))
    x = partition.low + (index + place / 2.0 ** proof.split[box]) * partition.width
    runs = result.closed_loop.compiled.run(x, int(proof.level.max()) + 1, rng, Deadline())
    return float(runs.cost.mean())


def drawn(rows: list[Row], result: lm.Result, proof: Any, path: Path) -> None:
    """Draw the rows, and maps of the last one."""
    from lmdsl.plotting import layers

    page = layers.blank(3, 1)
    ax = page.add_subplot(1, 3, 1)
    cells = [row.cells for row in rows]
    for name, label, style in (
        ("above", "this controller costs at most", "v-"),
        ("mean", "mean of runs", "o--"),
        ("below", "any law costs at least", "^-"),
    ):
        ax.plot(cells, [getattr(row, name) for row in rows], style, label=label)
    ax.fill_between(cells, [r.below for r in rows], [r.above for r in rows], alpha=0.12)
    ax.set_xscale("log")
    ax.set_xticks(cells, [str(n) for n in cells])
    ax.minorticks_off()
    ax.set_ylim(0, None)
    ax.set_xlabel("cells an axis")
    ax.set_title("average cost over what arrives", fontsize=11)
    ax.set_box_aspect(1)
    ax.legend(fontsize=8)
    lm.plotting.bracket(result, proof, "below", page.add_subplot(1, 3, 2))
    lm.plotting.bracket(result, proof, "above", page.add_subplot(1, 3, 3))
    page.savefig(path, dpi=110)


def main() -> None:
    """Print the table and draw it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bracket")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--cells", default="50,100,200,400")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows: list[Row] = []
    print("| cells an axis | model | arrives | at least | runs | at most | parts | followed | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for n in map(int, asked.cells.split(",")):
        row, result, proof = measured(n, asked.seconds)
        rows.append(row)
        print(
            f"| {row.cells} | {row.model:.3f} | {100 * row.arrives:.2f} % | {row.below:.3f} | "
            f"{row.mean:.3f} | {row.above:.3f} | {row.parts:,} | {row.followed:,} | "
            f"{row.seconds:.0f} |",
            flush=True,
        )
    if asked.out is not None:
        drawn(rows, result, proof, asked.out)


if __name__ == "__main__":
    main()

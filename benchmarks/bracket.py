"""How the bracket of the optimal cost shrinks with the cells, on the standard map.

``python -m benchmarks.bracket [--seconds S] [--cells 50,100] [--out FILE]`` prints a table and
draws it into FILE, with maps of the bracket by cell. Upper bounds begin with nothing
but the attractor: what has one is proved to arrive, as no state leaves the torus and C and A are
all of it. Averages are over these parts; random states of them are followed by the true map.
"""

import argparse
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import lmdsl as lm
from lmdsl.common.types import Floats
from lmdsl.machine.deadline import Deadline
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.bounds.flights.following import Flights
from lmdsl.proof.bounds.flights.refining import SLACK, Above, refine
from lmdsl.proof.bounds.optimum.averages import means
from lmdsl.proof.bounds.optimum.bracket import bound
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.proof.loop import Loop
from lmdsl.proof.search import UNDECIDED
from lmdsl.results.directory.proved import loop_of

RUNS = 200_000
WIDER = 2.0**-36  # by how much images are widened, in cells


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


class Found(NamedTuple):
    """A row, and the bounds by cell, shape (N,)."""

    row: Row
    below: Floats
    above: Floats


def undecided(loop: Loop) -> dict[str, Any]:
    """Return cells as boxes of which nothing is known."""
    cell = np.flatnonzero(loop.status != CellStatus.ATTRACTOR)
    none = np.zeros((len(cell), loop.partition.dimension), dtype=np.int64)
    zero = np.zeros(len(cell))
    return {"cell": cell, "split": none, "place": none, "cost": zero, "lower": zero,
            "class": np.full(len(cell), UNDECIDED, dtype=np.uint8)}  # fmt: skip


def measured(cells: int, seconds: float | None) -> Found:
    """Return what is found in some seconds."""
    data: dict[str, Any] = dict(lm.systems.StandardMap.problem)
    box = {name: {**axis, "cells": cells} for name, axis in data["state_box"].items()}
    result = lm.solve(lm.Problem.model_validate({**data, "state_box": box, "gamma": 1.02}))
    loop, began = loop_of(result), time.monotonic()
    half = None if seconds is None else 0.5 * seconds
    above = refine(Flights(loop, WIDER, SLACK), undecided(loop), Deadline(half), None)
    assert above is not None
    assert result.cost is not None
    boxes, cost = arriving(loop, above)
    first = np.full(loop.partition.size, np.inf)
    np.minimum.at(first, boxes["cell"], cost)
    best = bound(loop, 2.0 * float(cost.max()), np.argsort(first, kind="stable"), Deadline(half),
                 None, WIDER)  # fmt: skip
    low = means(best.split, best.bound, loop.partition, boxes)
    share = len(cost) / loop.cells / 2.0 ** above.split.sum()
    row = Row(
        cells, result.cost, share, float(low.mean()), mean_cost(result, boxes),
        float(cost.mean()), len(best.bound), len(above.bound), time.monotonic() - began,
    )  # fmt: skip
    count = np.bincount(boxes["cell"], minlength=loop.partition.size)
    with np.errstate(invalid="ignore"):
        maps = (np.bincount(boxes["cell"], x, loop.partition.size) / count for x in (low, cost))
        return Found(row, *maps)


def arriving(loop: Loop, above: Above) -> tuple[dict[str, Any], Floats]:
    """Return the parts that arrive as boxes, and their upper bounds."""
    parts = Parts.of(loop.partition, above.split.astype(np.int64))
    some = np.flatnonzero(np.isfinite(above.bound))
    cell = parts.cell(loop.partition, some)
    inside = loop.status[cell] == CellStatus.STABILIZED
    some, cell = some[inside], cell[inside]
    place = parts.by_axis(some) & ((1 << parts.split) - 1)
    boxes = {"cell": cell, "split": np.broadcast_to(above.split, place.shape),
             "place": place.astype(np.uint32)}  # fmt: skip
    return boxes, above.bound[some].astype(np.float64)


def mean_cost(result: lm.Result, boxes: dict[str, Any]) -> float:
    """Return the mean cost of runs of the true map from random states of boxes of one size."""
    rng, partition = np.random.default_rng(0), result.partition
    box = rng.integers(len(boxes["cell"]), size=RUNS)
    index = np.stack(partition.multi_index(boxes["cell"][box]), axis=-1)
    place = boxes["place"][box] + rng.random((RUNS, partition.dimension))
    x = partition.low + (index + place / 2.0 ** boxes["split"][box]) * partition.width
    runs = result.closed_loop.compiled.run(x, 10_000, rng, Deadline())
    assert (runs.outcome == 0).all()
    return float(runs.cost.mean())


def drawn(found: list[Found], path: Path) -> None:
    """Draw the rows, and maps of the second one, or the last."""
    from lmdsl.plotting import layers

    page = layers.blank(3, 1)
    ax = page.add_subplot(1, 3, 1)
    rows = [each.row for each in found]
    cells = [row.cells for row in rows]
    for name, label, style in (
        ("above", "this controller costs at most", "v-"),
        ("mean", "mean of runs", "o--"),
        ("below", "any law costs at least", "^-"),
    ):
        ax.plot(cells, [getattr(row, name) / row.mean for row in rows], style, label=label)
    ends = ([r.below / r.mean for r in rows], [r.above / r.mean for r in rows])
    ax.fill_between(cells, *ends, alpha=0.12)
    ax.set_xscale("log")
    ax.set_xticks(cells, [str(n) for n in cells])
    ax.minorticks_off()
    ax.set_ylim(0, None)
    ax.set_xlabel("cells an axis")
    ax.set_title("average cost, by the mean of runs", fontsize=11)
    ax.set_box_aspect(1)
    ax.legend(fontsize=8)
    mapped = found[min(1, len(found) - 1)]
    side = mapped.row.cells
    for k, name in enumerate(("below", "above")):
        ax = page.add_subplot(1, 3, k + 2)
        values = getattr(mapped, name).reshape(side, side)
        picture = ax.imshow(values.T, origin="lower", extent=(0, 1, 0, 1), vmin=0,
                            vmax=float(np.nanquantile(mapped.above, 0.99)))  # fmt: skip
        ax.set_title(("any law costs at least", "this controller costs at most")[k], fontsize=11)
        ax.set_xlabel("x")
        ax.set_ylabel("y")
        layers.bar(ax, picture, "cost")
    page.savefig(path, dpi=110)


def main() -> None:
    """Print the table and draw it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bracket")
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--cells", default="50,100,200,400")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    found: list[Found] = []
    print("| cells an axis | model | arrives | at least | runs | at most | parts | followed | s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for n in map(int, asked.cells.split(",")):
        found.append(measured(n, asked.seconds))
        row = found[-1].row
        print(
            f"| {row.cells} | {row.model:.3f} | {100 * row.arrives:.2f} % | {row.below:.3f} | "
            f"{row.mean:.3f} | {row.above:.3f} | {row.parts:,} | {row.followed:,} | "
            f"{row.seconds:.0f} |",
            flush=True,
        )
    if asked.out is not None:
        drawn(found, asked.out)


if __name__ == "__main__":
    main()

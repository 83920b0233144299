"""What is known of the cells, as arrays that a page draws; large grids are sampled.

``full`` grids come whole. Of larger ones the page gets every k-th cell of every axis, k the least
that leaves MOST_DRAWN; the controls and statuses of all cells come along while there are at most
MOST_FULL, so that runs can be followed.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Statuses
from lmdsl.explanation.one_cell import NAMES
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.record import Proof
from lmdsl.proof.search import ARRIVES, LOST, UNDECIDED
from lmdsl.report.browser import packed
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status

MOST_DRAWN = 250_000  # cells of which values are given
MOST_FULL = 2_000_000  # cells of which controls and statuses are given
MOST_CONTROLS = 4  # controls that are drawn

# What a region is called, how light it is (0 black, 1 white), and the mark that tells it apart
# where there is no colour; see plotly's marker symbols.
REGIONS: dict[int, tuple[str, float, str]] = {
    CellStatus.ATTRACTOR: ("attractor A", 1.0, ""),
    CellStatus.ESCAPES: (NAMES[CellStatus.ESCAPES], 0.80, "line-ne-open"),
    CellStatus.TRAPPED: (NAMES[CellStatus.TRAPPED], 0.68, "circle"),
    CellStatus.LEADS_TO_THESE: (NAMES[CellStatus.LEADS_TO_THESE], 0.90, "line-nw-open"),
    CellStatus.AVOID: ("avoid Z", 0.30, "x-thin-open"),
    CellStatus.BEYOND_GAMMA: ("no finite cost", 0.74, "line-ew-open"),
}


def cells_of(result: Result, proof: Proof | None) -> dict[str, Any]:
    """Return the cells of a result as plain data, with every layer that can be drawn."""
    p = result.partition
    step = _step(p.shape)
    shown = np.arange(p.size).reshape(p.shape)
    middle = tuple(slice(min(step // 2, n - 1), None, step) for n in p.shape)
    shown = shown[middle]
    whole = p.size <= MOST_FULL
    own = slice(None) if whole else shown.ravel()
    index = result.control_index[own] + 1  # 0: none
    code = regions_of(result)
    return {
        "axes": [
            {"name": name, "low": axis.low, "high": axis.high, "width": axis.width,
             "cells": int(axis.cells), "periodic": bool(axis.periodic)}
            for name, axis in zip(p.names, p.axes, strict=True)
        ],
        "clip": p.clip,
        "numbered": p.numbered,
        "step": step,
        "drawn": list(shown.shape),
        "whole": whole,
        "status": packed(code[own]),
        "index": packed(index.astype(np.uint16 if len(result.control_vectors) < 65535
                                     else np.int32)),
        "controls": list(result.problem.controls),
        "vectors": packed(result.control_vectors),
        "regions": _regions(code),
        "layers": _layers(result, proof, shown.ravel()),
    }  # fmt: skip


def _step(shape: tuple[int, ...]) -> int:
    step = 1
    while np.prod([-(-n // step) for n in shape], dtype=float) > MOST_DRAWN:
        step += 1
    return step


def regions_of(result: Result) -> Statuses:
    """Return what every cell is: its status, or that a refusal speaks of it, shape (N,)."""
    code = result.cell_status.copy()
    if result.cause == Cause.GAMMA:
        refused = (code == CellStatus.STABILIZED) & (result.refusal_vector > 0)
        code[refused] = CellStatus.BEYOND_GAMMA
    return code


def _regions(code: Statuses) -> list[dict[str, Any]]:
    """Return the regions that occur, but the stabilized cells: those are coloured by value."""
    counts = np.bincount(code, minlength=len(CellStatus))
    return [
        {"code": int(code), "name": name, "light": light, "mark": mark, "cells": int(counts[code])}
        for code, (name, light, mark) in REGIONS.items()
        if counts[code]
    ]


def _layers(result: Result, proof: Proof | None, shown: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Return what can be drawn over the cells shown: title, words and values."""
    on = (result.cell_status == CellStatus.STABILIZED)[shown]
    found: list[dict[str, Any]] = []

    def add(key: str, title: str, words: str, values: NDArray[Any], **more: Any) -> None:
        drawn = np.where(on & np.isfinite(values), values, np.nan).astype(np.float32)
        if np.isfinite(drawn).any():
            scale = _logarithmic(drawn)
            found.append({"key": key, "title": title, "words": words, "log": scale,
                          "values": packed(drawn), **more})  # fmt: skip

    solved = result.status != Status.NOT_STABILIZABLE
    if solved:
        add("value", "cost-to-go V", "at most what a run from the cell costs in the mean",
            result.value[shown])  # fmt: skip
        for k, name in enumerate(result.problem.controls[:MOST_CONTROLS]):
            index = result.control_index[shown]
            values = np.where(index >= 0, result.control_vectors[index, k], np.nan)
            add(f"control {k}", f"control {name}", "what the feedback law chooses", values,
                level=True)  # fmt: skip
        add("lower", "lower bound W", "no control law of the finite model costs less",
            result.lower[shown])  # fmt: skip
        if result.measure.any():
            add("measure", "Lyapunov measure", "mean number of visits of a run that starts by m",
                result.measure[shown])  # fmt: skip
    if result.sure_levels is not None:
        levels = np.where(result.sure_levels > 0, result.sure_levels, np.nan)
        add("sure", "sure arrival", "within how many steps some controller surely arrives",
            levels[shown])  # fmt: skip
    if proof is not None:
        for key, (title, words, values) in proved(result, proof).items():
            add(key, title, words, values[shown], share=True)
    if not found:  # nothing was solved: the causes are drawn
        found.append({"key": "none", "title": "cells by cause", "log": False,
                      "words": "no control law was found",
                      "values": packed(np.full(len(shown), np.nan, dtype=np.float32))})  # fmt: skip
    return found


def proved(result: Result, proof: Proof) -> dict[str, tuple[str, str, Floats]]:
    """Return what is proved of the true map by cell: shares of the volume of each, (N,)."""
    volume = 2.0 ** -proof.split.astype(np.float64).sum(axis=1)
    kinds = {
        "arrives": (ARRIVES, "proved to arrive", "share of the cell's volume, on the true map"),
        "lost": (LOST, "proved to be lost", "share of the cell's volume, on the true map"),
        "undecided": (UNDECIDED, "undecided", "share of the cell's volume without a proof"),
    }
    found: dict[str, tuple[str, str, Floats]] = {}
    for key, (state, title, words) in kinds.items():
        own = proof.kind == state
        share: Floats = np.bincount(
            proof.cell[own], volume[own], minlength=result.partition.size
        ).astype(np.float64)
        if key == "arrives" or share.any():
            found[key] = (title, words, share)
    if proof.maps is not None:
        found["below"] = ("no law costs less", "of what arrives in the cell, on the true map",
                          proof.maps[0])  # fmt: skip
        found["above"] = ("true cost at most", "of what arrives in the cell, under this law",
                          proof.maps[1])  # fmt: skip
    return found


def _logarithmic(values: NDArray[np.float32]) -> bool:
    """Return whether values span more than two decades, so that their logarithms are drawn."""
    known = values[np.isfinite(values)]
    positive = known[known > 0]
    if not len(positive) or len(positive) < 0.5 * len(known) or (known < 0).any():
        return False
    return bool(np.quantile(positive, 0.99) > 100 * np.quantile(positive, 0.01))

"""Compile, solve and verify in a fresh process: time of each stage, peak memory and estimates."""

from __future__ import annotations

import time
from typing import Any

import lmdsl as lm
from benchmarks import internals, models
from benchmarks.process import peak


def run(name: str, gamma: float | None, repeats: int) -> dict[str, Any]:
    """Run the pipeline on a model with the kernels loaded; all times in seconds."""
    lm.solve(models.get(models.WARM).compiled(gamma))
    base = peak()
    times: dict[str, list[float]] = {"compile": [], "solve": [], "verify": [], "total": []}
    result = None
    for _ in range(repeats):
        result = lp = None  # only one model at a time
        started = time.perf_counter()
        with internals.estimates() as seen:
            lp = models.get(name).compiled(gamma)
        compiled = time.perf_counter()
        result = lm.solve(lp)
        ended = time.perf_counter()
        times["compile"].append(compiled - started)
        times["solve"].append(result.seconds.solve or 0.0)
        times["verify"].append(result.seconds.verify or 0.0)
        times["total"].append(ended - started)
    assert result is not None
    used = peak()  # before the transitions are copied to be counted
    return {
        "model": name,
        "gamma": result.gamma,
        "status": result.status,
        "gap": result.gap,
        "cells": result.cells,
        "pairs": result.pairs,
        "transitions": len(internals.transitions(result.lp)[1]),
        "seconds": times,
        "base": base,
        "peak": used,
        "estimates": seen,
    }


def bracket(name: str, width: float, repeats: int) -> dict[str, Any]:
    """Enclose gamma_bar of a model, with the kernels loaded; all times in seconds."""
    lm.gamma_max(models.get(models.WARM).compiled(1.0))
    lp = models.get(name).compiled(1.0)
    times: dict[str, list[float]] = {"compile": [0.0], "total": []}
    for _ in range(repeats):
        lp = internals.cold(lp)
        started = time.perf_counter()
        found = lm.gamma_max(lp, width=width)
        times["total"].append(time.perf_counter() - started)
    return {"model": name, "gamma_bar": [found.low, found.high], "seconds": times}

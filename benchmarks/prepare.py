"""Compile a model once, certify its value, and write what the contestants load."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

import lmdsl as lm
from benchmarks import internals, models
from benchmarks.arrays import Arrays

GAP = 1e-8


def prepare(name: str, gamma: float, folder: str) -> dict[str, Any]:
    """Write ``model.npz`` and ``warm.npz`` into a folder; return the facts of the model.

    Raises
    ------
    RuntimeError
        lmdsl proves no tight bounds of the value: there is nothing to compare with.
    """
    _write(models.WARM, gamma, Path(folder) / "warm.npz")
    return _write(name, gamma, Path(folder) / "model.npz")


def _write(name: str, gamma: float, path: Path) -> dict[str, Any]:
    started = time.perf_counter()
    lp = models.get(name).compiled(gamma)
    seconds = time.perf_counter() - started
    result = lm.solve(lp, tolerance=GAP)
    proof = result.certificate
    if not (proof.upper_bound and proof.lower_bound and proof.gap is not None and proof.gap <= GAP):
        raise RuntimeError(f"no certified value to compare with: {result.status}, {result.message}")
    pointer, target, share = _merged(lp)
    Arrays(
        name, gamma, lp.digest, lp.pair_pointer, lp.control, pointer, target, share, lp.cost,
        result.lower[lp.cells], result.value[lp.cells],
    ).save(path)  # fmt: skip
    return {
        "model": name,
        "gamma": gamma,
        "digest": lp.digest,
        "cells": lp.partition.size,
        "stabilizable": lp.n,
        "pairs": lp.K,
        "transitions": len(target),
        "status": result.status,
        "cost": result.cost,
        "gap": proof.gap,
        "first_compile": seconds,
    }


def _merged(lp: lm.StabilizationLP) -> tuple[Any, Any, Any]:
    """Return pointer, target and share with each target once per row and ascending."""
    from scipy.sparse import csr_array

    pointer, target, share = internals.transitions(lp)
    P = csr_array((share, target.copy(), pointer.copy()), shape=(lp.K, lp.n + 1))
    P.sum_duplicates()
    return P.indptr.astype(np.int64), P.indices.astype(np.int32), P.data

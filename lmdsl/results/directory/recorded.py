"""What a directory says of recorded data, compared with what follows from its rows anew."""

import math
from dataclasses import fields
from typing import Any

import numpy as np

from lmdsl.common.types import Policy
from lmdsl.data.report import DataReport
from lmdsl.model.lp import StabilizationLP
from lmdsl.results.result import Result
from lmdsl.systems import DataSystem


def policy_of(lp: StabilizationLP, result: Result) -> Policy | None:
    """Return the columns of the stored controls, None where one is no surviving pair."""
    wanted = result.control_index[lp.cells]
    M = len(lp.controls)
    key = lp.cell.astype(np.int64) * M + lp.control
    target = np.arange(lp.n, dtype=np.int64) * M + wanted
    policy = np.minimum(np.searchsorted(key, target), max(lp.K - 1, 0))
    if not lp.K or (wanted < 0).any() or (key[policy] != target).any():
        return None
    return policy


def data_differences(lp: StabilizationLP, result: Result) -> list[str]:
    """Report on the data again, and compare every figure."""
    stored, found = result.data, None
    if isinstance(result.problem.system, DataSystem):
        found = DataReport.of(lp, policy_of(lp, result))
    if stored is None or found is None:
        return [] if stored is found else [f"data is stored as {stored}, but is {found}"]
    return [
        f"data.{field.name} is stored as {ours!r}, but is {theirs!r}"
        for field in fields(DataReport)
        if not _WEAK.get(field.name, _alike)(
            ours := getattr(stored, field.name), theirs := getattr(found, field.name)
        )
    ]


def _wider(stored: Any, found: Any) -> bool:
    """Return whether a stored range says no more than the one found."""
    if stored is None or found is None:
        return stored is found
    (low, high), (least, most) = stored, found
    lower = low is not None and low <= least * (1 + 1e-9)
    return lower and (high is None or (most is not None and high >= most * (1 - 1e-9)))


def _alike(a: Any, b: Any) -> bool:
    """Return whether two figures, or two of each, are the same but for rounding."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_alike, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-9)
    return bool(a == b)


def _no_less(stored: Any, found: Any) -> bool:
    """Return whether a stored upper limit says no more than the one found."""
    if stored is None or found is None:
        return stored is found
    return bool(found * (1 - 1e-9) <= stored <= 1)


_WEAK = {"cost": _wider, "unseen_in_a_run": _no_less}

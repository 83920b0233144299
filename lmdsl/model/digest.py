"""The identity of a compiled model."""

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP


def digest_of(lp: "StabilizationLP") -> str:
    """Return the SHA-256 of statuses, pairs, exact transitions, costs, gamma, m and controls."""
    sha = hashlib.sha256(b"lmdsl model 1\n")
    shares = lp.rows.shares
    below = [*shares.denominator] if shares.total is None else shares.total
    sha.update(repr((below, [*shares.numerator])).encode())
    sha.update(np.array([lp.gamma], dtype="<f8").tobytes())
    for array, kind in (
        (lp.cell_status, "<u1"), (lp.pair_pointer, "<i8"), (lp.control, "<i4"),
        (lp.rows.pointer, "<i8"), (lp.rows.target, "<i4"), (lp.rows.code, "<u4"),
        (lp.cost, "<f8"), (lp.weight, "<f8"), (lp.controls, "<f8"),
    ):  # fmt: skip
        for part in np.array_split(array.ravel(), max(1, array.size // 2**22)):
            sha.update(np.ascontiguousarray(part, dtype=kind).tobytes())
    if lp.hold is not None:
        sha.update(b"hold" + np.ascontiguousarray(lp.hold, dtype="<i4").tobytes())
    return sha.hexdigest()

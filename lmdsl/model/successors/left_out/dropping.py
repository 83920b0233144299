"""Pairs that are left out of a model, before its stabilizable set is found.

A model without some pairs is a model of its own: its policies are those of the whole one that do
not use these pairs, and what is proved of it is proved of them.
"""

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices
from lmdsl.errors import BadInput
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.transitions import Transitions


def left_out(
    dropped: Any, transitions: Transitions, controls: int
) -> tuple[NDArray[np.int64] | None, Bools | None]:
    """Return pairs (cell, control) in order, each once, and which pairs are not among them.

    BadInput: they are no pairs of the transitions.
    """
    pairs = listed(dropped, len(transitions.sets.number), controls)
    cells = transitions.sets.free
    return pairs, None if pairs is None else others(pairs, transitions, controls, cells)


def listed(pairs: Any, cells: int, controls: int) -> NDArray[np.int64] | None:
    """Return pairs (cell, control) in order, each once; None where there are none."""
    found = np.asarray([] if pairs is None else pairs)
    if found.size == 0:
        return None
    if found.ndim != 2 or found.shape[1] != 2 or not np.issubdtype(found.dtype, np.integer):
        raise BadInput(
            f"shape {found.shape} of {found.dtype}; give rows (cell, control) of integers",
            "dropped",
        )
    found = found.astype(np.int64)
    if not ((found >= 0) & (found < (cells, controls))).all():
        raise BadInput(
            f"a pair lies outside 0..{cells - 1} cells and 0..{controls - 1} controls; remove it",
            "dropped",
        )
    return np.unique(found, axis=0)


def others(pairs: Indices, transitions: Transitions, controls: int, cells: Indices) -> Bools:
    """Return which of the pairs of some cells are not among those given."""
    cell = cells[owner(transitions.pair_pointer)]
    key = cell.astype(np.int64) * controls + transitions.control
    wanted = pairs[:, 0] * controls + pairs[:, 1]
    at = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
    missing = np.ones(len(wanted), dtype=np.bool_) if not len(key) else key[at] != wanted
    if missing.any():
        cell, control = pairs[np.argmax(missing)]
        raise BadInput(
            f"(cell {cell}, control {control}) is no pair of the problem; remove it", "dropped"
        )
    left = np.ones(len(key), dtype=np.bool_)
    left[at] = False
    return left


def list_sha256(pairs: NDArray[np.int64] | None) -> str:
    """Return the SHA-256 of a list of pairs, empty for none."""
    if pairs is None:
        return ""
    return hashlib.sha256(np.ascontiguousarray(pairs, dtype="<i8").tobytes()).hexdigest()

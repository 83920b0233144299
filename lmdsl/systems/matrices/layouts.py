"""How matrices of transition probabilities are laid out, and read into a listing.

states     (A, S, S): a matrix for each action, dense, or a list of dense or sparse ones
product    (S, A, S), dense
pairs      (Q, s_indices, a_indices), a row of Q for each pair; or Q alone, (S A, S), row s A + a
gymnasium  P[s][a] is a list of (probability, next state, reward, terminated)
drn        a file of the model checker Storm, see drn.py
"""

import os
from collections.abc import Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Indices
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.systems.matrices.listing import MOST, Listing, fill

LAYOUTS = ("states", "product", "pairs", "gymnasium", "drn")
KNOWN = f"write one of auto, {', '.join(LAYOUTS)}"
MOST_DIGITS = 1000
"""Characters of a fraction that is written as text."""


def layout_of(P: Any, layout: Any) -> str:
    """Return the layout of matrices; ``auto`` looks at their shape.

    Raises
    ------
    BadInput
        The shape fits none, or two.
    """
    if layout in LAYOUTS:
        return str(layout)
    if layout != "auto":
        raise BadInput(f"{shown(layout)} is unknown; {KNOWN}", "layout")
    if isinstance(P, str | os.PathLike):
        return "drn"
    if hasattr(P, "unwrapped"):
        raise BadInput("this is an environment; give its table, env.unwrapped.P", "P")
    if isinstance(P, Mapping):
        return "gymnasium"
    if is_sparse(P) or _is_triple(P):
        return "pairs"
    if isinstance(P, list | tuple) and any(map(is_sparse, P)):
        return "states"
    shape = shape_of(dense(P))
    if len(shape) == 2:
        return "pairs"
    fits = {"states": shape[1:2] == shape[2:3], "product": shape[:1] == shape[2:3]}
    found = [name for name, fit in fits.items() if fit and len(shape) == 3]
    if len(found) == 2:
        raise BadInput(
            f'shape {shape} fits two layouts; write layout="states" for (A, S, S) or '
            '"product" for (S, A, S)',
            "layout",
        )
    if not found:
        raise BadInput(f"shape {shape} fits no layout; {KNOWN}", "P")
    return found[0]


def read_arrays(P: Any, layout: str) -> Listing:
    """Read matrices in one of the layouts of arrays."""
    if layout == "pairs":
        return _of_pairs(P)
    if layout == "product":
        return _of_product(numbers(dense(P), "P"))
    matrices = [P[a] for a in range(len(P))] if isinstance(P, list | tuple) else numbers(P, "P")
    if not len(matrices):
        raise BadInput("there is no matrix; give one for each action", "P")
    parts = [coordinates(matrix, "P") for matrix in matrices]
    S = parts[0][0][1]
    for a, (shape, *_) in enumerate(parts):
        if shape != (S, S):
            raise BadInput(f"the matrix of action {a} has shape {shape}, not {(S, S)}", "P")
    A = len(parts)
    _require(S, A, S * A)
    pair = [row * A + a for a, (_, row, _, _) in enumerate(parts)]
    share = [values for *_, values in parts]
    return Listing(
        states=S,
        actions=A,
        state=np.repeat(np.arange(S), A),
        action=np.tile(np.arange(A), S),
        pair=np.concatenate(pair),
        target=np.concatenate([column for _, _, column, _ in parts]),
        share=_alike(share),
    )


def read_gymnasium(P: Any) -> Listing:
    """Read a dictionary of dictionaries of lists of transitions."""
    state, action, pair, target = [], [], [], []
    share: list[Any] = []
    value, ends = [], []
    for s, actions in _items(P):
        for a, transitions in _items(actions):
            state.append(inputs.whole(s, "P", 0))
            action.append(inputs.whole(a, "P", 0))
            if not isinstance(transitions, list | tuple):
                raise BadInput(f"P[{s}][{a}] is {shown(transitions)}, no list of transitions", "P")
            for entry in transitions:
                try:
                    probability, after, reward, terminated = entry
                except (TypeError, ValueError):
                    raise BadInput(
                        f"P[{s}][{a}] holds {shown(entry)}; a transition is (probability, next "
                        "state, reward, terminated)",
                        "P",
                    ) from None
                pair.append(len(state) - 1)
                target.append(inputs.whole(after, "P", 0))
                share.append(probability)
                value.append(reward)
                ends.append(bool(terminated))
    if not state:
        raise BadInput("there is no state; give {state: {action: [transitions]}}", "P")
    S, A = max(*state, *target, 0) + 1, max(action) + 1
    _require(S, A, len(state))
    return Listing(
        states=S,
        actions=A,
        state=np.array(state, dtype=np.int64),
        action=np.array(action, dtype=np.int64),
        pair=np.array(pair, dtype=np.int64),
        target=np.array(target, dtype=np.int64),
        share=numbers(fill(len(share), lambda x: x, share), "P"),
        value=doubles(fill(len(value), lambda x: x, value), "P"),
        ends=np.array(ends, dtype=np.bool_),
    )


def _items(mapping: Any) -> list[tuple[Any, Any]]:
    if isinstance(mapping, Mapping):
        return list(mapping.items())
    if isinstance(mapping, Sequence) and not isinstance(mapping, str):
        return list(enumerate(mapping))
    raise BadInput(f"{shown(mapping)} is not accepted; give {{state: {{action: [...]}}}}", "P")


def _of_product(P: NDArray[Any]) -> Listing:
    if P.ndim != 3 or P.shape[0] != P.shape[2]:
        raise BadInput(f"has shape {P.shape}, not (S, A, S)", "P")
    S, A, _ = P.shape
    _require(S, A, S * A)
    state, action, target = np.nonzero(P != 0)
    return Listing(
        states=S,
        actions=A,
        state=np.repeat(np.arange(S), A),
        action=np.tile(np.arange(A), S),
        pair=state * A + action,
        target=target,
        share=P[state, action, target],
    )


def _of_pairs(P: Any) -> Listing:
    Q, indices = (P[0], P[1:]) if _is_triple(P) else (P, None)
    (K, S), row, column, share = coordinates(Q, "P")
    if indices is not None:
        state, action = (_indices(x, K) for x in indices)
        A = int(action.max(initial=0)) + 1
    elif S and K % S == 0:
        A = K // S
        state, action = np.repeat(np.arange(S), A), np.tile(np.arange(A), S)
    else:
        raise BadInput(
            f"{K} rows for {S} states: row s A + a is state s and action a, so there are as many "
            "for each state; else give (Q, s_indices, a_indices)",
            "P",
        )
    _require(S, A, K)
    return Listing(S, A, state, action, row, column, share)


def _indices(values: Any, count: int) -> Indices:
    array = np.asarray(values)
    if array.shape != (count,) or array.dtype.kind not in "iu":
        raise BadInput(f"s_indices and a_indices are {count} whole numbers, one per row of Q", "P")
    return array.astype(np.int64)


def _is_triple(P: Any) -> bool:
    """Return whether this is (Q, s_indices, a_indices)."""
    return (
        isinstance(P, tuple | list)
        and len(P) == 3
        and not any(map(is_sparse, P[1:]))
        and len(shape_of(P[1])) == 1 == len(shape_of(P[2]))
        and len(shape_of(P[0])) == 2
    )


# Arrays ---------------------------------------------------------------------------------------


def is_sparse(x: Any) -> bool:
    """Return whether this is a sparse matrix or array."""
    return hasattr(x, "tocoo") and hasattr(x, "shape")


def shape_of(x: Any) -> tuple[int, ...]:
    """Return the shape of what may be an array; () of what is none."""
    try:
        return tuple(int(k) for k in np.shape(x))
    except (ValueError, TypeError):  # ragged
        return ()


def dense(x: Any) -> Any:
    """Return an array of what is none yet; ragged lists are refused."""
    if isinstance(x, np.ndarray):
        return x
    try:
        return np.array(x)
    except ValueError as error:
        raise BadInput(f"is no array: {shown(str(error))}", "P") from None


def coordinates(x: Any, where: str) -> tuple[tuple[int, int], Indices, Indices, NDArray[Any]]:
    """Return shape, rows, columns and values of what is not 0 in a matrix."""
    if is_sparse(x):
        coo = x.tocsr().tocoo()
        row, column, values = coo.row, coo.col, numbers(coo.data, where)
    else:
        matrix = numbers(x, where)
        if matrix.ndim != 2:
            raise BadInput(f"holds an array of shape {matrix.shape} and no matrix", where)
        row, column = np.nonzero(matrix != 0)
        values = matrix[row, column]
    K, S = shape_of(x)
    return (K, S), row.astype(np.int64), column.astype(np.int64), values


def numbers(x: Any, where: str) -> NDArray[Any]:
    """Return an array of doubles; of Fractions where all numbers were given exactly."""
    if isinstance(x, np.ma.MaskedArray) and np.ma.is_masked(x):
        raise BadInput("the numbers are masked in places; fill them", where)
    try:
        array = np.asarray(x)
    except ValueError as error:
        raise BadInput(f"is no array: {shown(str(error))}", where) from None
    if array.dtype.kind in "fiub":
        return array.astype(np.float64)
    if array.dtype.kind not in "OUS":
        raise BadInput(f"holds {array.dtype.name}; real numbers are needed", where)
    flat = array.ravel().tolist()
    if any(isinstance(v, float | np.floating) for v in flat):
        try:
            return array.astype(np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise BadInput(f"holds {shown(str(error))}; numbers are needed", where) from None
    return fill(len(flat), lambda v: exactly(v, where), flat).reshape(array.shape)


def doubles(x: Any, where: str) -> Floats:
    """Return numbers as doubles."""
    try:
        return np.asarray(numbers(x, where), dtype=np.float64)
    except OverflowError:
        raise BadInput("holds a number beyond the range of doubles", where) from None


def exactly(value: Any, where: str) -> Fraction:
    """Return a number as it was written: a Fraction, an integer, a Decimal or text."""
    text = value if isinstance(value, str) else None
    if text is not None and not (len(text) <= MOST_DIGITS and "e" not in text.lower()):
        raise BadInput(f"{shown(value)} is no fraction; write 1/3 or 0.25", where)
    try:
        if isinstance(value, int | Fraction | str | np.integer):
            return Fraction(int(value) if isinstance(value, np.integer) else value)
        if isinstance(value, Decimal) and value.is_finite() and abs(value.adjusted()) < 1000:
            return Fraction(value)
    except (ValueError, ZeroDivisionError):
        pass
    raise BadInput(f"{shown(value)} is no number", where)


def _alike(parts: list[NDArray[Any]]) -> NDArray[Any]:
    if any(part.dtype == np.float64 for part in parts):
        parts = [doubles(part, "P") for part in parts]
    return np.concatenate(parts)


def _require(S: int, A: int, pairs: int) -> None:
    if not S or not A:
        raise BadInput("there is no state, or no action", "P")
    if max(S, A, pairs) > MOST:
        raise BadInput(f"{S} states, {A} actions and {pairs} pairs; at most {MOST} of each", "P")
    memory.require(64 * (S + pairs), "the rows of a finite model")

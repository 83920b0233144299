"""What callers pass to public functions: whole numbers, and states in any usual container."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.errors import BadInput, shown

# Number above which a count is refused: exact as a double, and more than can ever be done.
MOST = 10**15


def whole(value: Any, where: str, least: int = 1, most: float = MOST) -> int:
    """Return a whole number in a range; else BadInput. Booleans are no numbers."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise BadInput(f"{shown(value)} is not a whole number >= {least}", where)
    number = int(value)
    if number < least:
        raise BadInput(f"{shown(number)} is not a whole number >= {least}", where)
    if number > most:
        raise BadInput(f"{shown(number)} is too large; at most {most:.0g} makes sense", where)
    return number


def is_number(value: Any) -> bool:
    """Return whether something is a real number; booleans are none."""
    return isinstance(value, float | int | np.floating | np.integer) and value is not True


def flag(value: Any, where: str) -> bool:
    """Return True or False; text, numbers and arrays are neither."""
    if not isinstance(value, bool | np.bool_):
        raise BadInput(f"{shown(value)} is neither True nor False", where)
    return bool(value)


def seed(value: Any) -> int:
    """Return a seed of a random generator."""
    return whole(value, "seed", 0, 2**63 - 1)


def path(value: Any, where: str = "path") -> Path:
    """Return a path of the file system."""
    try:
        found = os.fsdecode(value)
    except TypeError:
        raise BadInput(f"{shown(value)} is not a path", where) from None
    if "\0" in found:
        raise BadInput(f"{shown(found)} is not a path: it holds a null character", where)
    return Path(found)


def kind(value: Any, kinds: Any, where: str, wanted: str) -> None:
    """Refuse an argument of another kind, say what is wanted."""
    if not isinstance(value, kinds):
        raise BadInput(f"{shown(value)} is not {wanted}", where)


def indices(value: Any, count: int, where: str, what: str = "cells") -> Indices:
    """Return indices below a count, shape (r,)."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        array = np.empty(0, dtype=object)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise BadInput(f"{shown(value)} are no indices of {what}, shape (r,)", where)
    if array.size and not (array.min() >= 0 and array.max() < count):
        raise BadInput(f"the indices of {what} are 0..{count - 1}", where)
    return array.astype(np.int64, copy=False)


def interval(value: Any, where: str) -> tuple[float, float]:
    """Return two numbers, the first smaller."""
    try:
        low, high = map(float, value)
    except (TypeError, ValueError, OverflowError):
        raise BadInput(f"{shown(value)} is not [a, b]; write two numbers", where) from None
    if not low < high:
        raise BadInput(f"[{low!r}, {high!r}] is empty; write [a, b] with a < b", where)
    return low, high


def states(x: Any, names: Sequence[str], where: str = "") -> Floats:
    """Return states, shape (..., d), in the order of the axes.

    x is an array or nested sequence, shape (..., d); or what carries names: a mapping from axes to
    arrays, a table with these columns, a labelled row or a structured array, in any order.
    BadInput: the names are others, the shape is wrong, or something is no real number.
    """
    d = len(names)
    columns = _columns(x, names, where)
    if columns is not None:
        arrays = [real(column, where) for column in columns]
        try:
            return np.stack(np.broadcast_arrays(*arrays), axis=-1)
        except ValueError:
            shapes = ", ".join(str(array.shape) for array in arrays)
            raise BadInput(f"the columns have different shapes: {shapes}", where) from None
    array = real(x, where)
    if array.shape[-1:] != (d,):
        raise BadInput(f"states have shape (..., {d}), not {array.shape}", where)
    return array


def _columns(x: Any, names: Sequence[str], where: str) -> list[Any] | None:
    """Return what belongs to each axis where x names its parts, None where it has no names."""
    known: list[Any] | None = None
    if isinstance(x, Mapping):
        known = list(x)
    elif getattr(getattr(x, "dtype", None), "names", None):
        known = list(x.dtype.names)
    elif hasattr(x, "columns") and hasattr(x, "to_numpy"):  # a table of pandas or polars
        known = list(x.columns)
    elif hasattr(x, "index") and hasattr(x, "to_numpy"):  # a row of pandas
        known = list(x.index)
    if known is None or (known and known == list(range(len(known)))):  # numbered, not named
        return None
    if any(known.count(name) != 1 for name in names):
        given = ", ".join(map(shown, known[:8])) + (", ..." if len(known) > 8 else "")
        raise BadInput(
            f"the columns are {given}, the axes {', '.join(names)}; pass one column of each name",
            where,
        )
    return [x[name] for name in names]


def real(x: Any, where: str) -> Floats:
    """Return an array of doubles; what is no real number is refused, not converted."""
    if isinstance(x, np.ma.MaskedArray) and np.ma.is_masked(x):
        raise BadInput("the numbers are masked in places; fill them", where)
    try:
        array = np.asarray(x)
        if array.dtype.kind == "O":  # fractions, or a table of mixed types
            numbers = all(isinstance(v, int | float | np.number) and not isinstance(v, bool)
                          for v in array.ravel())  # fmt: skip
            array = array.astype(np.float64) if numbers else array
    except (TypeError, ValueError, OverflowError):
        raise BadInput(f"{shown(x)} is no array of numbers", where) from None
    if array.dtype.kind not in "fiu":
        raise BadInput(
            f"{_said(x)} is no array of numbers: its type is {array.dtype.name}, real numbers "
            "are needed",
            where,
        )
    return np.array(array, dtype=np.float64)


def _said(x: Any) -> str:
    return "this" if isinstance(x, np.ndarray) or hasattr(x, "to_numpy") else shown(x)

"""Records: arrays in them are never written to, two can be compared, all are plain JSON data."""

import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.html import written


def freeze(*arrays: NDArray[Any]) -> None:
    """Make arrays read-only: no caller, and no backend, may change what others hold."""
    for array in arrays:
        array.setflags(write=False)


class Frozen:
    """Base of frozen dataclasses (``eq=False``) that hold arrays.

    Arrays become read-only when a record is made, copied or unpickled. Records are equal when of
    the same class with equal fields, arrays compared by kind, shape and content, NaN as itself.
    Copies and pickles hold the fields alone: what is cached is worked out anew.
    """

    def __post_init__(self) -> None:
        freeze(*(x for x in self.__getstate__().values() if isinstance(x, np.ndarray)))

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if type(self) is not type(other) or not isinstance(other, Frozen):
            return NotImplemented
        return all(map(_equal, self._compared(), other._compared()))

    def __hash__(self) -> int:
        return hash((type(self), *map(_key, self._compared())))

    def _compared(self) -> list[Any]:
        return [getattr(self, field.name) for field in fields(self) if field.compare]  # type: ignore[arg-type]

    def _repr_html_(self) -> str | None:
        return written(self)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        freeze(*(x for x in self.__getstate__().values() if isinstance(x, np.ndarray)))


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        kind = "fc" if a.dtype.kind in "fc" else ""
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=bool(kind))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return a == b or (a != a and b != b)
    return bool(a == b)


def _key(value: Any) -> Any:
    """Return something to hash that is equal for equal parts."""
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str
    if isinstance(value, tuple):
        return tuple(map(_key, value))
    if isinstance(value, float):
        return None if value != value else value
    try:
        hash(value)
    except TypeError:  # a dict, say
        return type(value)
    return value


class Reported:
    """Base of dataclasses that are reported field by field."""

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data: every field by its name."""
        return {f.name: jsonable(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]

    def _repr_html_(self) -> str | None:
        return written(self)


def jsonable(value: Any) -> Any:
    """Return plain data that strict JSON can hold."""
    if hasattr(value, "to_dict"):
        return jsonable(value.to_dict())
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, tuple | list):
        return [jsonable(v) for v in value]
    if isinstance(value, dict):
        return {k: jsonable(v) for k, v in value.items()}
    if isinstance(value, float | np.floating):
        number = float(value)
        if math.isnan(number):
            return None
        return number if math.isfinite(number) else "inf" if number > 0 else "-inf"
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, np.integer):
        return int(value)
    return value


class Unread(NamedTuple):
    """What a field holds until it is read from its file."""

    read: Callable[[], Any]


class Later:
    """A field with the default None that may hold :class:`Unread`."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, record: Any, owner: type) -> Any:
        """Return the value, read by now."""
        if record is None:
            return None  # the default
        held = vars(record)[self.name]
        if isinstance(held, Unread):
            held = vars(record)[self.name] = held.read()
        return held

    def __set__(self, record: Any, value: Any) -> None:
        vars(record)[self.name] = value

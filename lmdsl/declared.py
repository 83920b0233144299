"""The base of everything a user declares: strict, frozen pydantic models with one-line errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
)

from lmdsl.errors import BadInput, shown
from lmdsl.files import joined
from lmdsl.formulas import check_name

_K = TypeVar("_K")
_V = TypeVar("_V")

_FIXES = {
    "bool_type": "write true or false",
    "dict_type": "write an object in braces",
    "extra_forbidden": "unknown key; remove it or correct its spelling",
    "finite_number": "must be a finite number",
    "float_type": "write a number",
    "greater_than": "it must be greater than {gt}",
    "greater_than_equal": "it must be at least {ge}",
    "int_type": "write a whole number",
    "less_than": "it must be less than {lt}",
    "less_than_equal": "it must be at most {le}",
    "literal_error": "write {expected}",
    "missing": "required key is missing; add it",
    "string_type": "write a string",
    "too_long": "at most {max_length} entries are allowed",
    "too_short": "give at least {min_length} of them",
    "tuple_type": "write a list in brackets",
}
"""What to do about each kind of fault that pydantic finds."""


class FrozenDict(dict[_K, _V]):
    """A dict that cannot be changed, so that a declared problem stays what was validated."""

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError("declared objects are frozen; make a new one with model_copy(update=...)")

    __setitem__ = __delitem__ = clear = pop = popitem = setdefault = update = _refuse
    __ior__ = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (dict(self),))


def plain(value: Any) -> Any:
    """Turn NumPy scalars and arrays, lists and mappings into what strict validation accepts."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        return tuple(value)
    if isinstance(value, Mapping) and not isinstance(value, dict):
        return dict(value)
    return value


def _named(value: dict[str, Any]) -> dict[str, Any]:
    for name in value:
        check_name(name)
    return value


Number = Annotated[float, BeforeValidator(plain), Field(allow_inf_nan=False, strict=True)]
"""A finite double; booleans, strings, NaN and infinities are refused."""

Count = Annotated[int, BeforeValidator(plain), Field(strict=True, ge=1, le=10**15)]
"""A whole number of at least 1."""

Seed = Annotated[int, BeforeValidator(plain), Field(strict=True, ge=0, lt=2**63)]
"""A seed of a random generator."""

Numbers = Annotated[tuple[Number, ...], Field(fail_fast=True), BeforeValidator(plain)]
"""A sequence of finite doubles."""

frozen_dict = AfterValidator(FrozenDict)
valid_names = AfterValidator(_named)

Parameters = Annotated[
    dict[str, Number], Field(max_length=1000), BeforeValidator(plain), valid_names, frozen_dict
]
"""Named constants of a system."""

Formulas = Annotated[dict[str, str], BeforeValidator(plain), valid_names, frozen_dict]
"""One formula per state."""

Interval = Annotated[tuple[Number, Number], BeforeValidator(plain)]
Box = Annotated[dict[str, Interval], BeforeValidator(plain), frozen_dict]
"""Axis name to ``[a, b]``; axes left out are unrestricted."""


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


class _Meta(ModelMetaclass):
    """Turns pydantic's report into one BadInput wherever a user constructs a model."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:  # noqa: N805
        if args:
            raise BadInput(f"{cls.__name__} takes keyword arguments only")
        try:
            return super().__call__(**kwargs)
        except ValidationError as error:
            raise bad_input(error) from None


class Declared(BaseModel, metaclass=_Meta):
    """Base model: unknown keys refused, no coercion, frozen, errors as :class:`BadInput`."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True
    )

    @classmethod
    def model_validate(cls, obj: Any, **kwargs: Any) -> Any:
        """Validate plain data; raises :class:`BadInput` with the path of the field at fault."""
        try:
            return super().model_validate(obj, **kwargs)
        except ValidationError as error:
            raise bad_input(error) from None


def _path(location: tuple[int | str, ...]) -> str:
    # Parts in angle brackets are tags of unions (see problem.py), not keys of the file.
    keys = (key for key in location if not (isinstance(key, str) and key.startswith("<")))
    return joined(*(f"[{k}]" if isinstance(k, int) else _key(k) for k in keys))


def _key(key: str) -> str:
    return key if key.isascii() and key.isidentifier() and len(key) <= 64 else shown(key)


def bad_input(error: ValidationError) -> BadInput:
    """Condense a pydantic report into one message: the first fault, and how many more there are."""
    faults = error.errors(include_url=False)
    first = faults[0]
    where = _path(first["loc"])
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, BadInput):
        where, message = joined(where, cause.where), cause.message
    elif first["type"] in ("extra_forbidden", "missing"):
        message = _FIXES[first["type"]]
    else:
        fix = _FIXES.get(first["type"])
        fix = fix.format(**first.get("ctx", {})) if fix else first["msg"]
        given = first["input"]
        given = list(given) if isinstance(given, tuple) else given
        message = f"{shown(given)} is not accepted; {fix}"
    more = len(faults) - 1
    if more:
        message += f" (and {more} more fault{'s' if more > 1 else ''})"
    return BadInput(message, where)

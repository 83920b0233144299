"""The base of everything a user declares: strict, frozen pydantic models with one-line errors."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NoReturn, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.json_schema import GenerateJsonSchema

from lmdsl.common.faults import condensed
from lmdsl.common.files import strict_json
from lmdsl.errors import BadInput

_K = TypeVar("_K")
_V = TypeVar("_V")

FROZEN = "declared objects are frozen; make a new one with problem.replaced(key=value)"


class FrozenDict(dict[_K, _V]):
    """A dict that cannot be changed, so that a declared problem stays what was validated."""

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError(FROZEN)

    __setitem__ = __delitem__ = clear = pop = popitem = setdefault = update = _refuse
    __ior__ = _refuse

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

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


@dataclass(frozen=True, eq=False)
class SchemaWords:
    """Adds words to the JSON Schema of a type, for what only Python code checks."""

    words: Mapping[str, Any]

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {**handler(core), **self.words}


class FileSchema(GenerateJsonSchema):
    """The schema of what a file may hold: no null."""

    def nullable_schema(self, schema: Any) -> Any:
        """Leave null out."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Any:
        """Leave out a default that is null."""
        generated = super().default_schema(schema)
        if generated.get("default", 0) is None:
            del generated["default"]
        return generated


# A bound stands directly behind its type, before any validator: only there does pydantic write it
# as a word of JSON Schema.

# A finite double; booleans, strings, NaN and infinities are refused.
Number = Annotated[float, Field(allow_inf_nan=False, strict=True), BeforeValidator(plain)]

# A finite double above 0.
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True), BeforeValidator(plain)]

# A double above 0 and below 1.
Fractional = Annotated[
    float, Field(gt=0, lt=1, allow_inf_nan=False, strict=True), BeforeValidator(plain)
]

# A whole number of at least 1.
Count = Annotated[int, Field(strict=True, ge=1, le=10**15), BeforeValidator(plain)]

# A seed of a random generator.
Seed = Annotated[int, Field(strict=True, ge=0, lt=2**63), BeforeValidator(plain)]

# A sequence of finite doubles, at least one.
Numbers = Annotated[tuple[Number, ...], Field(fail_fast=True, min_length=1), BeforeValidator(plain)]

frozen_dict = AfterValidator(FrozenDict)

LowHigh = Annotated[tuple[Number, Number], BeforeValidator(plain)]
# Axis name to ``[a, b]``; axes left out are unrestricted.
Box = Annotated[dict[str, LowHigh], BeforeValidator(plain), frozen_dict]


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
            model: Any = cls
            raise condensed(error, model, partial(model._also_wrong, kwargs)) from None

    def __dir__(cls) -> list[str]:  # noqa: N805
        """Return our own names, and Python's: not all that pydantic adds."""
        return _own(cls, super().__dir__())


# Names of ours that replace pydantic's, and are not what a user looks for.
UNSAID = {"copy", "elsewhere", "model_construct", "model_copy", "model_validate_json"}


def _own(model: Any, names: Iterable[str]) -> list[str]:
    """Return the names among some that a model of ours declares, and the special ones."""
    ours = {
        name
        for base in model.__mro__
        if base.__module__.startswith("lmdsl.")
        for name in vars(base)
    }
    ours |= set(model.model_fields)
    shown = {name for name in ours if not name.startswith(("_", "model_config"))} - UNSAID
    return sorted(shown | {name for name in names if name.startswith("__")})


class Declared(BaseModel, metaclass=_Meta):
    """Base model: unknown keys refused, no coercion, frozen, errors as :class:`BadInput`."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True
    )

    # Keys that have their place in other models, and what to say of one here.
    elsewhere: ClassVar[Mapping[str, str]] = {}

    def __dir__(self) -> list[str]:
        """Return our own names, and Python's: not all that pydantic adds."""
        return _own(type(self), super().__dir__())

    def replaced(self, **changes: Any) -> Self:
        """Return a copy with some keys changed, validated anew."""
        return type(self)(
            **{**{key: getattr(self, key) for key in type(self).model_fields}, **changes}
        )

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy; what ``update`` changes is validated, as :meth:`replaced` does."""
        return self.replaced(**update) if update else super().model_copy(deep=deep)

    def copy(self, **options: Any) -> Self:
        """Refuse: pydantic's old ``copy`` does not check what it changes."""
        raise BadInput("copy() would not check what it changes; use replaced(key=value)")

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse."""
        raise AttributeError(f"{name} cannot be set: {FROZEN}")

    def __delattr__(self, name: str) -> None:
        """Refuse."""
        raise AttributeError(f"{name} cannot be deleted: {FROZEN}")

    @classmethod
    def model_validate_json(cls, json_data: str | bytes | bytearray, **kwargs: Any) -> Any:
        """Validate the text of a file, read as strictly as a file is."""
        content = json_data.encode() if isinstance(json_data, str) else bytes(json_data)
        return cls.model_validate(strict_json(content), **kwargs)

    @classmethod
    def model_construct(cls, *args: Any, **values: Any) -> Any:  # type: ignore[override]
        """Refuse: nothing would be checked."""
        raise BadInput(f"model_construct() checks nothing; use {cls.__name__}(key=value)")

    @classmethod
    def model_validate(cls, obj: Any, **kwargs: Any) -> Any:
        """Validate plain data; raises :class:`BadInput` with the path of the field at fault."""
        try:
            return super().model_validate(obj, **kwargs)
        except ValidationError as error:
            raise condensed(error, cls, partial(cls._also_wrong, obj)) from None

    @classmethod
    def _also_wrong(cls, data: Any) -> list[BadInput]:
        """Return what else is wrong with data that the types of some keys refuse."""
        return []

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Require what a file must say, though Python has a default for it."""
        schema: dict[str, Any] = handler(core)
        model = handler.resolve_ref_schema(schema)
        required = [key for key in ("format", "kind") if key in model.get("properties", {})]
        if required:
            model["required"] = [*required, *model.get("required", [])]
        return schema

"""Unions of models: told apart by ``kind``, or by a key that only one of them has."""

import functools
import operator
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Discriminator, Tag

from lmdsl.common.strict_model import Declared, SchemaWords
from lmdsl.errors import BadInput
from lmdsl.systems import (
    NAMED,
    DataSystem,
    FunctionSystem,
    MapSystem,
    MatrixSystem,
    OdeSystem,
    System,
)


class EachWords(SchemaWords):
    """Words for each number of a list."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        schema = handler(core)
        return {**schema, "items": {**schema["items"], **self.words}}


def _tag_by_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
    return f"<{kind}>" if isinstance(kind, str) else "<?>"


def tag_by_key(models: Mapping[str, type]) -> Any:
    """Tell models from another by a key that only one of them has, tagged ``<key>``."""

    def tag(value: Any) -> str:
        for key, model in models.items():
            if isinstance(value, model) or (isinstance(value, Mapping) and key in value):
                return f"<{key}>"
        return "<other>"

    return Discriminator(tag)


def kinds(*models: type[Declared]) -> Any:
    """Return the union of models told apart by their ``kind``."""
    tagged = [Annotated[m, Tag(f"<{m.model_fields['kind'].default}>")] for m in models]
    union: Any = functools.reduce(operator.or_, tagged)
    files = [m for m in models if m not in (FunctionSystem, MatrixSystem, DataSystem)]
    names = ", ".join(str(m.model_fields["kind"].default) for m in files)
    return Annotated[
        union,
        Discriminator(
            _tag_by_kind,
            custom_error_type="kind",
            custom_error_message=names,
        ),
    ]


class _KindsOfFiles:
    """Leaves what no JSON can be out of the JSON Schema of a union."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        schema: dict[str, Any] = handler(core)
        kinds = [one for one in schema["oneOf"] if not _is_function(one)]
        return {**schema, "oneOf": kinds}


def _is_function(schema: dict[str, Any]) -> bool:
    """Return whether a schema, or what it refers to and may not be made yet, is a function's."""
    names = (FunctionSystem.__name__, MatrixSystem.__name__, DataSystem.__name__)
    return schema == {"not": {}} or any(name in schema.get("$ref", "") for name in names)


def _refuse_functions(value: Any) -> Any:
    if isinstance(value, Mapping) and value.get("kind") == "function":
        raise BadInput(
            "kind 'function' cannot be declared as data; build a FunctionSystem in Python, "
            "or write formulas with kind 'map' or 'ode'"
        )
    for kind in ("matrices", "data"):
        if isinstance(value, Mapping) and value.get("kind") == kind:
            raise BadInput(
                f"kind {kind!r} cannot be declared in a file; use lmdsl.from_{kind} in Python"
            )
    return value


if TYPE_CHECKING:
    SystemUnion = System
else:
    SystemUnion = Annotated[
        kinds(MapSystem, OdeSystem, *NAMED.values(), FunctionSystem, MatrixSystem, DataSystem),
        BeforeValidator(_refuse_functions),
        _KindsOfFiles(),
    ]

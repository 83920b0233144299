"""The kinds of systems that a problem can name."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator

from lmdsl.errors import BadInput
from lmdsl.problem.unions import kinds
from lmdsl.systems import NAMED, FunctionSystem, MapSystem, OdeSystem, System


class _KindsOfFiles:
    """Leaves what no JSON can be out of the JSON Schema of a union."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        schema: dict[str, Any] = handler(core)
        kinds = [one for one in schema["oneOf"] if not _is_function(one)]
        return {**schema, "oneOf": kinds}


def _is_function(schema: dict[str, Any]) -> bool:
    """Return whether a schema, or what it refers to and may not be made yet, is a function's."""
    return schema == {"not": {}} or FunctionSystem.__name__ in schema.get("$ref", "")


def _refuse_functions(value: Any) -> Any:
    if isinstance(value, Mapping) and value.get("kind") == "function":
        raise BadInput(
            "kind 'function' cannot be declared as data; build a FunctionSystem in Python, "
            "or write formulas with kind 'map' or 'ode'"
        )
    return value


if TYPE_CHECKING:
    SystemUnion = System
else:
    SystemUnion = Annotated[
        kinds(MapSystem, OdeSystem, *NAMED.values(), FunctionSystem),
        BeforeValidator(_refuse_functions),
        _KindsOfFiles(),
    ]

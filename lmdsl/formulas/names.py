"""Names and formulas as declared keys: what a state, control, noise or parameter may be called."""

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from lmdsl.common.strict_model import Number, SchemaWords, frozen_dict, plain
from lmdsl.formulas.language import MAX_CHARACTERS, MAX_NAME, check_name
from lmdsl.formulas.operations import RESERVED


def _named(value: dict[str, Any]) -> dict[str, Any]:
    for name in value:
        check_name(name)
    return value


# A text formula; the model that knows its names parses it.
FormulaText = Annotated[str, SchemaWords({"minLength": 1, "maxLength": MAX_CHARACTERS})]

valid_names = AfterValidator(_named)

# What `valid_names` asks for, in words of JSON Schema.
named_keys = SchemaWords(
    {
        "propertyNames": {
            "pattern": "^[A-Za-z_][A-Za-z0-9_]*$",
            "maxLength": MAX_NAME,
            "not": {"enum": sorted(RESERVED)},
        }
    }
)

# Named constants of a system.
Parameters = Annotated[
    dict[str, Number],
    Field(max_length=1000),
    BeforeValidator(plain),
    valid_names,
    named_keys,
    frozen_dict,
]

# One formula per state.
Formulas = Annotated[
    dict[str, FormulaText], BeforeValidator(plain), valid_names, named_keys, frozen_dict
]

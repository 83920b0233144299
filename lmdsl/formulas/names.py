"""Names and formulas as declared keys: what a state, control, noise or parameter may be called."""

from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag

from lmdsl.common.strict_model import Number, SchemaWords, frozen_dict, plain
from lmdsl.formulas.language import MAX_NAME, check_name
from lmdsl.formulas.operations import RESERVED
from lmdsl.formulas.parser import MAX_CHARACTERS


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

MAX_DEFINITIONS = 200
MAX_CONDITIONS = 100

# Named subexpressions, in order.
Let = Annotated[
    dict[str, FormulaText],
    Field(max_length=MAX_DEFINITIONS),
    BeforeValidator(plain),
    valid_names,
    named_keys,
    frozen_dict,
]

# A condition, or a list of them of which one holds.
Conditions = Annotated[
    Annotated[FormulaText, Tag("<a>")]
    | Annotated[
        tuple[FormulaText, ...],
        Field(min_length=1, max_length=MAX_CONDITIONS, fail_fast=True),
        Tag("<b>"),
    ],
    Discriminator(lambda v: "<b>" if isinstance(v, list | tuple) else "<a>"),
    BeforeValidator(plain),
]

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

"""The values that a control takes."""

import math
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BeforeValidator, Tag, model_validator

from lmdsl.common.faults import written
from lmdsl.common.inputs import is_number
from lmdsl.common.strict_model import (
    Count,
    Declared,
    Number,
    Numbers,
    SchemaWords,
    frozen_dict,
    plain,
)
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.formulas.names import named_keys, valid_names
from lmdsl.problem.unions import tag_by_key


class ControlRange(Declared):
    """Equally spaced control values: ``numpy.linspace(low, high, points)``."""

    low: Number
    high: Number
    points: Count

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.points == 1 and self.low != self.high:
            raise BadInput(f"one point needs low == high, not {self.low!r} and {self.high!r}")
        if self.points > 1 and not self.low < self.high:
            raise BadInput(f"low {self.low!r} must be less than high {self.high!r}")
        if not math.isfinite(self.high - self.low):
            raise BadInput(f"high - low overflows: {self.low!r}, {self.high!r}")
        return self

    def count(self) -> int:
        """Return the number of values without making them."""
        return self.points

    def ends(self) -> tuple[float, float]:
        """Return the least and the largest value without making the others."""
        return self.low, self.high

    def vector(self) -> Floats:
        """Return the values, in the order of the control index."""
        return np.linspace(self.low, self.high, self.points)


class ControlValues(Declared):
    """Control values written out; distinct, order kept."""

    values: Annotated[Numbers, SchemaWords({"uniqueItems": True})]

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        seen: set[float] = set()
        for value in self.values:
            if value in seen:
                raise BadInput(f"{value!r} stands twice; list each value once", "values")
            seen.add(value)
        return self

    def count(self) -> int:
        """See :meth:`ControlRange.count`."""
        return len(self.values)

    def ends(self) -> tuple[float, float]:
        """See :meth:`ControlRange.ends`."""
        return min(self.values), max(self.values)

    def vector(self) -> Floats:
        """See :meth:`ControlRange.vector`."""
        return np.array(self.values)


def _spelled_out(value: Any) -> Any:
    """Refuse the values of a control alone, and say how to write them."""
    value = plain(value)
    if isinstance(value, tuple) and all(map(is_number, value)):
        what = written(value)
        raise BadInput(f'{what} is not an object; write {{"values": {what}}}')
    if is_number(value):
        raise BadInput(f'{value!r} is not an object; write {{"values": [{value!r}]}}')
    return value


ControlUnion = Annotated[
    Annotated[ControlValues, Tag("<values>")] | Annotated[ControlRange, Tag("<other>")],
    tag_by_key({"values": ControlValues}),
    BeforeValidator(_spelled_out),
]

ControlGrid = Annotated[
    dict[str, ControlUnion], BeforeValidator(plain), valid_names, named_keys, frozen_dict
]

"""The axes of the state box."""

import math
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, Field, model_validator

from lmdsl.common.faults import written
from lmdsl.common.inputs import is_number
from lmdsl.common.strict_model import Count, Declared, Number, frozen_dict, plain
from lmdsl.errors import BadInput
from lmdsl.formulas.names import named_keys, valid_names

MAX_AXES = 16  # number of axes above which a problem is refused


class Axis(Declared):
    """One axis of the state box.

    Attributes
    ----------
    low, high
        Ends of the axis, low < high, in the units of the state.
    cells
        Number of equal cells.
    periodic
        True on a circle: images are wrapped into [low, high].
    """

    low: Number
    high: Number
    cells: Count
    periodic: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        width = (self.high - self.low) / self.cells
        if not self.low < self.high:
            raise BadInput(f"low {self.low!r} must be less than high {self.high!r}")
        if not math.isfinite(width):
            raise BadInput(f"high - low overflows: {self.low!r}, {self.high!r}; rescale the state")
        scale = max(abs(self.low), abs(self.high))
        if self.cells < 2**40 and not width > 1e-13 * scale:
            raise BadInput(f"cells of width {width!r} are below what doubles resolve; use fewer")
        return self


def _spelled_out(value: Any) -> Any:
    """Refuse the two ends of an axis alone, and say how to write it."""
    if isinstance(value, list | tuple) and len(value) == 2 and all(map(is_number, value)):
        low, high = map(written, value)
        raise BadInput(
            f'{written(value)} is not an axis; write {{"low": {low}, "high": {high}, "cells": 50}}'
        )
    return value


StateBox = Annotated[
    dict[str, Annotated[Axis, BeforeValidator(_spelled_out)]],
    Field(min_length=1, max_length=MAX_AXES),
    BeforeValidator(plain),
    valid_names,
    named_keys,
    frozen_dict,
]

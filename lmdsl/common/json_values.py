"""Results as plain JSON data."""

import math
from dataclasses import fields, is_dataclass
from enum import StrEnum
from typing import Any

import numpy as np


class Reported:
    """Base of dataclasses that are reported field by field."""

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data: every field by its name."""
        return {f.name: jsonable(getattr(self, f.name)) for f in fields(self)}  # type: ignore[arg-type]


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

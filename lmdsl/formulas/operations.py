"""What formulas can do: operations, functions and constants by name."""

import keyword
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np


def _power(base: Any, exponent: Any) -> Any:
    # Exactly float: constants of a program are floats, all that varies is of NumPy.
    squared = type(exponent) is float and exponent == 2.0
    return np.square(base) if squared else np.power(base, exponent)


_UFUNCS: Final[dict[str, np.ufunc]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp,
    "log": np.log, "sqrt": np.sqrt, "abs": np.absolute, "sign": np.sign, "floor": np.floor,
    "ceil": np.ceil, "atan2": np.arctan2, "min": np.minimum, "max": np.maximum, "mod": np.mod,
}  # fmt: skip

_COMPARISONS: Final[dict[str, Callable[..., Any]]] = {
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal,
    "==": np.equal, "!=": np.not_equal,
}  # fmt: skip

# What joins comparisons.
CONNECTIVES: Final[dict[str, Callable[..., Any]]] = {
    "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
}  # fmt: skip

OPERATIONS: Final[dict[str, Callable[..., Any]]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.true_divide, "**": _power,
    "negative": np.negative, "where": np.where, **_UFUNCS, **_COMPARISONS, **CONNECTIVES,
}  # fmt: skip

# Correctly rounded: the same bits whichever loop computes them, in place or not.
PLAIN: Final = ("+", "-", "*", "/", "negative", "abs", "sqrt", "floor", "ceil")

FORMULA_CONSTANTS: Final[Mapping[str, float]] = MappingProxyType({"pi": math.pi, "e": math.e})

FORMULA_FUNCTIONS: Final[Mapping[str, int]] = MappingProxyType(
    {**{name: ufunc.nin for name, ufunc in _UFUNCS.items()}, "where": 3}
)

# Functions only before a bracket: their names may be declared, as older files do.
CALLED: Final = frozenset({"mod"})

# Names that nothing may bear.
RESERVED: Final = frozenset({*keyword.kwlist, *FORMULA_FUNCTIONS, *FORMULA_CONSTANTS}) - CALLED

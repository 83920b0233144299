"""Formulas and conditions, evaluated by Python for one sample at a time."""

import ast
import math
from collections.abc import Callable
from typing import Any

import numpy as np

FUNCTIONS = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "exp": np.exp,
    "log": np.log,
    "sqrt": np.sqrt,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "ceil": np.ceil,
    "atan2": np.arctan2,
    "min": np.minimum,
    "max": np.maximum,
    "mod": np.mod,
    "where": lambda condition, yes, no: yes if condition else no,
    "pi": np.float64(math.pi),
    "e": np.float64(math.e),
    "__builtins__": {},
    "__float64": np.float64,
}


class _Float64Literals(ast.NodeTransformer):
    """Make every number in a formula a float64, so that 1/0 is inf and (-1)**0.5 is NaN."""

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        name = ast.Name(id="__float64", ctx=ast.Load())
        return ast.copy_location(ast.Call(func=name, args=[node], keywords=[]), node)


def formula(text: str) -> Callable[[dict[str, np.float64]], float]:
    """Text -> function of the values of its names."""
    tree = _Float64Literals().visit(ast.parse(text.strip(), mode="eval"))
    code = compile(ast.fix_missing_locations(tree), text, "eval")

    def value(names: dict[str, np.float64]) -> np.float64:
        with np.errstate(all="ignore"):
            return eval(code, FUNCTIONS, names)

    return value


def parameters_of(problem: dict[str, Any]) -> dict[str, np.float64]:
    """The parameters of the system by name, defaults included."""
    system = problem["system"]
    defaults = {"K": 0.25} if system["kind"] == "standard_map" else {}
    given = {**defaults, **system.get("parameters", {})}
    return {name: np.float64(value) for name, value in given.items()}


def value_of(problem: dict[str, Any], text: str) -> Callable[[dict[str, float]], float]:
    """Formula or condition of a problem -> function of the values of states, controls, noise.

    What `let` defines is evaluated first, in order, as far as its names have values.
    """
    parameters = parameters_of(problem)
    definitions = {name: formula(by) for name, by in (problem.get("let") or {}).items()}
    own = formula(text)

    def value(names: dict[str, float]) -> float:
        values = {**parameters, **{k: np.float64(v) for k, v in names.items()}}
        for name, by in definitions.items():
            try:
                values[name] = by(values)
            except NameError:
                continue
        return float(own(values))

    return value


def formula_of(problem: dict[str, Any], key: str) -> Callable[[dict[str, float]], float] | None:
    """Make the function of the values of all names that a key holds; None without the key."""
    return value_of(problem, problem[key]) if key in problem else None

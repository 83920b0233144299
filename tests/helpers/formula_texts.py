"""Formulas as text, their values, and an oracle through Python."""

from __future__ import annotations

import ast
import math

import numpy as np
import pytest

from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program
from lmdsl.formulas.tokens import FormulaError

NAMES = ("u", "x", "y")
UFUNCS = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos,
    "atan": np.arctan, "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp,
    "log": np.log, "sqrt": np.sqrt, "abs": np.abs, "sign": np.sign, "floor": np.floor,
    "ceil": np.ceil, "atan2": np.arctan2, "min": np.minimum, "max": np.maximum,
    "where": np.where, "mod": np.mod,
}  # fmt: skip


def value(text, constants=None, **names):
    """The value of one formula; all given names are declared."""
    declared = set(names) | set(constants or {})
    return Program([parse(text, declared)], constants or {})(names)[0]


def refused(text, names=NAMES):
    with pytest.raises(FormulaError) as caught:
        parse(text, names)
    return caught.value


def formula_or_refusal(text):
    try:
        return parse(text, NAMES)
    except FormulaError as error:
        return error


def same_bits(left, right):
    left, right = np.broadcast_arrays(left, right)
    numbers = ~np.isnan(left)
    return (
        np.array_equal(left, right, equal_nan=True)
        and np.array_equal(np.signbit(left)[numbers], np.signbit(right)[numbers])
    )  # fmt: skip


# An independent evaluation: Python's own parser, and a walk over its tree.
class Oracle:
    def __init__(self, names):
        self.names = names
        self.constant_fault = False

    def __call__(self, text):
        with np.errstate(all="ignore"):
            return self.walk(ast.parse(text.strip(), mode="eval").body)

    def walk(self, node):
        result = getattr(self, type(node).__name__)(node)
        if np.ndim(result) == 0 and not np.isfinite(result):
            self.constant_fault = True
        return result

    def Constant(self, node):
        return np.float64(node.value)

    def Name(self, node):
        return self.names.get(node.id, {"pi": math.pi, "e": math.e}.get(node.id))

    def UnaryOp(self, node):
        operand = self.walk(node.operand)
        if isinstance(node.op, ast.Not):
            return np.logical_not(operand)
        return np.negative(operand) if isinstance(node.op, ast.USub) else operand

    def BinOp(self, node):
        left, right = self.walk(node.left), self.walk(node.right)
        if isinstance(node.op, ast.Pow):
            constant_two = np.ndim(right) == 0 and right == 2
            return left * left if constant_two else np.power(left, right)
        function = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply}
        return function.get(type(node.op), np.divide)(left, right)

    def BoolOp(self, node):
        first, *others = [self.walk(value) for value in node.values]
        join = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
        for other in others:
            first = join(first, other)
        return first

    def Compare(self, node):
        assert len(node.ops) == 1
        left, right = self.walk(node.left), self.walk(node.comparators[0])
        return {
            ast.Lt: np.less, ast.LtE: np.less_equal, ast.Gt: np.greater,
            ast.GtE: np.greater_equal, ast.Eq: np.equal, ast.NotEq: np.not_equal,
        }[type(node.ops[0])](left, right)  # fmt: skip

    def Call(self, node):
        return UFUNCS[node.func.id](*[self.walk(argument) for argument in node.args])

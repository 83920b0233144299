"""Formulas, read without running anything, and evaluated on boxes."""

import ast
import math
from math import inf

from claim_7 import jets
from claim_7.intervals import FUNCTIONS, STEPS, hull
from claim_7.jets import Jet, constant

BINARY = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.And: "and", ast.Or: "or",
}  # fmt: skip
COMPARED = {  # True: on the whole box; False: nowhere; None: neither
    "<": lambda a, b: True if a.high < b.low else False if a.low >= b.high else None,
    "<=": lambda a, b: True if a.high <= b.low else False if a.low > b.high else None,
    "==": lambda a, b: (
        False if a.high < b.low or b.high < a.low
        else True if a.low == a.high == b.low == b.high else None
    ),
}  # fmt: skip
FOLDED = {
    "+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b,
    "/": lambda a, b: a / b, "negative": lambda a: -a,
}  # fmt: skip
EXACT = {
    "+": jets.add,
    "-": jets.subtract,
    "*": jets.multiply,
    "/": jets.divide,
    "negative": jets.negative,
}
TWO = {"min": jets.smaller, "max": jets.larger, "mod": jets.remainder, "atan2": jets.angle}
ARITY = {**dict.fromkeys(FUNCTIONS, 1), **dict.fromkeys(STEPS, 1), **dict.fromkeys(TWO, 2),
         "abs": 1, "where": 3}  # fmt: skip
CONDITIONS = {"<", "<=", ">", ">=", "==", "!=", "and", "or", "not"}


class Formulas:
    """Formulas in Python's grammar, read without running anything: each part once.

    Sums, products and quotients of numbers are folded to the doubles that every program computes.
    """

    def __init__(self, names, parameters, let):
        self.names, self.parts, self.known = set(names), [], {}
        numbers = {"pi": math.pi, "e": math.e, **parameters}
        self.named = {name: self._part("constant", (x,)) for name, x in numbers.items()}
        for name, text in let.items():
            self.named[name] = self.read(text)

    def read(self, text, condition=False):
        """Return the place of a formula or condition."""
        if len(text) > 10**6:
            raise ValueError("a formula is too long")
        place = self._place(ast.parse(text.strip(" \t"), mode="eval").body)
        self._need((self.parts[place][0] in CONDITIONS) == condition, "a condition, or none")
        return place

    def _need(self, holds, what):
        if not holds:
            raise ValueError(f"a formula cannot be read: {what}")

    def _part(self, operation, operands):
        key = (operation, *operands)
        if operation in FOLDED and all(self.parts[k][0] == "constant" for k in operands):
            value = FOLDED[operation](*(self.parts[k][1][0] for k in operands))
            return self._part("constant", (value,))
        if operation == "constant":
            self._need(math.isfinite(operands[0]), "a number is not finite")
            key = (operation, operands[0].hex())
        if key not in self.known:
            self.known[key] = len(self.parts)
            self.parts.append((operation, operands))
        return self.known[key]

    def _place(self, node):
        kind = type(node)
        if kind is ast.Constant and type(node.value) in (int, float):
            return self._part("constant", (float(node.value),))
        if kind is ast.Name:
            if node.id in self.names:
                return self._part("name", (node.id,))
            self._need(node.id in self.named, f"{node.id!a} has no value")
            return self.named[node.id]
        if kind is ast.BinOp:
            return self._applied(BINARY.get(type(node.op)), [node.left, node.right])
        if kind is ast.UnaryOp and type(node.op) in (ast.UAdd, ast.USub, ast.Not):
            if type(node.op) is ast.UAdd:
                return self._place(node.operand)
            name = "negative" if type(node.op) is ast.USub else "not"
            return self._applied(name, [node.operand])
        if kind is ast.Compare and len(node.ops) == 1:
            return self._applied(BINARY.get(type(node.ops[0])), [node.left, *node.comparators])
        if kind is ast.BoolOp:
            return self._applied(BINARY[type(node.op)], node.values)
        name = getattr(getattr(node, "func", None), "id", None)
        self._need(name in ARITY and not node.keywords, f"{kind.__name__} {name or ''}")
        self._need(len(node.args) == ARITY[name], f"the arguments of {name}")
        return self._applied(name, node.args)

    def _applied(self, operation, nodes):
        self._need(operation is not None, "an operator is unknown")
        operands = tuple(map(self._place, nodes))
        conditions = len(operands) if operation in ("and", "or", "not") else operation == "where"
        for k, operand in enumerate(operands):
            self._need((self.parts[operand][0] in CONDITIONS) == (k < conditions), operation)
        return self._part(operation, operands)

    def values(self, places, given):
        """Return jets, of conditions True, False or None; ``given`` are jets by name."""
        memo = {}
        return [self._value(k, given, memo) for k in places]

    def _value(self, place, given, memo):
        if place not in memo:
            memo[place] = self._computed(*self.parts[place], given, memo)
        return memo[place]

    def _computed(self, operation, operands, given, memo):
        if operation == "constant":
            return constant(operands[0])
        if operation == "name":
            return given[operands[0]]
        if operation == "where":
            return self._where(operands, given, memo)
        values = [self._value(k, given, memo) for k in operands]
        if operation in EXACT:
            return EXACT[operation](*values)
        if operation == "**":
            a, b = values
            known = self.parts[operands[1]][0] == "constant"
            return jets.power(a, b.low) if known else jets.general_power(a, b)
        if operation in FUNCTIONS:
            return jets.apply_function(operation, *values)
        if operation in STEPS:
            return jets.step(operation, *values)
        if operation in CONDITIONS:
            return condition(operation, values)
        return jets.absolute(*values) if operation == "abs" else TWO[operation](*values)

    def _where(self, operands, given, memo):
        holds = self._value(operands[0], given, memo)
        if holds is not None:
            return self._value(operands[1 if holds else 2], given, memo)
        a, b = (self._value(k, given, memo) for k in operands[1:])
        return Jet(*hull(a.ends, b.ends), None, inf)


def condition(operation, values):
    """Return whether a condition holds on the whole box: True, False (nowhere) or None."""
    if operation == "not":
        return None if values[0] is None else not values[0]
    if operation in ("and", "or"):
        decides = operation == "or"
        return decides if decides in values else None if None in values else not decides
    a, b = values
    if operation in (">", ">="):
        return COMPARED[operation.replace(">", "<")](b, a)
    if operation == "!=":
        return condition("not", [COMPARED["=="](a, b)])
    return COMPARED[operation](a, b)

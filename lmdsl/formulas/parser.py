"""The parser of formulas and conditions; language.py says what the language is."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final, NamedTuple, NoReturn

import numpy as np

from lmdsl.common import spelling
from lmdsl.errors import shown
from lmdsl.formulas import tokens
from lmdsl.formulas.operations import (
    _COMPARISONS,
    CALLED,
    CONNECTIVES,
    FORMULA_CONSTANTS,
    FORMULA_FUNCTIONS,
    OPERATIONS,
)
from lmdsl.formulas.tokens import Token, UndeclaredName, fault_at

MAX_CHARACTERS: Final = 4_000
MAX_NODES: Final = 1_000
MAX_DEPTH: Final = 50

_OR, _AND, _NOT, _COMPARE, _SUM, _PRODUCT, _POWER = range(1, 8)
_RANK: Final = {
    "or": _OR, "and": _AND, **dict.fromkeys(_COMPARISONS, _COMPARE), "+": _SUM, "-": _SUM,
    "*": _PRODUCT, "/": _PRODUCT, "**": _POWER,
}  # fmt: skip
_CONDITIONS: Final = {*_COMPARISONS, *CONNECTIVES}
_OPERAND: Final = "a number, name, function or bracket"


class Subformula(NamedTuple):
    """One subformula: ``constant``, ``name``, or an operation on earlier ones."""

    operation: str
    operands: tuple[int, ...] = ()
    value: float = 0.0
    name: str = ""


def fold(operation: str, values: Sequence[float]) -> float:
    """Apply an operation to constants with the very function that arrays go through."""
    with np.errstate(all="ignore"):
        return float(OPERATIONS[operation](*values))


class Parsed(NamedTuple):
    """A parsed subexpression: its place, its span in the text, its value if constant."""

    place: int
    start: int
    stop: int
    constant: float | None
    condition: int = -1  # of a condition: position of the operator that makes it one


class Parser:
    """Precedence climbing with one token of look-ahead; depth bounds the recursion.

    Parameters
    ----------
    text, names
        The formula, and the declared names.
    definitions
        Named subexpressions; of each its ``constant`` (None if it varies) and its ``names``. They
        stand among the subformulas as names.
    condition
        Whether the text is a condition.
    later
        Names that must not be used yet.
    """

    def __init__(
        self,
        text: str,
        names: Collection[str],
        definitions: Mapping[str, Any],
        condition: bool = False,
        later: Collection[str] = (),
    ) -> None:
        self.text, self.names, self.definitions, self.later = text, names, definitions, later
        self.subformulas: list[Subformula] = []
        self.nodes = self.depth = 0
        self.stop = 0  # end of the last token consumed
        if len(text) > MAX_CHARACTERS:
            fault = f"the formula goes on to {len(text):,} characters"
            raise fault_at(MAX_CHARACTERS, f"{fault}; the limit is {MAX_CHARACTERS:,}")
        self.token = tokens.scan(text, 0)
        if self.token.kind == "end":
            example = (
                "a condition such as x < 1" if condition else "an expression such as 0 or 2*pi"
            )
            raise fault_at(0, f"the formula is empty; write {example}")
        self.root = self._expression(_OR)
        if self.token.kind != "end":
            self._unexpected("an operator")
        (self._require_conditions if condition else self._require_values)([self.root])

    def _advance(self) -> Token:
        token = self.token
        self.stop = token.start + len(token.text)
        self.token = tokens.scan(self.text, self.stop)
        return token

    def _unexpected(self, expected: str) -> NoReturn:
        kind, text, start = self.token
        if kind == "end":
            raise fault_at(start, f"the formula ends where {expected} is expected")
        if text == "(" and self.text[start + 1 :].lstrip(" \t").startswith("mod "):
            raise fault_at(start, "(mod ...) is no formula; declare the axis periodic instead")
        if (kind != "symbol" or text == "(") and expected.startswith("an operator"):
            fix = text.lower() if text.lower() in ("and", "or") else "* for a product"
            fault = f"an operator is missing before {shown(text)}; write {fix}"
            raise fault_at(start, fault)
        fix = "; put the condition in brackets" if text == "not" and expected == _OPERAND else ""
        raise fault_at(start, f"{shown(text)} stands where {expected} is expected{fix}")

    def _require_values(self, nodes: Sequence[Parsed]) -> None:
        for node in nodes:
            if node.condition >= 0:
                rule = "a comparison may only be the first argument of where"
                raise fault_at(node.condition, f"{rule}; write where(x < 1, a, b)")

    def _require_conditions(self, nodes: Sequence[Parsed]) -> None:
        for node in nodes:
            if node.condition < 0:
                fault = f"{shown(self.text[node.start : node.stop])} is not a comparison"
                raise fault_at(node.start, f"{fault}; write one such as x < 1")

    def _count(self, start: int) -> None:
        self.nodes += 1
        if self.nodes > MAX_NODES:
            fault = f"the formula has more than {MAX_NODES:,} numbers, names and operators"
            raise fault_at(start, f"{fault}; shorten it")

    def _deeper(self, start: int) -> None:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            fault = f"brackets, calls, signs and powers nest deeper than {MAX_DEPTH}"
            raise fault_at(start, f"{fault}; shorten the formula")

    def _leaf(self, part: Subformula, constant: float | None) -> Parsed:
        start = self._advance().start
        self._count(start)
        self.subformulas.append(part)
        return Parsed(len(self.subformulas) - 1, start, self.stop, constant)

    def _constant(self, value: float) -> Parsed:
        return self._leaf(Subformula("constant", value=value), value)

    def _apply(self, operation: str, operands: Sequence[Parsed], at: int, start: int) -> Parsed:
        """Append an operation whose text runs from `start` to here; `at` is its operator."""
        self._count(at)
        conditions = {"where": 1, **dict.fromkeys(CONNECTIVES, len(operands))}.get(operation, 0)
        self._require_conditions(operands[:conditions])
        self._require_values(operands[conditions:])
        self.subformulas.append(Subformula(operation, tuple(operand.place for operand in operands)))
        values = [operand.constant for operand in operands if operand.constant is not None]
        constant = fold(operation, values) if len(values) == len(operands) else None
        if constant is not None and not math.isfinite(constant):
            kind = "not a number" if math.isnan(constant) else "infinite"
            fault = f"{shown(self.text[start : self.stop])} is {kind}; constants must be finite"
            raise fault_at(start, fault)
        condition = at if operation in _CONDITIONS else -1
        return Parsed(len(self.subformulas) - 1, start, self.stop, constant, condition)

    def _expression(self, lowest: int) -> Parsed:
        """Parse operands joined by operators that bind at least as tightly as `lowest`."""
        negated = self.token.text == "not" and lowest <= _NOT
        left = self._negation() if negated else self._operand()
        while (rank := _RANK.get(self.token.text, 0)) >= lowest:
            _, operator, at = self._advance()
            if rank == _COMPARE and left.condition >= 0:
                fix = "one comparison at a time, such as x < y and y < z"
                raise fault_at(at, f"{shown(operator)} compares again; write {fix}")
            if rank == _POWER:
                self._deeper(at)
                right = self._expression(_POWER)  # the same rank: groups to the right
                self.depth -= 1
            else:
                right = self._expression(rank + 1)
            left = self._apply(operator, (left, right), at, left.start)
        return left

    def _negation(self) -> Parsed:
        start = self._advance().start
        self._deeper(start)
        node = self._expression(_NOT)
        self.depth -= 1
        return self._apply("not", [node], start, start)

    def _operand(self) -> Parsed:
        kind, text, start = self.token
        if kind == "number":
            return self._constant(float(text))
        if kind == "name":
            return self._name(text, start)
        if text not in ("+", "-", "("):
            self._unexpected(_OPERAND)
        self._advance()
        self._deeper(start)
        node = self._expression(_OR if text == "(" else _POWER)
        if text == "(":
            self._close("an operator or a closing bracket")
        elif text == "-":
            node = self._apply("negative", [node], start, start)
        else:
            self._count(start)
            self._require_values([node])
        self.depth -= 1
        return node._replace(start=start, stop=self.stop)

    def _close(self, expected: str) -> None:
        if self.token.text != ")":
            self._unexpected(expected)
        self._advance()

    def _name(self, text: str, start: int) -> Parsed:
        known = text in self.names or text in self.definitions
        if text in CALLED and known and not tokens.called(self.text, self.token):
            return self._declared(text, start)
        if text in FORMULA_FUNCTIONS:
            return self._call(text, start)
        if text in FORMULA_CONSTANTS:
            return self._constant(FORMULA_CONSTANTS[text])
        if known:
            return self._declared(text, start)
        if text in self.later:
            raise fault_at(start, f"{shown(text)} is not defined before; move it up in let")
        declared = {*self.names, *self.definitions}
        hint = spelling.hint(
            text, [*declared, *FORMULA_FUNCTIONS, *FORMULA_CONSTANTS], tokens.HABITS
        )
        fault = f"{shown(text)} is not a declared name or function{hint or ';'}"
        listed = tokens.declared(declared)
        raise UndeclaredName(f"character {start + 1}: {fault} {listed}", start, text)

    def _declared(self, text: str, start: int) -> Parsed:
        constant = None
        if text in self.definitions:
            constant = self.definitions[text].constant
            other = sorted(self.definitions[text].names - {*self.names})
            if other:
                fault = f"{shown(text)} depends on {', '.join(other)}, which has no value here"
                raise fault_at(start, f"{fault}; {tokens.declared(self.names)}")
        return self._leaf(Subformula("name", name=text), constant)

    def _call(self, name: str, start: int) -> Parsed:
        self._advance()
        if self.token.text != "(":
            raise fault_at(start, f"{shown(name)} is a function; give its arguments in brackets")
        self._deeper(start)
        self._advance()
        arguments: list[Parsed] = []
        while arguments or self.token.text != ")":
            arguments.append(self._expression(_OR))
            if self.token.text != ",":
                break
            self._advance()
        self._close("an operator, a comma or a closing bracket")
        self.depth -= 1
        arity = FORMULA_FUNCTIONS[name]
        if len(arguments) != arity:
            wanted = f"{arity} argument{'s' if arity > 1 else ''}"
            raise fault_at(start, f"{shown(name)} takes {wanted}, not {len(arguments)}")
        return self._apply(name, arguments, start, start)

"""Text formulas: a small checked language with NumPy semantics that never runs code.

Grammar, loosest binding first, as in Python (``**`` groups to the right)::

    formula   : sum
    condition : sum ("<" | "<=" | ">" | ">=" | "==" | "!=") sum | "(" condition ")"
    sum       : product (("+" | "-") product)*
    product   : signed (("*" | "/") signed)*
    signed    : ("+" | "-") signed | power
    power     : atom ["**" signed]
    atom      : number | name | "(" sum ")" | function "(" sum ("," sum)* ")"
              | "where" "(" condition "," sum "," sum ")"

Numbers are Python's decimal literals without underscores, read as float64. Only blanks
and tabs separate. Nodes are numbers, names, operators, signs and functions. Depth is
the number of brackets, calls, signs and powers that stand inside one another: ``x`` has
depth 0, ``sin((-x))`` depth 3. A flat chain of ``+ -`` or ``* /`` adds none, however long.

`parse` turns a text into a `Formula`, a flat list of subformulas, operands before their users.
`lmdsl.formulas.program.Program` joins them, merges equal subformulas and evaluates them on arrays.
Nothing is reordered or simplified, save that a power with the constant exponent 2 is a square.
"""

import keyword
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, NoReturn

import numpy as np

from lmdsl.errors import BadInput, shown
from lmdsl.formulas.operations import _COMPARISONS, FORMULA_CONSTANTS, FORMULA_FUNCTIONS, OPERATIONS
from lmdsl.formulas.tokens import Token, fault_at, scan

MAX_CHARACTERS: Final = 4_000  # number of characters above which a formula is refused
MAX_NODES: Final = 1_000  # number of subformulas above which it is refused
MAX_DEPTH: Final = 50  # depth above which it is refused
MAX_NAME: Final = 64  # number of characters above which a name is refused

_COMPARE, _SUM, _PRODUCT, _POWER = 1, 2, 3, 4
_RANK: Final = dict.fromkeys(_COMPARISONS, _COMPARE) | dict(
    zip(("+", "-", "*", "/", "**"), (_SUM, _SUM, _PRODUCT, _PRODUCT, _POWER), strict=True)
)


class Subformula(NamedTuple):
    """One subformula: ``constant``, ``name``, or an operation on earlier ones."""

    operation: str
    operands: tuple[int, ...] = ()
    value: float = 0.0
    name: str = ""


@dataclass(frozen=True)
class Formula:
    """A checked formula, made by `parse`.

    Attributes
    ----------
    text
        What the user wrote.
    names
        The declared names that it uses.
    subformulas
        The formula in evaluation order; the last is the formula itself.
    """

    text: str
    names: frozenset[str]
    subformulas: tuple[Subformula, ...] = field(repr=False)


def check_name(name: str) -> None:
    """Refuse a name that no state, control, noise or parameter of a formula may have.

    Raises
    ------
    BadInput
        If the name is not an ASCII identifier of at most 64 characters, or is a
        keyword of Python or a function or constant of the language.
    """
    if len(name) > MAX_NAME or not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        rule = f"use at most {MAX_NAME} of a-z, A-Z, 0-9 and _, no digit first"
        raise BadInput(f"{shown(name)} is not a name; {rule}")
    if keyword.iskeyword(name):
        raise BadInput(f"{shown(name)} is a Python keyword; choose another name")
    if name in FORMULA_FUNCTIONS or name in FORMULA_CONSTANTS:
        raise BadInput(f"{shown(name)} has a meaning in formulas; choose another name")


def parse(text: str, names: Collection[str]) -> Formula:
    """Check a formula.

    Parameters
    ----------
    text
        The formula; at most 4,000 characters, 1,000 nodes and depth 50.
    names
        The declared names, each accepted by `check_name`.

    Raises
    ------
    FormulaError
        If the text is not a formula, uses an undeclared name, or holds a number or
        constant subexpression that is infinite or not a number.
    """
    if len(text) > MAX_CHARACTERS:
        fault = f"the formula goes on to {len(text):,} characters; the limit is {MAX_CHARACTERS:,}"
        raise fault_at(MAX_CHARACTERS, fault)
    parts = _Parser(text, names).subformulas
    return Formula(text, frozenset(part.name for part in parts if part.name), tuple(parts))


def fold(operation: str, values: Sequence[float]) -> float:
    """Apply an operation to constants with the very function that arrays go through."""
    with np.errstate(all="ignore"):
        return float(OPERATIONS[operation](*values))


class _Parsed(NamedTuple):
    """A parsed subexpression: its place, its span in the text, its value if constant."""

    place: int
    start: int
    stop: int
    constant: float | None
    comparison: int = -1  # position of the operator of a comparison


class _Parser:
    """Precedence climbing with one token of look-ahead; depth bounds the recursion."""

    def __init__(self, text: str, names: Collection[str]) -> None:
        self.text, self.names = text, names
        self.subformulas: list[Subformula] = []
        self.nodes = self.depth = 0
        self.stop = 0  # end of the last token consumed
        self.token = scan(self.text, self.stop)
        if self.token.kind == "end":
            raise fault_at(0, "the formula is empty; write an expression such as 0 or 2*pi")
        root = self._expression(_COMPARE)
        if self.token.kind != "end":
            self._unexpected("an operator")
        self._require_values([root])

    def _advance(self) -> Token:
        token = self.token
        self.stop = token.start + len(token.text)
        self.token = scan(self.text, self.stop)
        return token

    def _unexpected(self, expected: str) -> NoReturn:
        kind, text, start = self.token
        if kind == "end":
            raise fault_at(start, f"the formula ends where {expected} is expected")
        if (kind != "symbol" or text == "(") and expected.startswith("an operator"):
            fault = f"an operator is missing before {shown(text)}; write * for a product"
            raise fault_at(start, fault)
        raise fault_at(start, f"{shown(text)} stands where {expected} is expected")

    def _require_values(self, nodes: Sequence[_Parsed]) -> None:
        for node in nodes:
            if node.comparison >= 0:
                rule = "a comparison may only be the first argument of where"
                raise fault_at(node.comparison, f"{rule}; write where(x < 1, a, b)")

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

    def _leaf(self, part: Subformula) -> _Parsed:
        start = self._advance().start
        self._count(start)
        self.subformulas.append(part)
        constant = None if part.name else part.value
        return _Parsed(len(self.subformulas) - 1, start, self.stop, constant)

    def _apply(self, operation: str, operands: Sequence[_Parsed], at: int, start: int) -> _Parsed:
        """Append an operation whose text runs from `start` to here; `at` is its operator."""
        self._count(at)
        self._require_values(operands[1:] if operation == "where" else operands)
        self.subformulas.append(Subformula(operation, tuple(operand.place for operand in operands)))
        values = [operand.constant for operand in operands if operand.constant is not None]
        constant = fold(operation, values) if len(values) == len(operands) else None
        if constant is not None and not math.isfinite(constant):
            kind = "not a number" if math.isnan(constant) else "infinite"
            fault = f"{shown(self.text[start : self.stop])} is {kind}; constants must be finite"
            raise fault_at(start, fault)
        comparison = at if operation in _COMPARISONS else -1
        return _Parsed(len(self.subformulas) - 1, start, self.stop, constant, comparison)

    def _expression(self, lowest: int) -> _Parsed:
        """Parse operands joined by operators that bind at least as tightly as `lowest`."""
        left = self._operand()
        while (rank := _RANK.get(self.token.text, 0)) >= lowest:
            _, operator, at = self._advance()
            if rank == _COMPARE and left.comparison >= 0:
                raise fault_at(at, f"{shown(operator)} compares again; where takes one comparison")
            if rank == _POWER:
                self._deeper(at)
                right = self._expression(_POWER)  # the same rank: groups to the right
                self.depth -= 1
            else:
                right = self._expression(rank + 1)
            left = self._apply(operator, (left, right), at, left.start)
        return left

    def _operand(self) -> _Parsed:
        kind, text, start = self.token
        if kind == "number":
            return self._leaf(Subformula("constant", value=float(text)))
        if kind == "name":
            return self._name(text, start)
        if text not in ("+", "-", "("):
            self._unexpected("a number, name, function or bracket")
        self._advance()
        self._deeper(start)
        node = self._expression(_COMPARE if text == "(" else _POWER)
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

    def _name(self, text: str, start: int) -> _Parsed:
        if text in FORMULA_FUNCTIONS:
            return self._call(text, start)
        if text in FORMULA_CONSTANTS:
            return self._leaf(Subformula("constant", value=FORMULA_CONSTANTS[text]))
        if text in self.names:
            return self._leaf(Subformula("name", name=text))
        declared = ", ".join(sorted(self.names)[:20]) + ", ..." * (len(self.names) > 20)
        listed = f"declared names are {declared}" if declared else "no names are declared"
        raise fault_at(start, f"{shown(text)} is not a declared name or function; {listed}")

    def _call(self, name: str, start: int) -> _Parsed:
        self._advance()
        if self.token.text != "(":
            raise fault_at(start, f"{shown(name)} is a function; give its arguments in brackets")
        self._deeper(start)
        self._advance()
        arguments: list[_Parsed] = []
        while arguments or self.token.text != ")":
            arguments.append(self._expression(_COMPARE))
            if self.token.text != ",":
                break
            self._advance()
        self._close("an operator, a comma or a closing bracket")
        self.depth -= 1
        arity = FORMULA_FUNCTIONS[name]
        if len(arguments) != arity:
            wanted = f"{arity} argument{'s' if arity > 1 else ''}"
            raise fault_at(start, f"{shown(name)} takes {wanted}, not {len(arguments)}")
        if name == "where" and arguments[0].comparison < 0:
            condition = arguments[0]
            fault = f"{shown(self.text[condition.start : condition.stop])} is not a comparison"
            raise fault_at(condition.start, f"{fault}; write where(x < 1, a, b)")
        return self._apply(name, arguments, start, start)

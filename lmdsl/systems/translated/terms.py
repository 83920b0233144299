"""Texts of formulas put together from their parts, with the brackets that they need and no others.

No sum or product is regrouped: what the other tool
wrote is computed, operation by operation.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from lmdsl.formulas.parser import MAX_CHARACTERS

# How tightly the outermost operation of a text binds.
EITHER, BOTH, NEGATED, COMPARED, SUM, PRODUCT, SIGNED, POWER, ATOM = range(9)

# What holds where a comparison of numbers does not.
FLIPPED: Final = {"<": ">=", ">=": "<", ">": "<=", "<=": ">", "==": "!=", "!=": "=="}


class Untranslatable(Exception):
    """The language of formulas lacks something; the message names it."""


class Piece(NamedTuple):
    """A text and how tightly it binds."""

    text: str
    rank: int = ATOM

    def at(self, rank: int) -> str:
        """Return the text as an operand of something that binds so tightly."""
        return self.text if self.rank >= rank else f"({self.text})"


class Choice(NamedTuple):
    """A condition; ``certain`` says that it always or never holds, else it is None."""

    text: str
    rank: int = COMPARED
    certain: bool | None = None
    opposite: str = ""  # the comparison that holds where this one does not

    def at(self, rank: int) -> str:
        """Return the text as an operand of something that binds so tightly."""
        return self.text if self.rank >= rank else f"({self.text})"

    def choose(self, yes: Piece, no: Piece) -> Piece:
        """Return what is one where the condition holds and another elsewhere."""
        if self.certain is not None:
            return yes if self.certain else no
        return _made(f"where({self.text}, {yes.text}, {no.text})", ATOM)

    def negated(self) -> "Choice":
        """Return the opposite; numbers that are not comparable (NaN) do not count."""
        if self.certain is not None:
            return certain(not self.certain)
        if self.opposite:
            return Choice(self.opposite, opposite=self.text)
        return Choice(f"not {self.at(NEGATED)}", NEGATED)


def _made(text: str, rank: int) -> Piece:
    if len(text) > MAX_CHARACTERS:
        raise Untranslatable(f"formulas of more than {MAX_CHARACTERS:,} characters")
    return Piece(text, rank)


def number(value: float) -> Piece:
    """Return a constant."""
    try:
        value = float(value)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise Untranslatable(f"the constant {value}")
    text = repr(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)
    return Piece(text, SIGNED if text.startswith("-") else ATOM)


ZERO, ONE = number(0), number(1)


def add(a: Piece, b: Piece) -> Piece:
    """Return a + b."""
    if b.text.startswith("-") and b.rank >= PRODUCT:
        return _made(f"{a.at(SUM)} - {b.text[1:]}", SUM)
    return _made(f"{a.at(SUM)} + {b.at(PRODUCT)}", SUM)


def subtract(a: Piece, b: Piece) -> Piece:
    """Return a - b."""
    return _made(f"{a.at(SUM)} - {b.at(PRODUCT)}", SUM)


def multiply(a: Piece, b: Piece) -> Piece:
    """Return a*b."""
    return _made(f"{a.at(PRODUCT)}*{b.at(SIGNED)}", PRODUCT)


def divide(a: Piece, b: Piece) -> Piece:
    """Return a/b."""
    return _made(f"{a.at(PRODUCT)}/{b.at(SIGNED)}", PRODUCT)


def negative(a: Piece) -> Piece:
    """Return -a."""
    return _made(f"-{a.at(SIGNED)}", SIGNED)


def power(a: Piece, b: Piece) -> Piece:
    """Return a**b."""
    return _made(f"{a.at(ATOM)}**{b.at(SIGNED)}", POWER)


def call(name: str, *arguments: Piece) -> Piece:
    """Return a call of a function of the language."""
    return _made(f"{name}({', '.join(term.text for term in arguments)})", ATOM)


def joined(name: str, terms: Sequence[Piece]) -> Piece:
    """Return a call of a function of two arguments with more of them."""
    first, *others = terms
    for term in others:
        first = call(name, first, term)
    return first


def modulo(a: Piece, b: Piece) -> Piece:
    """Return the remainder that has the sign of b."""
    return call("mod", a, b)


def truncated(a: Piece, b: Piece) -> Piece:
    """Return the remainder that has the sign of a."""
    rest = modulo(call("abs", a), call("abs", b))
    return multiply(call("sign", a), rest)


def expm1(a: Piece) -> Piece:
    """Return exp(a) - 1 without its loss of digits near 0."""
    return multiply(call("tanh", divide(a, number(2))), add(call("exp", a), ONE))


def log1p(a: Piece) -> Piece:
    """Return log(1 + a) without its loss of digits near 0: what 1 + a is rounded by is added."""
    u = add(ONE, a)
    return subtract(call("log", u), divide(subtract(subtract(u, ONE), a), u))


def asinh(a: Piece) -> Piece:
    """Return the inverse of sinh."""
    size, square = call("abs", a), power(a, number(2))
    root = call("sqrt", add(square, ONE))
    return multiply(call("sign", a), log1p(add(size, divide(square, add(ONE, root)))))


def acosh(a: Piece) -> Piece:
    """Return the inverse of cosh."""
    t = subtract(a, ONE)
    return log1p(add(t, call("sqrt", multiply(t, add(a, ONE)))))


def atanh(a: Piece) -> Piece:
    """Return the inverse of tanh."""
    size = call("abs", a)
    ratio = divide(multiply(number(2), size), subtract(ONE, size))
    return divide(multiply(call("sign", a), log1p(ratio)), number(2))


def comparison(a: Piece, operator: str, b: Piece) -> Choice:
    """Return the condition that two terms compare so."""
    text, opposite = (
        _made(f"{a.text} {word} {b.text}", SUM).text for word in (operator, FLIPPED[operator])
    )
    return Choice(text, opposite=opposite)


def certain(holds: bool) -> Choice:
    """Return the condition that always or never holds."""
    return Choice("", certain=holds)


def both(a: Choice, b: Choice) -> Choice:
    """Return the condition that two hold."""
    for one, other in ((a, b), (b, a)):
        if one.certain is not None:
            return other if one.certain else one
    return Choice(_made(f"{a.at(BOTH)} and {b.at(NEGATED)}", SUM).text, BOTH)


def either(a: Choice, b: Choice) -> Choice:
    """Return the condition that one of two holds."""
    for one, other in ((a, b), (b, a)):
        if one.certain is not None:
            return one if one.certain else other
    return Choice(_made(f"{a.at(EITHER)} or {b.at(BOTH)}", SUM).text, EITHER)

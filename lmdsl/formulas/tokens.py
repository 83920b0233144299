"""The words of a formula: numbers, names and symbols, and the places where they stand."""

import keyword
import math
import re
from typing import Final, NamedTuple

from lmdsl.errors import BadInput, shown

_TOKEN: Final = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<symbol>\*\*|<=|>=|==|!=|[-+*/(),<>])"
)


_NUMBER_TAIL: Final = re.compile(r"[0-9A-Za-z_.]+")


class FormulaError(BadInput):
    """A formula that is refused.

    Parameters
    ----------
    message
        One line that starts with ``character N:``, N counted from 1.
    position
        The same place counted from 0.
    where
        The path of the field that holds the formula.
    """

    def __init__(self, message: str, position: int = 0, where: str = "") -> None:
        self.position = position
        super().__init__(message, where)


def fault_at(position: int, fault: str) -> FormulaError:
    """Return the error for a place, counted from 0."""
    return FormulaError(f"character {position + 1}: {fault}", position)


class Token(NamedTuple):
    """A word of a formula; the end is one too."""

    kind: str  # number, name, symbol or end
    text: str
    start: int


def scan(text: str, start: int) -> Token:
    """Return the next token from a place on."""
    while text[start : start + 1] in (" ", "\t"):
        start += 1
    if start == len(text):
        return Token("end", "", start)
    match = _TOKEN.match(text, start)
    if match is None:
        hint = "; write ** for powers" if text[start] == "^" else ""
        what = f"{shown(text[start])} is not part of the formula language"
        raise fault_at(start, what + hint)
    kind, word = str(match.lastgroup), match.group()
    if kind == "name" and keyword.iskeyword(word):
        raise fault_at(start, f"{shown(word)} is a Python keyword, not part of formulas")
    if kind == "number":
        tail = _NUMBER_TAIL.match(text, match.end())
        if tail or re.fullmatch("0+[1-9][0-9]*", word):
            number = shown(text[start : tail.end() if tail else match.end()])
            fix = "write one like 1.5e-3 or 7, and * for a product"
            raise fault_at(start, f"{number} is not a decimal number; {fix}")
        if math.isinf(float(word)):
            raise fault_at(start, f"{shown(word)} is too large; numbers end at about 1.8e308")
    return Token(kind, word, start)

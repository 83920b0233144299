"""The words of a formula: how its text is cut, and what to write instead of what is no word."""

import keyword
import math
import re
from collections.abc import Collection, Iterable, Mapping
from typing import Final, NamedTuple

from lmdsl.common import spelling
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.operations import CONNECTIVES, FORMULA_CONSTANTS, FORMULA_FUNCTIONS

_TOKEN: Final = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)|(?P<symbol>\*\*|<=|>=|==|!=|[-+*/(),<>])"
)
_NUMBER_TAIL: Final = re.compile(r"[0-9A-Za-z_.]+")
_LIBRARY: Final = re.compile(
    r"(?:np|numpy|math|cmath|torch|jnp|casadi|ca|cs|sp|sympy|scipy)\.([A-Za-z_][A-Za-z0-9_]*)"
)
# What is no part of the language, the longer first; nothing to say of what is a part.
_INSTEAD: Final = (
    ("//", "write floor(a/b)"), ("**", ""), ("%", "write mod(a, b)"), ("^", "write ** for powers"),
    ("&&", "write and"), ("&", "write and"), ("||", "write or"),
    ("|", "write abs(x), or the word or between conditions"), ("==", ""), ("!=", ""),
    ("!", "write not"), ("~", "write not"), ("=", "write == to compare"), ("<>", "write !="),
    ("[", "write round brackets"), ("{", "write round brackets"), ("\u00b2", "write **2"),
    ("\u03c0", "write pi"), ("\u2264", "write <="), ("\u2265", "write >="),
    ("\u00b3", "write **3"), ("\u00d7", "write *"), ("\u00b7", "write *"), ("\u2212", "write -"),
)  # fmt: skip

_KEYWORDS: Final = {"if": "write where(condition, a, b)", "else": "write where(condition, a, b)",
                    "lambda": "write the expression alone"}  # fmt: skip

# Functions as people write them.
HABITS: Final[Mapping[str, str]] = {
    "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "ln": "log",
    "arcsinh": "log(x + sqrt(x**2 + 1))", "log10": "log(x)/log(10)", "log2": "log(x)/log(2)",
    "log1p": "log(1 + x)", "expm1": "exp(x) - 1", "pow": "x**y", "power": "x**y", "sqr": "x**2",
    "square": "x**2", "cbrt": "sign(x)*abs(x)**(1/3)", "fabs": "abs", "absolute": "abs",
    "minimum": "min", "fmin": "min", "maximum": "max", "fmax": "max", "fmod": "mod",
    "remainder": "mod", "modulo": "mod", "rem": "mod", "sgn": "sign", "signum": "sign",
    "ceiling": "ceil", "round": "floor(x + 0.5)", "int": "floor", "trunc": "sign(x)*floor(abs(x))",
    "ifelse": "where", "iff": "where", "select": "where", "piecewise": "where", "norm": "abs",
    "heaviside": "where(x < 0, 0, 1)", "clip": "min(max(x, a), b)", "hypot": "sqrt(x**2 + y**2)",
    "deg2rad": "pi/180*x", "radians": "pi/180*x", "cot": "1/tan(x)", "sec": "1/cos(x)",
    "true": "1 < 2", "false": "1 > 2",
}  # fmt: skip


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


class UndeclaredName(FormulaError):
    """A formula with a name that has no value in it; ``name`` is that name."""

    def __init__(self, message: str, position: int, name: str, where: str = "") -> None:
        super().__init__(message, position, where)
        self.name = name


def fault_at(position: int, fault: str) -> FormulaError:
    """Return the error of a fault at a place, counted from 0."""
    return FormulaError(f"character {position + 1}: {fault}", position)


class Token(NamedTuple):
    """A word of a formula; ``kind`` is number, name, symbol or end."""

    kind: str
    text: str
    start: int


def scan(text: str, start: int) -> Token:
    """Return the first word at or behind a place.

    Raises
    ------
    FormulaError
        There is something else.
    """
    while text[start : start + 1] in (" ", "\t"):
        start += 1
    if start == len(text):
        return Token("end", "", start)
    match = _TOKEN.match(text, start)
    foreign = _foreign(text, start)
    if match is None or foreign:
        raise fault_at(start, foreign or _no_word(shown(text[start])))
    kind, word = str(match.lastgroup), match.group()
    if kind == "name" and word in CONNECTIVES:
        return Token("symbol", word, start)
    if kind == "name" and keyword.iskeyword(word):
        fix = f"; {_KEYWORDS[word]}" if word in _KEYWORDS else ""
        raise fault_at(start, f"{shown(word)} is a Python keyword, not part of formulas{fix}")
    if kind == "number":
        _require_number(text, word, start)
    return Token(kind, word, start)


def _foreign(text: str, start: int) -> str:
    """Return what to say of what other languages write, nothing where it is ours."""
    library = _LIBRARY.match(text, start)
    if library:
        known = {*FORMULA_FUNCTIONS, *FORMULA_CONSTANTS}
        name = library.group(1)
        meant = name if name in known else spelling.nearest(name, known, HABITS)
        meant = meant or HABITS.get(name.lower(), "the function of formulas alone")
        return f"{_no_word(shown(library.group()))}; write {meant}"
    for symbol, instead in _INSTEAD:
        if text.startswith(symbol, start):
            return f"{_no_word(shown(symbol))}; {instead}" if instead else ""
    return ""


def _no_word(what: str) -> str:
    return f"{what} is not part of the formula language"


def _require_number(text: str, number: str, start: int) -> None:
    tail = _NUMBER_TAIL.match(text, start + len(number))
    if tail or re.fullmatch("0+[1-9][0-9]*", number):
        written = shown(text[start : tail.end() if tail else start + len(number)])
        fix = "write one like 1.5e-3 or 7, and * for a product"
        raise fault_at(start, f"{written} is not a decimal number; {fix}")
    if math.isinf(float(number)):
        raise fault_at(start, f"{shown(number)} is too large; numbers end at about 1.8e308")


def called(text: str, token: Token) -> bool:
    """Return whether a name is followed by an opening bracket."""
    return text[token.start + len(token.text) :].lstrip(" \t").startswith("(")


def declared(names: Iterable[str]) -> str:
    """Return the declared names for a message."""
    listed = sorted(names)
    shortened = ", ".join(listed[:20]) + ", ..." * (len(listed) > 20)
    return f"declared names are {shortened}" if shortened else "no names are declared"


KINDS: Final = {"state": "a state", "control": "a control", "noise": "a noise variable"}
_MANY: Final = {"state": "states", "control": "controls", "noise": "noise"}


def elsewhere(
    fault: UndeclaredName,
    known: Mapping[str, Collection[str]],
    kinds: Collection[str],
    names: Collection[str],
) -> str:
    """Return what to say of a name that has a value in other formulas, if it has.

    Parameters
    ----------
    fault
        What is said of a name of which nothing is known.
    known
        The names of every kind.
    kinds, names
        The kinds and the names that have a value in this formula.
    """
    kind = next((kind for kind, of_kind in known.items() if fault.name in of_kind), None)
    if kind is None:
        return fault.message
    *most, last = [*(_MANY[kind] for kind in known if kind in kinds), "parameters"]
    return (
        f"character {fault.position + 1}: {shown(fault.name)} is {KINDS[kind]}, which has no value "
        f"here; this is a formula in {', '.join(most)} and {last}; {declared(names)}"
    )

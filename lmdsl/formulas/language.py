"""Text formulas: a small checked language with NumPy semantics that never runs code.

Grammar, loosest binding first, as in Python (``**`` groups to the right)::

    formula   : sum
    condition : both ("or" both)*
    both      : negation ("and" negation)*
    negation  : "not" negation | comparison
    comparison: sum ("<" | "<=" | ">" | ">=" | "==" | "!=") sum | "(" condition ")"
    sum       : product (("+" | "-") product)*
    product   : signed (("*" | "/") signed)*
    signed    : ("+" | "-") signed | power
    power     : atom ["**" signed]
    atom      : number | name | "(" sum ")" | function "(" sum ("," sum)* ")"
              | "where" "(" condition "," sum "," sum ")"

Numbers are Python's decimal literals without underscores, read as float64. Only blanks
and tabs separate. Nodes are numbers, names, operators (``and``, ``or``, ``not`` too), signs and
functions. Depth is the number of brackets, calls, signs (``not`` too) and powers that stand inside
one another: ``x`` has depth 0, ``sin((-x))`` depth 3. A flat chain of ``+ -``, ``* /``, ``and`` or
``or`` adds none, however long.

`parse` and `parse_condition` turn a text into a `Formula`, a flat list of subformulas, operands
before their users; `define` does so with the named subexpressions of a problem (``let``), which are
then written out in the formulas that use them, each once. `lmdsl.formulas.program.Program` joins
formulas, merges equal subformulas and evaluates them on arrays.
Nothing is reordered or simplified, save that a power with the constant exponent 2 is a square.
"""

import keyword
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Final, NamedTuple

from lmdsl.errors import BadInput, shown
from lmdsl.formulas.operations import CALLED, FORMULA_CONSTANTS, FORMULA_FUNCTIONS
from lmdsl.formulas.parser import Parser, Subformula
from lmdsl.formulas.tokens import FormulaError as FormulaError
from lmdsl.formulas.tokens import fault_at

MAX_NAME: Final = 64
# Nodes of a formula, those of the definitions that it uses included.
MAX_WRITTEN: Final = 10_000


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


class Definition(NamedTuple):
    """A named subexpression of a problem.

    Attributes
    ----------
    parts
        Its subformulas; other definitions stand in them as names.
    constant
        Its value if it has no names.
    names
        The declared names that it depends on, through other definitions too.
    uses
        The other definitions that it needs.
    """

    parts: tuple[Subformula, ...]
    constant: float | None
    names: frozenset[str]
    uses: frozenset[str]


# Named subexpressions in order: each uses earlier ones only.
Definitions = Mapping[str, Definition]

_ANY: Final = Definition((Subformula("constant"),), None, frozenset(), frozenset())

NO_DEFINITIONS: Final[Definitions] = MappingProxyType({})


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
    if name in {*FORMULA_FUNCTIONS, *FORMULA_CONSTANTS} - CALLED:
        raise BadInput(f"{shown(name)} has a meaning in formulas; choose another name")


def parse(text: str, names: Collection[str], definitions: Definitions = NO_DEFINITIONS) -> Formula:
    """Check a formula.

    Parameters
    ----------
    text
        The formula; at most 4,000 characters, 1,000 nodes and depth 50.
    names
        The declared names, each accepted by `check_name`.
    definitions
        Named subexpressions that it may use where their names are declared.

    Raises
    ------
    FormulaError
        If the text is not a formula, uses an undeclared name, or holds a number or
        constant subexpression that is infinite or not a number.
    """
    return _formula(Parser(text, names, definitions), definitions)


def parse_condition(
    text: str, names: Collection[str], definitions: Definitions = NO_DEFINITIONS
) -> Formula:
    """Check a condition, a formula that is 1 where it holds and 0 elsewhere; see :func:`parse`."""
    return _formula(Parser(text, names, definitions, condition=True), definitions)


def negation(condition: Formula) -> Formula:
    """Return the condition that holds where another does not."""
    last = Subformula("not", (len(condition.subformulas) - 1,))
    return Formula(f"not ({condition.text})", condition.names, (*condition.subformulas, last))


def define(
    texts: Mapping[str, str],
    names: Collection[str],
    faults: list[tuple[str, FormulaError]] | None = None,
) -> Definitions:
    """Check named subexpressions.

    Parameters
    ----------
    texts
        A formula for each name, in order; it may use earlier names.
    names
        The declared names.
    faults
        Takes what is refused, by name, instead of raising it; then it has any value.

    Raises
    ------
    FormulaError
        One of them is refused; ``where`` is its name.
    """
    found: dict[str, Definition] = {}
    for name, text in texts.items():
        try:
            parser = Parser(text, names, found, later=texts.keys() - found.keys())
        except FormulaError as error:
            if faults is None:
                raise FormulaError(error.message, error.position, name) from None
            faults.append((name, error))
            found[name] = _ANY
            continue
        used = {part.name for part in parser.subformulas if part.name}
        earlier = [found[other] for other in used if other in found]
        found[name] = Definition(
            tuple(parser.subformulas),
            parser.root.constant,
            frozenset(used - found.keys()).union(*(other.names for other in earlier)),
            frozenset(used & found.keys()).union(*(other.uses for other in earlier)),
        )
    return MappingProxyType(found)


@lru_cache(maxsize=4)
def defined(texts: tuple[tuple[str, str], ...], names: tuple[str, ...]) -> Definitions:
    """Return named subexpressions; a problem asks for them with each of its formulas."""
    return define(dict(texts), names)


def _formula(parser: Parser, definitions: Definitions) -> Formula:
    parts = parser.subformulas
    used = {part.name for part in parts if part.name in definitions}
    if used:
        parts = _written_out(parts, used.union(*(definitions[name].uses for name in used)),
                             definitions)  # fmt: skip
    names = frozenset(part.name for part in parts if part.name)
    return Formula(parser.text, names, tuple(parts))


def _written_out(
    parts: Collection[Subformula], used: Collection[str], definitions: Definitions
) -> list[Subformula]:
    """Return the subformulas of a formula behind those of the definitions that it needs."""
    pieces = {name: definitions[name].parts for name in definitions if name in used}
    size = len(parts) + sum(map(len, pieces.values()))
    if size > MAX_WRITTEN:
        raise fault_at(
            0,
            f"with its definitions in let the formula has {size:,} numbers, names and operators; "
            f"the limit is {MAX_WRITTEN:,}",
        )
    found: list[Subformula] = []
    root: dict[str, int] = {}
    for name, piece in {**pieces, "": parts}.items():  # no name is empty
        place: list[int] = []
        for part in piece:
            if part.name in root:
                place.append(root[part.name])
                continue
            place.append(len(found))
            found.append(part._replace(operands=tuple(place[k] for k in part.operands)))
        root[name] = place[-1]
    if root[""] != len(found) - 1:  # the formula is a definition's name; the last is its value
        found = found[: root[""] + 1]
    return found

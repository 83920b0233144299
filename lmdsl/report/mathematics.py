"""Formulas of a problem as MathML, which browsers set without any library.

A formula is drawn as it was written: names that ``let`` defines stay names, brackets follow from
precedence. A long one is shown as its text.
"""

import html
import math
from collections.abc import Callable, Collection, Sequence

from lmdsl.common.types import Floats
from lmdsl.errors import BadInput, printable
from lmdsl.formulas.parser import Parser, Subformula

LONGEST = 150  # numbers, names and operators above which a formula is shown as its text
# What binds more and more tightly.
OR, AND, SUM, NEGATIVE, PRODUCT, SIGN, POWER, ATOM, NAME = range(9)
GREEK = {
    "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η",
    "theta": "θ", "iota": "ι", "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ",
    "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ", "chi": "χ", "psi": "ψ", "omega": "ω",
    "Gamma": "Γ", "Delta": "Δ", "Theta": "Θ", "Lambda": "Λ", "Xi": "Ξ", "Pi": "Π", "Sigma": "Σ",
    "Phi": "Φ", "Psi": "Ψ", "Omega": "Ω",
}  # fmt: skip
COMPARED = {"<": "&lt;", "<=": "≤", ">": "&gt;", ">=": "≥", "==": "=", "!=": "≠"}
JOINED = {"or": OR, "and": AND}
MINUS = "<mo>−</mo>"
FENCED = {"abs": ("|", "|"), "floor": ("⌊", "⌋"), "ceil": ("⌈", "⌉")}
TIMES = '<mo>&#x2062;</mo><mspace width="0.17em"/>'

Typeset = tuple[str, int]  # MathML, and how tightly it binds


def number(value: float, digits: int = 6) -> str:
    """Return a number as text with a true minus sign: short, and exact where that is short."""
    text = f"{value + 0.0:.{digits}g}"
    return text.replace("-", "\N{MINUS SIGN}")


def name(text: str) -> str:
    """Return a declared name as MathML: Greek letters, and what follows as an index."""
    head, _, index = text.partition("_")
    if not head or "_" in index:
        head, index = text, ""
    elif not index:
        head = text
    letters = head.rstrip("0123456789")
    if not index and letters and letters != head:
        head, index = letters, head[len(letters) :]
    base = f"<mi>{html.escape(GREEK.get(head, head))}</mi>"
    if not index:
        return base
    of = "mn" if index.isdigit() else "mi"
    return f"<msub>{base}<{of}>{html.escape(GREEK.get(index, index))}</{of}></msub>"


def block(inner: str, wide: bool = True) -> str:
    """Return a whole formula, on a line of its own where it is ``wide``."""
    return f'<math display="block">{inner}</math>' if wide else f"<math>{inner}</math>"


def formula(text: str, names: Collection[str], condition: bool = False) -> str | None:
    """Return a formula as MathML without the element around it; None where it is too long.

    ``names`` are all that it may hold, those that ``let`` defines among them.
    """
    try:
        parsed = Parser(text, names, {}, condition)
    except BadInput:  # of a system that was made in Python, say
        return None
    parts = parsed.subformulas
    if len(parts) > LONGEST:
        return None
    drawn: list[Typeset] = []
    for part in parts:
        drawn.append(_drawn(part, [drawn[k] for k in part.operands]))
    return f"<mrow>{drawn[parsed.root.place][0]}</mrow>"


def shown(text: str, names: Collection[str], condition: bool = False) -> str:
    """Return a formula as MathML, or its text as code where it is too long."""
    found = formula(text, names, condition)
    return f"<mtext>{html.escape(printable(text[:400]))}</mtext>" if found is None else found


def equation(left: str, right: str, sign: str = "=") -> str:
    """Return a row of a table of equations."""
    return (
        f'<mtr><mtd style="text-align:right">{left}</mtd><mtd><mo>{sign}</mo></mtd>'
        f'<mtd style="text-align:left">{right}</mtd></mtr>'
    )


def table(rows: Sequence[str]) -> str:
    """Return equations below each other."""
    return block(f'<mtable displaystyle="true">{"".join(rows)}</mtable>')


def point(names: Sequence[str], values: Sequence[float] | Floats) -> str:
    """Return a state by name, such as (x, y) = (1, 2)."""
    left, right = (
        "<mo>,</mo>".join(parts)
        for parts in (map(name, names), (f"<mn>{number(float(v))}</mn>" for v in values))
    )
    if len(names) == 1:
        return f"{left}<mo>=</mo>{right}"
    return f"<mo>(</mo>{left}<mo>)</mo><mo>=</mo><mo>(</mo>{right}<mo>)</mo>"


def _in(drawn: Typeset, least: int) -> str:
    """Return an operand, in brackets where it binds less tightly."""
    text, rank = drawn
    return text if rank >= least else f"<mrow><mo>(</mo>{text}<mo>)</mo></mrow>"


def _drawn(part: Subformula, of: list[Typeset]) -> Typeset:
    operation = part.operation
    if operation == "constant":
        return _constant(part.value)
    if operation == "name":
        return name(part.name), NAME
    if operation in _RULES:
        return _RULES[operation](of)
    if operation in COMPARED:
        sign = COMPARED[operation]
        return f"{_in(of[0], SUM)}<mo>{sign}</mo>{_in(of[1], SUM)}", SUM
    if operation in JOINED:
        rank, word = JOINED[operation], f"<mtext>&#xA0;{operation}&#xA0;</mtext>"
        return f"{_in(of[0], rank)}{word}{_in(of[1], rank + 1)}", rank
    if operation in FENCED:
        left, right = FENCED[operation]
        return f"<mrow><mo>{left}</mo>{of[0][0]}<mo>{right}</mo></mrow>", ATOM
    inner = "<mo>,</mo>".join(text for text, _ in of)
    return f"<mi>{operation}</mi><mo>(</mo>{inner}<mo>)</mo>", ATOM


def _constant(value: float) -> Typeset:
    if value in (math.pi, math.e):
        return ("<mi>π</mi>" if value == math.pi else "<mi>e</mi>"), NAME
    mantissa, _, exponent = repr(value).removesuffix(".0").partition("e")
    if not exponent:
        return f"<mn>{mantissa}</mn>", NAME
    power = f"<msup><mn>10</mn><mn>{number(int(exponent))}</mn></msup>"
    return f"<mn>{mantissa}</mn><mo>·</mo>{power}", PRODUCT


def _times(of: list[Typeset]) -> Typeset:
    rank = NEGATIVE if of[0][1] == NEGATIVE else PRODUCT  # -k*x is (-k)*x, drawn without brackets
    left, right = _in(of[0], rank), _in(of[1], SIGN)
    return f"{left}{'<mo>·</mo>' if right.startswith('<mn>') else TIMES}{right}", rank


def _over(of: list[Typeset]) -> Typeset:
    return f"<mfrac><mrow>{of[0][0]}</mrow><mrow>{of[1][0]}</mrow></mfrac>", ATOM


def _power(of: list[Typeset]) -> Typeset:
    return f"<msup><mrow>{_in(of[0], NAME)}</mrow><mrow>{of[1][0]}</mrow></msup>", POWER


def _cases(of: list[Typeset]) -> Typeset:
    condition, then, other = (text for text, _ in of)
    rows = (
        f"<mtr><mtd>{then}</mtd><mtd><mtext>where&#xA0;</mtext>{condition}</mtd></mtr>"
        f"<mtr><mtd>{other}</mtd><mtd><mtext>elsewhere</mtext></mtd></mtr>"
    )
    return f"<mrow><mo>{{</mo><mtable>{rows}</mtable></mrow>", SUM


_RULES: dict[str, Callable[[list[Typeset]], Typeset]] = {
    "+": lambda of: (f"{_in(of[0], SUM)}<mo>+</mo>{_in(of[1], PRODUCT)}", SUM),
    "-": lambda of: (f"{_in(of[0], SUM)}{MINUS}{_in(of[1], PRODUCT)}", SUM),
    "negative": lambda of: (f"{MINUS}{_in(of[0], PRODUCT)}", NEGATIVE),
    "*": _times,
    "/": _over,
    "**": _power,
    "sqrt": lambda of: (f"<msqrt>{of[0][0]}</msqrt>", ATOM),
    "not": lambda of: (f"<mtext>not&#xA0;</mtext>{_in(of[0], ATOM)}", AND),
    "where": _cases,
}

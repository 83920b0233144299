"""SymPy expressions as systems and costs."""

from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from typing import Any

import numpy as np

from lmdsl.errors import BadInput, shown
from lmdsl.formulas.operations import FORMULA_FUNCTIONS
from lmdsl.systems.base import System
from lmdsl.systems.translated import systems, terms
from lmdsl.systems.translated.systems import Images, comes_from
from lmdsl.systems.translated.terms import ONE, ZERO, Choice, Piece, Untranslatable

# Functions that have the same name in the language.
SAME = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sign",
        "floor", "atan2")  # fmt: skip

# Functions that are written otherwise.
OTHER: dict[str, Callable[..., Piece]] = {
    "Abs": lambda a: terms.call("abs", a),
    "ceiling": lambda a: terms.call("ceil", a),
    "Max": lambda *a: terms.joined("max", a),
    "Min": lambda *a: terms.joined("min", a),
    "Mod": terms.modulo,
    "frac": lambda a: terms.subtract(a, terms.call("floor", a)),
    "sec": lambda a: terms.divide(terms.number(1), terms.call("cos", a)),
    "csc": lambda a: terms.divide(terms.number(1), terms.call("sin", a)),
    "cot": lambda a: terms.divide(terms.call("cos", a), terms.call("sin", a)),
    "Heaviside": lambda a, at_zero: terms.comparison(a, "<", ZERO).choose(
        ZERO, terms.comparison(a, ">", ZERO).choose(ONE, at_zero)
    ),
    "sinc": lambda a: terms.comparison(a, "==", ZERO).choose(
        ONE, terms.divide(terms.call("sin", a), a)
    ),
    "asinh": terms.asinh,
    "acosh": terms.acosh,
    "atanh": terms.atanh,
    "expm1": terms.expm1,
    "log1p": terms.log1p,
}


# Nodes of an expression that is written out, and how deep it may nest.
MOST, DEEPEST = 50_000, 150


def from_sympy(
    expressions: Mapping[Any, Any],
    parameters: Mapping[Any, float] | None = None,
    *,
    step: float | None = None,
    substeps: Any = None,
) -> System:
    """Return the system of SymPy expressions, one per state.

    Symbols have their names: those of the states are the keys, those of controls and noise are
    declared in the problem. ``q(t)`` (``dynamicsymbols``) has the name ``q``.

    Parameters
    ----------
    expressions
        State (a symbol or its name) to the expression of its next value; with ``step`` to that of
        its time derivative.
    parameters
        Symbols (or their names) that are constants, and their values.
    step, substeps
        The sampling time of a differential equation, and Runge-Kutta steps in it.

    Returns
    -------
    MapSystem or OdeSystem
        With formulas; a FunctionSystem, and a warning that names the reason, where the language of
        formulas lacks something.

    Raises
    ------
    BadInput
        The expressions are none, or SymPy is not installed.
    """
    sympy = systems.needed("sympy")
    if not isinstance(expressions, Mapping) or not expressions:
        raise BadInput("give a mapping from states to expressions, such as {x: x + u}", "system")
    wanted = {_name(key): _expression(sympy, value) for key, value in expressions.items()}
    wanted = {state: _real(value) for state, value in wanted.items()}
    images = Images(
        [*wanted],
        [_name(e) for e in _variables(wanted.values())],
        lambda: [text(value) for value in wanted.values()],
        lambda: _Lambdified(wanted),
    )
    constants = {_name(key): value for key, value in (parameters or {}).items()}
    return systems.system_of(images, constants, step, substeps)


def text(expression: Any) -> str:
    """Return the formula of a SymPy expression.

    Raises
    ------
    Untranslatable
        The language has no word for a part of it; the message names it.
    BadInput
        It is too large.
    """
    return _term(_real(expression)).text


def _term(e: Any) -> Piece:
    kind = type(e).__name__
    if e.is_Number or e.is_NumberSymbol:
        return _constant(e)
    if e.is_Symbol or _is_signal(e):
        return Piece(_name(e))
    if e.is_Add:
        return reduce(terms.add, map(_term, e.as_ordered_terms()))
    if e.is_Mul:
        return _product(e)
    if e.is_Pow:
        return _power(e.base, e.exp)
    if kind == "Piecewise":
        return _piecewise(e)
    arguments = [_term(a) for a in e.args] if kind in SAME or kind in OTHER else []
    if kind in SAME and len(arguments) == FORMULA_FUNCTIONS[kind]:
        return terms.call(kind, *arguments)
    if kind in OTHER:
        return OTHER[kind](*arguments)
    raise Untranslatable(kind if e.args else shown(str(e)))


def _constant(e: Any) -> Piece:
    known = {"Pi": "pi", "Exp1": "e"}.get(type(e).__name__)
    if known:
        return Piece(known)
    if not e.is_finite or not e.is_real:
        raise Untranslatable(f"the constant {e}")
    if e.is_Rational and not e.is_Integer:
        return terms.divide(terms.number(e.p), terms.number(e.q))
    return terms.number(int(e) if e.is_Integer else float(e))


def _product(e: Any) -> Piece:
    """Return a product as one fraction."""
    above: list[Piece] = []
    below: list[Piece] = []
    for factor in e.as_ordered_factors():
        if factor.is_Rational and not factor.is_Integer:
            above += [terms.number(factor.p)] * (abs(factor.p) != 1 or factor.p < 0)
            below.append(terms.number(factor.q))
        elif factor.is_Pow and factor.exp.could_extract_minus_sign():
            below.append(_power(factor.base, -factor.exp))
        else:
            above.append(_term(factor))
    if len(above) > 1 and above[0].text == "-1":
        above[:2] = [terms.negative(above[1])]
    top = reduce(terms.multiply, above) if above else terms.number(1)
    return reduce(terms.divide, below, top)


def _power(base: Any, exponent: Any) -> Piece:
    if exponent.is_Number and exponent == 1:
        return _term(base)
    if exponent.could_extract_minus_sign():
        return terms.divide(terms.number(1), _power(base, -exponent))
    if exponent.is_Rational and exponent.p == 1 and exponent.q == 2:
        return terms.call("sqrt", _term(base))
    return terms.power(_term(base), _term(exponent))


def _piecewise(e: Any) -> Piece:
    *pieces, (last, always) = e.args
    if always != True:  # noqa: E712  SymPy's own truth
        raise Untranslatable("a Piecewise without (value, True) at its end")
    chosen = _term(last)
    for value, condition in reversed(pieces):
        chosen = _condition(condition).choose(_term(value), chosen)
    return chosen


def _condition(e: Any) -> Choice:
    kind = type(e).__name__
    if e.is_Relational:
        return terms.comparison(_term(e.lhs), e.rel_op, _term(e.rhs))
    if kind == "Not":
        return _condition(e.args[0]).negated()
    if kind in ("And", "Or"):
        return reduce(terms.both if kind == "And" else terms.either, map(_condition, e.args))
    if kind == "ITE":
        test, yes, no = map(_condition, e.args)
        return terms.either(terms.both(test, yes), terms.both(test.negated(), no))
    if kind in ("BooleanTrue", "BooleanFalse"):
        return terms.certain(kind == "BooleanTrue")
    raise Untranslatable(f"the condition {kind}")


def _is_signal(e: Any) -> bool:
    """Return whether an expression is an undefined function of one symbol, such as q(t)."""
    from sympy.core.function import AppliedUndef

    return isinstance(e, AppliedUndef) and len(e.args) == 1 and bool(e.args[0].is_Symbol)


def _name(key: Any) -> str:
    """Return the name of a symbol, of a signal, or of who is called so."""
    if isinstance(key, str):
        return key
    if comes_from("sympy", key) and getattr(key, "is_Symbol", False):
        return str(key.name)
    if comes_from("sympy", key) and _is_signal(key):
        return str(key.func.__name__)
    raise BadInput(f"{shown(key)} is neither a symbol nor a name", "system")


def _expression(sympy: Any, value: Any) -> Any:
    try:
        expression = sympy.sympify(value, strict=True)
    except (sympy.SympifyError, TypeError):
        expression = None
    if not isinstance(expression, sympy.Expr):
        raise BadInput(f"{shown(value)} is no SymPy expression", "system")
    _require_small(expression)
    if expression.atoms(sympy.Derivative):
        expression = expression.doit()
    for rate in expression.atoms(sympy.Derivative):
        raise BadInput(f"{rate} is no state; make one of it, and substitute its name", "system")
    return expression


def _real(expression: Any) -> Any:
    """Return an expression in real symbols, as all variables are: re(x) is x then."""
    from sympy import Symbol

    _require_small(expression)
    found = _variables([expression])
    return expression.xreplace({e: Symbol(_name(e), real=True) for e in found})


def _require_small(expression: Any) -> None:
    """Refuse what SymPy itself could not go through: parts that are shared are gone through anew.

    Raises
    ------
    BadInput
        Written out, the expression is very large or deep.
    """
    sizes: dict[Any, tuple[int, int]] = {}
    waiting = [expression]
    while waiting:
        e = waiting[-1]
        missing = [each for each in e.args if each not in sizes]
        if missing:
            waiting += missing
            continue
        waiting.pop()
        parts = [sizes[each] for each in e.args]
        size, depth = 1 + sum(n for n, _ in parts), 1 + max((d for _, d in parts), default=0)
        if size > MOST or depth > DEEPEST:
            raise BadInput(
                f"written out, an expression has more than {MOST:,} nodes, or {DEEPEST} inside one "
                "another; simplify it, or write a Python function"
            )
        sizes[e] = size, depth


def _variables(expressions: Iterable[Any]) -> list[Any]:
    """Return symbols and signals; the time that signals depend on is none of them."""
    found, seen, waiting = list[Any](), set[Any](), [*expressions]
    while waiting:
        e = waiting.pop()
        if e in seen:
            continue
        seen.add(e)
        if e.is_Symbol or _is_signal(e):
            found.append(e)
        else:
            waiting += e.args
    return found


class _Lambdified:
    """SymPy expressions as a function of arrays by name."""

    def __init__(self, expressions: Mapping[str, Any]) -> None:
        from sympy import lambdify

        variables = _variables(expressions.values())
        self.states, self.names = [*expressions], [_name(e) for e in variables]
        self.function = lambdify(variables, [*expressions.values()], ["scipy", "numpy"])
        try:
            with np.errstate(all="ignore"):
                self(**{name: np.full(2, 0.5) for name in self.names})
        except Exception as error:
            raise BadInput(f"SciPy cannot compute this either: {error}", "system") from None

    def __call__(self, **values: Any) -> dict[str, Any]:
        found = self.function(*(values[name] for name in self.names))
        return dict(zip(self.states, found, strict=True))

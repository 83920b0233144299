"""Translations where the other tool is missing, and the texts that they put together."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import lmdsl as lm
from lmdsl.errors import MissingDependency
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program
from lmdsl.systems.translated import systems, terms
from lmdsl.systems.translated.terms import Piece, Untranslatable

A, B = Piece("a"), Piece("b")


@pytest.mark.parametrize("package", ["sympy", "casadi"])
def test_a_package_that_is_missing_is_named(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependency, match=rf"needs the package {package}: pip install"):
        getattr(lm.systems, f"from_{package}")({"x": 1})


def test_they_are_imported_when_they_are_used():
    code = "import sys, lmdsl; lmdsl.systems; print({'sympy', 'casadi'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize(("term", "text"), [
    (terms.add(A, terms.negative(B)), "a - b"),
    (terms.add(A, terms.number(-2)), "a - 2"),
    (terms.add(A, terms.add(B, A)), "a + (b + a)"),
    (terms.subtract(A, terms.subtract(B, A)), "a - (b - a)"),
    (terms.subtract(A, terms.number(-2)), "a - -2"),
    (terms.multiply(terms.add(A, B), A), "(a + b)*a"),
    (terms.multiply(A, terms.multiply(B, A)), "a*(b*a)"),
    (terms.multiply(A, terms.negative(B)), "a*-b"),
    (terms.divide(A, terms.divide(B, A)), "a/(b/a)"),
    (terms.negative(terms.add(A, B)), "-(a + b)"),
    (terms.negative(terms.multiply(A, B)), "-(a*b)"),
    (terms.negative(terms.power(A, B)), "-a**b"),
    (terms.power(terms.power(A, B), A), "(a**b)**a"),
    (terms.power(A, terms.power(B, A)), "a**b**a"),
    (terms.power(terms.number(-2), A), "(-2)**a"),
    (terms.power(A, terms.number(-2)), "a**-2"),
    (terms.number(0.1), "0.1"), (terms.number(3.0), "3"), (terms.number(1e300), "1e+300"),
])  # fmt: skip
def test_brackets_stand_where_they_are_needed(term, text):
    assert term.text == text


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 10**400])
def test_constants_are_finite(value):
    with pytest.raises(Untranslatable, match="constant"):
        terms.number(value)


def test_conditions_and_their_opposites():
    """Every combination of two comparisons, at every pair of truth values."""
    first, second = terms.comparison(A, "<", terms.ONE), terms.comparison(B, ">=", terms.ONE)
    for choice, holds in (
        (terms.both(first, second), lambda p, q: p and q),
        (terms.either(first, second), lambda p, q: p or q),
        (terms.both(first, second.negated()), lambda p, q: p and not q),
        (terms.certain(True), lambda p, q: True),
        (terms.both(first, terms.certain(False)), lambda p, q: False),
    ):
        for chosen, wanted in ((choice, True), (choice.negated(), False)):
            term = chosen.choose(Piece("10 + 0*a"), Piece("20 + 0*b"))
            formula = Program([parse(term.text, ("a", "b"))])
            for a in (0.0, 2.0):
                for b in (0.0, 2.0):
                    value = formula({"a": a, "b": b})[0]
                    assert value == (10 if bool(holds(a < 1, b >= 1)) is wanted else 20)


SMALL = np.concatenate([10.0 ** np.arange(-300, 0, 7), np.linspace(1e-3, 1, 40)])
WIDE = np.concatenate([-SMALL, SMALL])


@pytest.mark.parametrize(("name", "at"), [
    ("expm1", np.concatenate([WIDE, np.linspace(-745, 709, 60)])),
    ("log1p", np.concatenate([WIDE[WIDE > -1] * 0.999, 10.0 ** np.arange(1, 300, 9)])),
    ("asinh", np.concatenate([WIDE, 10.0 ** np.arange(1, 150, 9)])),
    ("acosh", np.concatenate([1 + SMALL, 10.0 ** np.arange(1, 150, 9)])),
    ("atanh", np.concatenate([WIDE[abs(WIDE) < 1], 1 - 10.0 ** -np.arange(1, 15), [-0.99999]])),
])  # fmt: skip
def test_functions_that_are_written_out_lose_no_digits(name, at):
    """Where exp(x) - 1 or log(1 + x) would keep none: at 1e-300, and everywhere between."""
    formula = Program([parse(getattr(terms, name)(A).text, ("a",))])
    exact = {"asinh": np.arcsinh, "acosh": np.arccosh, "atanh": np.arctanh}
    wanted = exact.get(name, getattr(np, name, None))(at)
    np.testing.assert_allclose(formula({"a": at})[0], wanted, rtol=2e-15)


def test_formulas_that_are_refused_are_no_translation():
    with pytest.raises(Untranslatable, match="refuses"):
        systems.require_size({"x": "x" + "*x" * 1500}, ["x"])

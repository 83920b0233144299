"""Formulas as MathML: what is drawn means what was written, read by an independent reader."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from formula_texts import Oracle
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made, steps

import lmdsl as lm
from lmdsl.formulas.operations import FORMULA_FUNCTIONS
from lmdsl.report import mathematics as m
from lmdsl.report.declared import problem_of

NAMES = {"x": 0.7, "theta": -1.3, "x_1": 2.1, "k12": 0.4, "a_b_c": 1.7, "Omega": -0.2}
SPOKEN = {letter: name for name, letter in m.GREEK.items()}
SIGNS = {"−": "-", "·": "*", "\u2062": "*", "≤": "<=", "≥": ">=", "=": "==", "≠": "!="}
FENCES = {"⌊": "floor", "⌈": "ceil", "|": "abs"}


def said(element):
    """The Python text of an element: what a reader of mathematics takes it to be."""
    tag, parts = element.tag, list(element)
    words = element.text or ""
    if tag == "mi":
        return SPOKEN.get(words, {"π": "pi"}.get(words, words))
    if tag == "mn":
        return words.replace("−", "-")
    if tag == "mo":
        return SIGNS.get(words, words)
    if tag == "mtext":
        return words.replace("\xa0", " ")
    if tag == "mspace":
        return ""
    if tag == "mfrac":
        return f"(({said(parts[0])})/({said(parts[1])}))"
    if tag == "msqrt":
        return f"sqrt({''.join(map(said, parts))})"
    if tag == "msup":
        return f"(({said(parts[0])})**({said(parts[1])}))"
    if tag == "msub":
        base, index = map(said, parts)
        joined = f"{base}_{index}"
        return joined if joined in NAMES else base + index
    if tag == "mrow" and parts and parts[0].text in FENCES:
        return f"{FENCES[parts[0].text]}({''.join(map(said, parts[1:-1]))})"
    if len(parts) == 2 and parts[0].text == "{":
        (then, condition), (other, _) = ([*map(said, row)] for row in parts[1])
        return f"where({condition.removeprefix('where ')}, {then}, {other})"
    return "".join(map(said, parts))


def same(text, condition=False):
    """Whether the MathML of a formula has the formula's value."""
    drawn = m.formula(text, NAMES, condition)
    meant = said(ET.fromstring(m.block(drawn)))
    a, b = (Oracle(NAMES)(t) for t in (text, meant))
    return bool(np.isclose(a, b, rtol=1e-9, equal_nan=True)), meant


NUMBERS = st.sampled_from(["0", "1", "2", "0.5", "3.25", "1e-07", "2e+20"])
LEAVES = st.one_of(NUMBERS, st.sampled_from([*NAMES, "pi", "e"]))


TWO = st.sampled_from(["+", "-", "*", "/", "**"])
ONE = st.sampled_from(sorted(name for name, count in FORMULA_FUNCTIONS.items() if count == 1))


def grown(inner):
    return st.one_of(
        st.tuples(inner, TWO, inner).map(lambda t: f"({t[0]}){t[1]}({t[2]})"),
        st.tuples(inner, TWO, LEAVES).map(lambda t: f"{t[0]}{t[1]}{t[2]}"),
        inner.map(lambda t: f"-{t}"),
        st.tuples(ONE, inner).map(lambda t: f"{t[0]}({t[1]})"),
        st.tuples(inner, st.sampled_from(["<", "<=", "=="]), inner, inner).map(
            lambda t: f"where({t[0]} {t[1]} {t[2]}, {t[3]}, 2)"
        ),
    )


@settings(max_examples=150, deadline=None)
@given(st.recursive(LEAVES, grown, max_leaves=9))
def test_what_is_drawn_means_what_was_written(text):
    if m.formula(text, NAMES) is not None:  # else a constant in it is not finite
        good, meant = same(text)
        assert good, f"{text} is drawn as {meant}"


@pytest.mark.parametrize(
    "text",
    ["(x + theta)**2", "-x*theta", "-(x - theta)", "(-x + theta)*k12", "x - (theta - k12)", "2**-x",
     "x/(theta*k12)*2", "-x**2", "(-x)**2", "(x/2)**2", "2*3*x", "x*(theta/2)**2", "x - -theta"],
)  # fmt: skip
def test_signs_and_brackets(text):
    assert same(text)[0], same(text)[1]


@pytest.mark.parametrize(
    "text",
    ["x < 1 and theta > 2 or x == 3", "(x < 1 or theta > 2) and x < 3", "not (x < 1 and x > 0)",
     "not x < 1", "x < 1 and x > 0 and theta < 0", "x <= 1 or x > 0 or theta < 0"],
)  # fmt: skip
def test_conditions(text):
    assert same(text, True)[0], same(text, True)[1]


def test_wrong_mathematics_is_noticed():
    """The reader tells a bracket that is missing: else the tests above test nothing."""
    wrong = m.formula("x + theta*2", NAMES)
    assert said(ET.fromstring(m.block(wrong))) != said(
        ET.fromstring(m.block(m.formula("(x + theta)*2", NAMES)))
    )


def test_names_are_set_as_people_write_them():
    assert m.name("theta") == "<mi>θ</mi>"
    assert m.name("x_1") == "<msub><mi>x</mi><mn>1</mn></msub>"
    assert m.name("k12") == "<msub><mi>k</mi><mn>12</mn></msub>"
    assert m.name("omega_max") == "<msub><mi>ω</mi><mi>max</mi></msub>"
    for odd in ("_", "__a", "a_", "a_b_c", "_1"):
        assert "".join(ET.fromstring(f"<math>{m.name(odd)}</math>").itertext()) == odd


def test_what_is_too_long_or_no_formula_is_text():
    long = "+".join(["x"] * 300)
    assert m.formula(long, NAMES) is None
    assert m.shown(long, NAMES).startswith("<mtext>x+x")
    assert m.shown("<script>", NAMES) == "<mtext>&lt;script&gt;</mtext>"
    assert m.formula("x +", NAMES) is None


def told_of(**more):
    """What a page declares of a problem, by name: the text and the mathematics of each row."""
    result = lm.solve(made(steps(**more)))
    return result, {row["name"]: row for row in problem_of(result)["rows"]}


@pytest.mark.parametrize(("attractor", "cells", "which"), [
    ({"points": [[0.1]]}, "1 cell", "those around the points"),
    ({"points": [[0.25]]}, "2 cells", "those around the points"),
    ({"boxes": [{"x": [0, 0.45]}]}, "1 cell", "those wholly inside a box"),
    ({"where": "x <= 0.6"}, "2 cells", "those on all of which a condition certainly holds"),
    ({"points": [[0.1]], "boxes": [{"x": [0.25, 0.5]}]}, "2 cells",
     "those around the points, those wholly inside a box"),
    ({"cells": [[0]]}, "1 cell", "1 cells by their indices"),
])  # fmt: skip
def test_the_cells_of_the_attractor_are_counted_and_named(attractor, cells, which):
    _, rows = told_of(attractor=attractor)
    assert rows["attractor A"]["text"].startswith(f"{cells}: {which}")


@pytest.mark.parametrize(("partial", "said"), [
    (True, "2 cells, of which 1 holds what arrives: those wholly inside a box"),
    (False, "1 cell that holds what arrives, of those wholly inside a box"),
])  # fmt: skip
def test_cells_that_hold_are_counted(partial, said):
    """Of 4 cells the second is kept; from the first runs go to the third, and from there back."""
    image = "where(x < 0.25, x + 0.5, where(x < 0.5, x, x - 0.25*u))"
    system = {"kind": "map", "next": {"x": image}}
    held = {"kind": "hold", "partial": partial}
    _, rows = told_of(local_controller=held, attractor={"boxes": [{"x": [0, 0.5]}]}, system=system)
    assert rows["attractor A"]["text"] == said


def test_cells_that_are_avoided_are_counted():
    _, rows = told_of(avoid={"boxes": [{"x": [0.8, 0.9]}]})
    assert rows["avoid Z"]["text"] == "1 cell: all that meet"


def test_derivatives_are_fractions():
    """A dot above a letter runs into it in Chromium."""
    rate = {"theta": "-0.25*u"}
    data = steps(system={"kind": "ode", "derivative": rate, "step": 1.0},
                 state_box={"theta": {"low": 0, "high": 1, "cells": 4}})  # fmt: skip
    (drawn,) = problem_of(lm.solve(made(data)))["equations"]
    assert "mover" not in drawn
    (left,) = list(ET.fromstring(drawn).iter("mfrac"))[:1]
    assert ["".join(part.itertext()) for part in left] == ["dθ", "dt"]

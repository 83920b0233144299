"""Conditions and mod: an evaluation through Python agrees, and enclosures decide soundly."""

from __future__ import annotations

import ast
import math
from fractions import Fraction

import numpy as np
import pytest
from formula_texts import NAMES, Oracle, same_bits
from hypothesis import given, settings
from hypothesis import strategies as st

from lmdsl.formulas.enclosures import Jet, apply
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.language import Formula, FormulaError, negation, parse, parse_condition
from lmdsl.formulas.program import Program

POINTS = {
    "x": np.array([-1.5, -0.0, 0.3, 2.0, np.nan]),
    "y": np.array([[0.0], [-2.0], [0.5]]),
    "u": np.array([[[1.0]], [[-0.75]]]),
}


def conditions():
    numbers = st.sampled_from(["0", "0.5", "x", "y", "u", "x*y", "mod(x, y)", "-u", "sqrt(x)"])
    comparison = st.tuples(
        numbers, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), numbers
    ).map(" ".join)

    def grow(inner):
        return st.one_of(
            st.tuples(inner, st.sampled_from(["and", "or"]), inner).map(" ".join),
            inner.map("not {}".format),
            inner.map("({})".format),
        )

    return st.recursive(comparison, grow, max_leaves=8)


@settings(max_examples=300, deadline=None)
@given(conditions())
def test_conditions_agree_with_an_evaluation_through_python(text):
    expected = np.asarray(Oracle(POINTS)(text), dtype=float)
    found = Program([parse_condition(text, NAMES)])(POINTS)[0]
    assert same_bits(found, expected)
    opposite = Program([negation(parse_condition(text, NAMES))])(POINTS)[0]
    assert same_bits(opposite, 1 - expected)


@pytest.mark.parametrize("operator", ["and", "or"])
def test_precedence_is_that_of_python(operator):
    other = {"and": "or", "or": "and"}[operator]
    text = f"not x < 1 {operator} y < 1 {other} u < 1 {operator} not not x < 3"
    for x in (0.0, 2.0, 4.0):
        for y in (0.0, 2.0):
            for u in (0.0, 2.0):
                names = {"x": x, "y": y, "u": u}
                expected = eval(text, {"__builtins__": {}}, names)
                assert Program([parse_condition(text, NAMES)])(names)[0] == expected


def test_what_is_no_condition():
    for text, position, says in [
        ("x", 0, "'x' is not a comparison; write one such as x < 1"),
        ("", 0, "write a condition such as x < 1"), ("x < 1 and", 9, "ends"),
        ("(x < 1) + 1 > 0", 3, "comparison"), ("x < y < 1", 6, "compares again"),
        ("z < 1", 0, "declared names are u, x, y"), ("x < 1, y < 1", 5, "','"),
        ("where(x < 1, 1, 2)", 0, "is not a comparison"), ("x = 1", 2, "write == to compare"),
        ("0 < 1/0", 4, "infinite"), ("not", 3, "ends"), ("x < 1 y < 1", 6, "missing"),
    ]:  # fmt: skip
        with pytest.raises(FormulaError, match=says) as caught:
            parse_condition(text, NAMES)
        assert caught.value.position == position, text
    assert isinstance(parse_condition("1 < 2", ()), Formula)


def test_limits_hold_for_conditions():
    parse_condition(" and ".join(["x<1"] * 250), NAMES)
    for text, says in [
        (" and ".join(["x<1"] * 251), "more than 1,000"), ("x<" + "1" * 4000, "characters"),
        ("not " * 51 + "x<1", "deeper than 50"), ("(" * 51 + "x<1" + ")" * 51, "deeper"),
        ("not " * 900 + "x<1", "deeper"), ("(not " * 700, "deeper"),
    ]:  # fmt: skip
        with pytest.raises(FormulaError, match=says):
            parse_condition(text, NAMES)
    parse_condition("not " * 50 + "x<1", NAMES)


def test_mod_is_a_name_too():
    names = {"mod": 3.0, "x": 7.5}
    assert Program([parse("mod + mod(x, mod) - mod (x, 2)", names)])(names)[0] == 3 + 1.5 - 1.5
    assert Program([parse_condition("mod < 4 and mod(x, 2) > 1", names)])(names)[0] == 1
    with pytest.raises(FormulaError, match="'mod' is a function"):
        parse("mod + 1", {"x"})


def boxes_of(rng, n):
    centre = rng.uniform(-3, 3, (2, n)) * rng.choice([1, 1, 1e3], n)
    centre = np.where(rng.random(n) < 0.3, np.round(centre), centre)
    low = centre - 10.0 ** rng.choice([-16, -9, -3, -1, 0], (2, n)) * rng.random((2, n))
    return low, np.maximum(low, centre)


@settings(max_examples=150, deadline=None)
@given(conditions(), st.integers(0, 2**31))
def test_what_is_decided_on_a_box_holds_at_its_points(text, seed):
    rng = np.random.default_rng(seed)
    low, high = boxes_of(rng, 40)
    u = rng.choice([-0.5, 0.0, 1.0], 40)
    program = Program([parse_condition(text, NAMES)])
    ends = {"x": Interval(low[0], high[0]), "y": Interval(low[1], high[1])}
    surely, possibly = program.decide({**ends, "u": Interval(u, u)})[0]
    surely, possibly = np.broadcast_to(surely, 40), np.broadcast_to(possibly, 40)
    assert not (surely & ~possibly).any()
    for share in (0.0, 1.0, 0.5, *rng.random(12)):
        x, y = np.clip(low + share * (high - low), low, high)
        if rng.random() < 0.5:
            y = np.where(rng.random(40) < 0.5, low[1], high[1])
        held = np.broadcast_to(program({"x": x, "y": y, "u": u})[0], 40) != 0
        assert held[surely].all(), text
        assert not held[~possibly].any(), text


def test_a_condition_of_undefined_values_is_undecided():
    box = {"x": Interval(np.array([-1.0, -2.0]), np.array([1.0, -1.0]))}
    for text in ("sqrt(x) >= 0", "not sqrt(x) >= 0", "1/x != 0 and sqrt(x) < 9", "log(x) != 1"):
        surely, possibly = Program([parse_condition(text, {"x"})]).decide(box)[0]
        assert not surely.any(), text
        assert possibly.all(), text
    program = Program([parse_condition("x < 2 or sqrt(x) < 0", {"x"})])
    assert program.decide(box)[0][0].all()
    assert Program([parse_condition("2 < 1", {"x"})]).decide({})[0] == (False, False)


def test_mod_is_enclosed_for_every_sign_size_and_jump():
    """Against exact remainders: values, computed values, errors; one turn gives a tight box."""
    rng = np.random.default_rng(2)
    n = 4000
    b = rng.choice([1.0, -1.0, 2 * math.pi, -0.1, 1e-3, 7e5], n)
    a = b * (np.round(rng.uniform(-9, 9, n)) + rng.choice([0, 0, 1e-16, -1e-16, 0.3, -0.4], n))
    a = np.where(rng.random(n) < 0.1, a * 1e17, a)
    high = a + np.abs(b) * 10.0 ** rng.choice([-17, -9, -2, 0.2], n)
    variable = Jet.variable(Interval(a, high), 0, 1)
    with np.errstate(all="ignore"):
        jet = apply(
            "mod", [variable, Jet(Interval.point(b), Interval.point(np.zeros((1, n))), 0.0)]
        )
    for share in (0.0, 1.0, 0.3, 0.9):
        x = np.clip(a + share * (high - a), a, high)
        found = np.mod(x, b)
        assert ((found >= jet.value.low) & (found <= jet.value.high)).all()
        for k in range(0, n, 7):
            p, q = Fraction(float(x[k])), Fraction(float(b[k]))
            exact = p - q * math.floor(p / q)
            assert jet.value.low[k] <= exact <= jet.value.high[k]
            assert abs(Fraction(float(found[k])) - exact) <= Fraction(float(jet.error[k]))
    tight = (jet.value.high - jet.value.low) < 0.5 * np.abs(b)
    one = np.floor(a / b) == np.floor(high / b)
    assert (tight & one).sum() > 1000
    assert (jet.value.high - jet.value.low <= 1.001 * np.abs(b)).all()
    smooth = np.isfinite(jet.slope.low[0])
    assert smooth.sum() > 500
    assert ((jet.slope.low[0] <= 1) & (jet.slope.high[0] >= 1)).all()


def test_mod_of_what_may_be_zero_or_undefined_claims_nothing():
    def box(low, high):
        return Jet(
            Interval(np.array([low]), np.array([high])), Interval.point(np.zeros((0, 1))), 0.0
        )

    with np.errstate(all="ignore"):
        for a, b in (((0, 1), (-1, 1)), ((0, 1), (0, 1)), ((-np.inf, np.inf), (1, 2)),
                     ((0, 1), (1, np.inf))):  # fmt: skip
            value = apply("mod", [box(*a), box(*b)]).value
            assert (value.low[0], value.high[0]) == (-np.inf, np.inf), (a, b)
        value = apply("mod", [box(7.0, 7.5), box(2.0, 2.25)]).value  # floors 3: 7 - 6.75, 7.5 - 6
        assert abs(value.low[0] - 0.25) < 1e-12
        assert abs(value.high[0] - 1.5) < 1e-12


def test_slopes_of_mod_are_those_of_differences():
    tree = "mod(3*x, 2) + mod(x, y)"
    assert isinstance(ast.parse(tree), ast.Module)
    program = Program([parse(tree, {"x", "y"})])
    x, y = np.array([0.5, 1.1, -2.3]), np.array([0.7, -0.4, 3.0])
    jets = {"x": Jet.variable(Interval(x, x), 0, 2), "y": Jet.variable(Interval(y, y), 1, 2)}
    slope = program.enclose(jets)[0].slope
    h = 1e-7
    for k, name in enumerate("xy"):
        at = {"x": x, "y": y}
        up, down = ({**at, name: at[name] + s} for s in (h, -h))
        rise = (program(up)[0] - program(down)[0]) / (2 * h)
        assert (np.abs(rise - slope.low[k]) < 1e-5).all()
        assert (np.abs(rise - slope.high[k]) < 1e-5).all()

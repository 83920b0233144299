"""Formulas: an independent evaluation must agree to the bit, all else must be refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from formula_texts import NAMES, UFUNCS, Oracle, formula_or_refusal, refused, same_bits, value
from hypothesis import given, settings
from hypothesis import strategies as st

from lmdsl.formulas.language import Formula, parse
from lmdsl.formulas.operations import FORMULA_CONSTANTS, FORMULA_FUNCTIONS
from lmdsl.formulas.program import Program

JOINED = ["{0}", "({0})", "not {0}", "{0} and {1}", "{0} or\t{1}", "not ({0} or {1})",
          "{0} and not {1} or {0}", "not not {0}", "({0} or {1}) and {1}"]  # fmt: skip


def conditions(inner):
    blanks = st.sampled_from(["", " ", "\t"])
    comparison = st.tuples(
        inner, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), blanks, inner
    ).map("".join)
    return st.builds(str.format, st.sampled_from(JOINED), comparison, comparison)


def expressions():
    numbers = st.one_of(
        st.integers(0, 12).map(str),
        st.floats(0, 1e3, allow_subnormal=False).map(repr),
        st.sampled_from(["pi", "e", ".5", "2.", "1e-3", "5E+1", "00", "0.0", "2", "007.5"]),
    )
    leaves = st.one_of(numbers, st.sampled_from(NAMES), st.sampled_from(NAMES))
    blanks = st.sampled_from(["", "", " ", "\t", "  "])

    def grow(inner):
        def call(arity):
            names = sorted(name for name, count in FORMULA_FUNCTIONS.items() if count == arity)
            return st.tuples(st.sampled_from(names), *[inner] * arity).map(
                lambda parts: f"{parts[0]}({','.join(parts[1:])})"
            )

        binary = st.tuples(inner, blanks, st.sampled_from(["+", "-", "*", "/", "**"]), inner)
        return st.one_of(
            binary.map("".join),
            binary.map("".join),
            st.tuples(st.sampled_from(["-", "+", "- "]), inner).map("".join),
            inner.map("({})".format),
            call(1),
            call(2),
            st.tuples(conditions(inner), inner, inner).map(
                lambda p: f"where({p[0]}, {p[1]} ,{p[2]})"
            ),
        )

    return st.recursive(leaves, grow, max_leaves=12)


POINTS = {
    "x": np.array([-1.5, -0.0, 0.3, 2.0, 7.25]),
    "y": np.array([[0.0], [-2.0], [0.5]]),
    "u": np.array([[[1.0]], [[-0.75]]]),
}


@settings(max_examples=400, deadline=None)
@given(expressions())
def test_agrees_to_the_bit_with_an_evaluation_through_python(text):
    oracle = Oracle(POINTS)
    expected = oracle(text)
    if oracle.constant_fault:
        refused(text)
        return
    before = {name: array.copy() for name, array in POINTS.items()}
    formula = parse(text, NAMES)
    (result,) = Program([formula])(POINTS)
    assert result.dtype == np.float64
    assert same_bits(result, expected)
    assert result.shape == np.broadcast_shapes((), *[POINTS[name].shape for name in formula.names])
    assert all(np.array_equal(before[name], POINTS[name]) for name in NAMES)


@settings(max_examples=100, deadline=None)
@given(st.lists(expressions(), min_size=2, max_size=4))
def test_formulas_compiled_together_agree_with_each_alone(texts):
    parsed = [f for f in map(formula_or_refusal, texts) if isinstance(f, Formula)]
    together = Program(parsed + parsed)(POINTS)
    alone = [Program([formula])(POINTS)[0] for formula in parsed]
    assert all(map(same_bits, together, alone + alone))
    for index, array in enumerate(together):  # fresh memory, theirs to change
        others = [*together[:index], *POINTS.values()]
        assert not any(np.shares_memory(array, other) for other in others)
        assert array.flags.writeable


@settings(max_examples=100, deadline=None)
@given(expressions(), st.floats(-5, 5), st.floats(-5, 5))
def test_parameters_folded_equal_constants_of_python(text, x, y):
    formula = formula_or_refusal(text)
    if isinstance(formula, Formula):
        folded = Program([formula], {"x": x, "y": y})
        assert folded.names <= {"u"}
        oracle = Oracle({"u": POINTS["u"], "x": np.float64(x), "y": np.float64(y)})
        assert same_bits(folded({"u": POINTS["u"]})[0], oracle(text))


# Known answers.
@pytest.mark.parametrize(
    "text",
    [
        "-x**2", "(-x)**2", "2**-1", "2**3**2", "(2**3)**2", "-2**-2", "2**-x**2", "2 - 3 - 4",
        "2 - (3 - 4)", "8/4/2", "8/(4/2)", "2*3+4*5", "2+3*4-5", "2/3*4", "2*x**2*3", "--x", "-+-x",
        "x*-y", "x- -y", "x**2**0.5", "1-x/y*2", "-x*y", "-x/-y", "+x**3", "x**-y", "x**+2",
        "1.", ".5", "1e3", "1.5E-2", "1.e2", "00", "0", "00.5", "09.5", "010e1", "5e+0",
        "\tx +\ty ", "((x))", "1+(2+(3+x))", "9007199254740993", "1e-400", "x - y + x - y",
    ],
)  # fmt: skip
def test_precedence_and_numbers_are_those_of_python(text):
    x, y = 1.7, 2.25
    expected = eval(text.strip(), {"__builtins__": {}}, {"x": x, "y": y})
    assert value(text, x=x, y=y) == pytest.approx(expected, rel=4e-16, abs=0)


def test_meaning_of_every_function_against_the_math_module():
    x, y = 0.4, -0.7
    for name, arity in FORMULA_FUNCTIONS.items():
        if arity == 1:
            reference = {"abs": abs, "sign": lambda t: math.copysign(1, t)}.get(name)
            reference = reference or getattr(math, name)
            assert value(f"{name}(x)", x=x) == pytest.approx(reference(x), rel=1e-15)
    assert value("abs(y) + sign(y)*8 + floor(y)*64 + ceil(y)", y=y) == abs(y) - 8 - 64
    assert value("atan2(y, x)", x=x, y=y) == pytest.approx(math.atan2(y, x), rel=1e-15)
    assert value("mod(y, x)", x=x, y=y) == y + 2 * x
    assert value("mod(x, y)*8 + mod(-0.25, 1)", x=x, y=y) == 8 * (x + y) + 0.75
    assert value("min(x, y)*10 + max(x, y)", x=x, y=y) == y * 10 + x
    assert value("pi", x=x) == math.pi
    assert value("e") == math.e
    assert dict(FORMULA_CONSTANTS) == {"pi": math.pi, "e": math.e}
    assert sorted(FORMULA_FUNCTIONS) == sorted(UFUNCS)


@pytest.mark.parametrize(
    ("operator", "expected"),
    [("<", [1, 0, 0]), ("<=", [1, 1, 0]), (">", [0, 0, 1]), (">=", [0, 1, 1]), ("==", [0, 1, 0]),
     ("!=", [1, 0, 1])],
)  # fmt: skip
def test_where_picks_by_each_comparison(operator, expected):
    x = np.array([0.0, 1.0, 2.0])
    assert value(f"where(x {operator} 1, 1, 0)", x=x).tolist() == expected
    assert value(f"where(((x {operator} 1)), 1, 0)", x=x).tolist() == expected


def test_where_may_nest_and_keeps_nan_out_of_the_branch_not_taken():
    x = np.array([-1.0, 0.0, 4.0])
    text = "where(x < 0, -1, where(x == 0, 0, log(x)/log(x)))"
    assert value(text, x=x).tolist() == [-1, 0, 1]
    assert value("where(where(x<0, 1, 2) > 1, sqrt(x), -x)", x=x).tolist() == [1, 0, 2]
    assert value("where(1 < 2, x, y)", x=x, y=np.ones((2, 1))).shape == (2, 3)


def test_results_that_are_not_finite_pass_silently_when_they_depend_on_names():
    x = np.array([0.0, -1.0])
    assert np.array_equal(value("1/x", x=x), [np.inf, -1.0])
    assert np.isnan(value("sqrt(x)", x=x)[1])
    assert np.isinf(value("exp(1e3*abs(x))", x=x)[1])

"""Enclosures: whatever a formula does at a point of a box lies in the jet of the box."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lmdsl as lm
from lmdsl.formulas.enclosures import Jet
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program

UNARY = ["sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt",
         "abs", "sign", "floor", "ceil"]  # fmt: skip
LEAVES = ["x", "y", "0.5", "2", "-3", "pi"]


def formulas():
    def extend(inner):
        return st.one_of(
            st.tuples(st.sampled_from(UNARY), inner).map(lambda t: f"{t[0]}({t[1]})"),
            st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]}{t[1]}{t[2]})"),
            st.tuples(inner, st.sampled_from(["2", "3", "0.5", "-1", "1.5", "-2", "y"])).map(
                lambda t: f"({t[0]})**({t[1]})"
            ),
            st.tuples(st.sampled_from(["min", "max", "atan2"]), inner, inner).map(
                lambda t: f"{t[0]}({t[1]}, {t[2]})"
            ),
            st.tuples(inner, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), inner, inner).map(
                lambda t: f"where({t[0]} {t[1]} 0.3, {t[2]}, {t[3]})"
            ),
        )

    return st.recursive(st.sampled_from(LEAVES), extend, max_leaves=6)


def boxed(text, low, high):
    program = Program([parse(text, {"x", "y"})])
    values = {
        name: Jet.variable(Interval(np.array([low[k]]), np.array([high[k]])), k, 2)
        for k, name in enumerate("xy")
    }
    return program, program.enclose(values)[0]


coordinate = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 0.5, 3.0]), st.floats(-4, 4, allow_subnormal=False)
)
width = st.sampled_from([0.0, 1e-9, 0.01, 0.3, 2.0])


@pytest.mark.long
@settings(max_examples=1500, deadline=None, derandomize=True)
@given(formulas(), coordinate, coordinate, width, width, st.integers(0, 2**32 - 1))
def test_values_and_slopes_lie_in_the_enclosure(text, x, y, wx, wy, seed):
    low, high = np.array([x, y]), np.array([x + wx, y + wy])
    try:
        program, jet = boxed(text, low, high)
    except lm.BadInput:
        return  # a constant that is not finite
    rng = np.random.default_rng(seed)
    points = low + (high - low) * rng.random((40, 2))
    points = np.vstack([points, low, high])
    got = np.broadcast_to(program({"x": points[:, 0], "y": points[:, 1]})[0], len(points))
    lower, upper = (float(np.broadcast_to(end, 1)[0]) for end in jet.value)
    if not np.isfinite(got).all():
        assert lower == -np.inf
        assert upper == np.inf
        return
    assert (got >= lower).all()
    assert (got <= upper).all()
    # Mean value theorem between the points, exact but for the rounding of the formula itself.
    slope = [np.broadcast_to(end, (2, 1))[:, 0] for end in jet.slope]
    if not (np.isfinite(slope[0]).all() and np.isfinite(slope[1]).all()):
        return
    step = points[1:] - points[:-1]
    least = np.minimum(slope[0] * step, slope[1] * step).sum(axis=1)
    most = np.maximum(slope[0] * step, slope[1] * step).sum(axis=1)
    rise = got[1:] - got[:-1]
    size = max(1.0, np.abs(got).max(), np.abs(slope).max())
    if size < 1e6:
        assert (rise >= least - 1e-6 * size).all()
        assert (rise <= most + 1e-6 * size).all()


@pytest.mark.parametrize(
    ("text", "slope"),
    [
        ("sin(x)*y", lambda x, y: (np.cos(x) * y, np.sin(x))),
        ("x**3/y", lambda x, y: (3 * x**2 / y, -(x**3) / y**2)),
        ("atan2(y, x)", lambda x, y: (-y / (x**2 + y**2), x / (x**2 + y**2))),
        ("x**y", lambda x, y: (y * x ** (y - 1), np.log(x) * x**y)),
        ("sqrt(x) + log(y) + tanh(x*y)",
         lambda x, y: (0.5 / np.sqrt(x) + y / np.cosh(x * y) ** 2,
                       1 / y + x / np.cosh(x * y) ** 2)),
        ("asin(x/2) - acos(y/3)",
         lambda x, y: (1 / np.sqrt(4 - x**2), 1 / np.sqrt(9 - y**2))),
    ],
)  # fmt: skip
def test_at_a_point_the_derivative_is_exact(text, slope):
    at = np.array([0.7, 1.3])
    _, jet = boxed(text, at, at)
    want = np.array(slope(*at))
    low, high = jet.slope.low[:, 0], jet.slope.high[:, 0]
    assert (low <= want * (1 + 1e-15 * np.sign(want))).all()
    np.testing.assert_allclose(low, want, rtol=1e-13)
    np.testing.assert_allclose(high, want, rtol=1e-13)


@pytest.mark.parametrize(
    "text",
    ["max(0, min(1, log(x)))", "tanh(1/x)", "where(x > -9, 0*log(x), 1)", "sin(exp(1000*(x + 2)))"],
)
def test_nothing_is_claimed_where_a_value_may_be_undefined(text):
    _, jet = boxed(text, np.array([-1.0, 0.0]), np.array([1.0, 0.0]))
    assert jet.value.low[0] == -np.inf
    assert jet.value.high[0] == np.inf


def test_a_runge_kutta_step_is_enclosed():
    problem = lm.Problem.model_validate(lm.systems.NAMED["lorenz"].problem)
    rng = np.random.default_rng(0)
    centre = np.array([8.0, 8.0, 27.0, 1.0])
    for radius in (0.0, 1e-3, 0.05):
        names = ("x", "y", "z", "u")
        jets = {
            name: Jet.variable(Interval(np.array([c - radius]), np.array([c + radius])), k, 4)
            for k, (name, c) in enumerate(zip(names, centre, strict=True))
        }
        points = centre + radius * rng.uniform(-1, 1, (200, 4))
        images = problem.step()({n: points[:, k] for k, n in enumerate(names)})
        for image, jet in zip(images, problem.step().enclose(jets), strict=True):
            assert (image >= jet.value.low[0]).all()
            assert (image <= jet.value.high[0]).all()

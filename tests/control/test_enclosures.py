"""Enclosures hold for what is computed: big intermediate values, cancellation, every function."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import precise
import pytest
from hammering import UNARY, hammer

from lmdsl.formulas.enclosures import Jet, apply
from lmdsl.formulas.intervals import FUNCTION_ULPS, Interval
from lmdsl.formulas.language import parse
from lmdsl.formulas.operations import OPERATIONS
from lmdsl.formulas.program import Program


@pytest.mark.long
def test_computed_values_lie_in_the_enclosure():
    seen, narrow = hammer(0, 1500, 60, plain=False)
    assert seen > 30_000
    assert narrow > 200


@pytest.mark.long
def test_plain_formulas_also_over_the_rationals():
    seen, narrow = hammer(1, 1500, 60, plain=True)
    assert seen > 30_000
    assert narrow > 200


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2, 4))
def test_many_computed_values_lie_in_the_enclosure(seed):
    """Longer: ``hammer(seed, 10**6, 800)``."""
    assert hammer(seed, 1200, 800, plain=seed % 2 == 1)[0] > 400_000


def wide(rng, low, high, count):
    """Numbers of either sign whose magnitudes are spread over many decades."""
    return rng.choice([-1.0, 1.0], count) * np.exp(rng.uniform(np.log(low), np.log(high), count))


def arguments_of(name, rng, n):
    """Arguments where a function is hard: near its zeros, poles and ends, tiny and huge."""
    if name in ("sin", "cos", "tan"):
        quarter = np.round(rng.uniform(-1e5, 1e5, n)) * (np.pi / 2)
        parts = [rng.uniform(-10, 10, n), quarter, wide(rng, 1e-300, 1e308, n)]
        return np.concatenate([*parts, rng.uniform(9e7, 1.1e8, n)])
    if name in ("asin", "acos"):
        near = 1 - np.abs(wide(rng, 1e-16, 0.5, n))
        parts = [rng.uniform(-1, 1, n), near, -near, wide(rng, 1e-300, 1, n)]
        return np.concatenate([*parts, [0.0, 1.0, -1.0]])
    if name in ("log", "sqrt"):
        return np.abs(np.concatenate([wide(rng, 5e-324, 1e308, n), 1 + wide(rng, 1e-16, 0.5, n)]))
    if name in ("exp", "sinh", "cosh", "tanh"):
        ends = rng.uniform(-745, 745, n)
        return np.concatenate([ends, rng.uniform(-20, 20, n), wide(rng, 1e-300, 1, n)])
    return np.concatenate([rng.uniform(-5, 5, n), wide(rng, 1e-300, 1e300, n)])


@pytest.mark.parametrize("name", UNARY)
def test_functions_are_as_accurate_as_assumed(name):
    """To 332 bits: the value computed, in any place of an array, and N and e."""
    rng = np.random.default_rng(3)
    x = arguments_of(name, rng, 150)
    with np.errstate(all="ignore"):
        y = OPERATIONS[name](x)
        x, y = x[np.isfinite(y)], y[np.isfinite(y)]
        for other in (OPERATIONS[name](np.repeat(x, 3)[::3]), [OPERATIONS[name](v) for v in x]):
            assert (np.abs(other - y) <= FUNCTION_ULPS * 2 * np.spacing(np.abs(y))).all()
        point = apply(name, [Jet.variable(Interval(x, x.copy()), 0, 1)])
        high = x + np.abs(x) * 10.0 ** rng.uniform(-16, 0, len(x))
        box = apply(name, [Jet.variable(Interval(x, high), 0, 1)])
        inner = np.clip(x + (high - x) * rng.random(len(x)), x, high)
        computed = OPERATIONS[name](inner)
    sound = np.isfinite(box.value.low)
    assert sound.mean() > 0.3
    assert (np.isfinite(computed) | ~sound).all()
    for k in range(len(x)):
        true = precise.exact(name, x[k])
        assert precise.ulps(y[k], true) <= FUNCTION_ULPS
        if np.isfinite(point.value.low[k]):
            assert Fraction(point.value.low[k]) <= Fraction(true) <= Fraction(point.value.high[k])
            assert abs(Fraction(y[k]) - Fraction(true)) <= Fraction(float(point.error[k]))
        if sound[k]:
            low, high_ = Fraction(box.value.low[k]), Fraction(box.value.high[k])
            for value in (true, precise.exact(name, inner[k]), computed[k]):
                assert low <= Fraction(value) <= high_


@pytest.mark.parametrize(
    "exponent", [2.0, 3.0, 0.5, -1.0, -2.0, -0.5, 1.5, 7.0, -300.0, 300.0, None]
)
def test_powers_and_angles_are_as_accurate_as_assumed(exponent):
    rng = np.random.default_rng(4)
    x = np.abs(np.concatenate([wide(rng, 1e-60, 1e60, 100), rng.uniform(0.3, 3, 100)]))
    y = rng.uniform(-5, 5, 200) if exponent is None else exponent
    variable = Jet.variable(Interval(x, x.copy()), 0, 2)
    other = Jet.constant(exponent, 2) if exponent else Jet.variable(Interval(y, np.array(y)), 1, 2)
    with np.errstate(all="ignore"):
        found = OPERATIONS["**"](x, np.broadcast_to(y, x.shape))
        jet = apply("**", [variable, other])
        turned, angle = np.arctan2(y, x), apply("atan2", [other, variable])
    y = np.broadcast_to(y, x.shape)
    error = np.broadcast_to(jet.error, x.shape)
    for k in range(len(x)):
        if np.isfinite(found[k]) and np.isfinite(jet.value.low[k]):
            true = precise.exact("**", x[k], y[k])
            if found[k] > 1e-300:
                assert precise.ulps(found[k], true) <= FUNCTION_ULPS
            assert Fraction(jet.value.low[k]) <= Fraction(true) <= Fraction(jet.value.high[k])
            assert jet.value.low[k] <= found[k] <= jet.value.high[k]
            assert abs(Fraction(found[k]) - Fraction(true)) <= Fraction(float(error[k]))
        true = precise.exact("atan2", y[k], x[k])
        assert precise.ulps(turned[k], true) <= FUNCTION_ULPS
        assert Fraction(angle.value.low[k]) <= Fraction(true) <= Fraction(angle.value.high[k])


def test_the_errors_of_a_chain_add_up():
    """sin(x) of an x that carries an error: |f - F| <= e, to 332 bits."""
    text = "sin((x + 1e6) - 1e6)"
    rng = np.random.default_rng(5)
    x = rng.uniform(-3, 3, 200)
    program = Program([parse(text, {"x"})])
    (jet,) = program.enclose({"x": Jet.variable(Interval(x, x.copy()), 0, 1)})
    (computed,) = program({"x": x})
    missed = [
        abs(Fraction(c) - Fraction(precise.exact("sin", v)))
        for c, v in zip(computed, x, strict=True)
    ]
    assert all(by <= Fraction(float(e)) for by, e in zip(missed, jet.error, strict=True))
    assert float(max(missed)) > 1e-11  # and there is something to bound
    assert jet.error.max() < 1e-9


def test_a_decided_choice_has_the_error_of_what_is_chosen():
    x = Jet.variable(Interval(np.array([1.0, -2.0, -1.0]), np.array([2.0, -1.0, 1.0])), 0, 1)
    program = Program([parse("where(x > 0, x, (x + 1e9) - 1e9)", {"x"})])
    (jet,) = program.enclose({"x": x})
    assert jet.error[0] == 0
    assert 1e-7 < jet.error[1] < 1e-6
    assert jet.error[2] >= 2  # undecided: f may take the other branch than F
    np.testing.assert_array_equal(jet.slope.low[0] == -np.inf, [False, False, True])
    assert 1 - 1e-9 <= jet.slope.low[0, 1] <= jet.slope.high[0, 1] <= 1 + 1e-9

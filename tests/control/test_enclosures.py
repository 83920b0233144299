"""Enclosures hold for what is computed: big intermediate values, cancellation, every function."""

from __future__ import annotations

import ast
import math
from fractions import Fraction

import numpy as np
import precise
import pytest

from lmdsl.formulas.enclosures import Jet, apply, enclosure
from lmdsl.formulas.intervals import FUNCTION_ULPS, Interval, subtract
from lmdsl.formulas.language import parse
from lmdsl.formulas.operations import OPERATIONS
from lmdsl.formulas.program import Program

UNARY = ["sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt"]
STEPS = ["abs", "sign", "floor", "ceil"]
NUMBERS = ["0.5", "2", "(-3)", "1e-3", "0.3333333333333333", "32", "1e8", "4503599627370497",
           "1e16", "1e-17", "4.7e-14", "0.1", "1e150"]  # fmt: skip
BIG = ["32", "1073741824", "4503599627370496", "6755399441055744", "1e9", "(-1e5)"]


def formula(rng, depth, plain):
    """A random text; one that is ``plain`` has rational values."""
    if depth == 0 or rng.random() < 0.1:
        return str(rng.choice(["x", "y", rng.choice(NUMBERS)]))

    def inner():
        return formula(rng, depth - 1, plain)

    kind = rng.random()
    if kind < 0.2:  # what is left are the rounding errors of a large sum
        a, big = inner(), rng.choice(BIG)
        return f"(({a}) - ((({a}) + {big}) - {big})) * 1e{rng.integers(0, 16)}"
    if kind < 0.5:
        return f"({inner()} {rng.choice(list('+-*/'))} {inner()})"
    if kind < 0.6:

        def comparison():
            return f"{inner()} {rng.choice(['<', '<=', '>', '>=', '==', '!='])} {inner()}"

        joined = rng.choice(["{}", "not {}", "{} and {}", "not ({} or {})", "{} or {}"])
        condition = joined.format(comparison(), comparison())
        return f"where({condition}, {inner()}, {inner()})"
    if kind < 0.7:
        return f"{rng.choice(STEPS)}({inner()})"
    if kind < 0.8 or plain:
        return f"{rng.choice(['min', 'max', 'mod', 'mod'])}({inner()}, {inner()})"
    if kind < 0.92:
        return f"{rng.choice(UNARY)}({inner()})"
    if kind < 0.97:
        powers = ["2", "3", "0.5", "(-1)", "1.5", "(-2)", "7", "0", "1", "y"]
        return f"({inner()})**{rng.choice(powers)}"
    return f"atan2({inner()}, {inner()})"


def box_of(rng):
    """Centre and radius of a box, from some ulps wide to all of the axis, near and far."""
    centre = rng.uniform(-4, 4, 2) * rng.choice([1, 1, 1, 1e-6, 1e4, 1e9])
    if rng.random() < 0.3:
        centre = np.round(centre)
    radius = 10.0 ** rng.choice([-16, -14, -12, -9, -6, -3, -1, 0.3], 2) * rng.random(2)
    low = centre - radius
    return low, np.maximum(low, centre + radius)


def points_of(rng, low, high, count):
    """Points of a box: ends and their neighbours, the centre, others."""
    near = []
    for _ in range(count // 4):
        ends = np.where(rng.random(2) < 0.5, low, high)
        for _ in range(rng.integers(0, 4)):
            ends = np.nextafter(ends, rng.choice([-np.inf, np.inf], 2))
        near.append(ends)
    some = np.concatenate(
        [[low, high, low / 2 + high / 2], near, rng.uniform(low, high, (count, 2))]
    )
    return np.clip(some, low, high)


def jets_of(low, high):
    return {
        name: Jet.variable(Interval(low[k : k + 1], high[k : k + 1]), k, 2)
        for k, name in enumerate("xy")
    }


def enclosed(program, low, high):
    """Return the enclosure of a formula on a box, and the error bound."""
    centre = low / 2 + high / 2
    image, middle = (program.enclose(jets_of(*ends))[0] for ends in ((low, high), (centre, centre)))
    away = subtract(Interval(low, high), Interval.point(centre))
    found = enclosure(image, middle, [Interval(*(e[k] for e in away)) for k in range(2)])
    return [float(np.ravel(end)[0]) for end in (*found, image.error)]


def true(node, at):
    """Whether a plain condition holds over the rationals."""
    if isinstance(node, ast.BoolOp):
        found = [true(k, at) for k in node.values]
        return all(found) if isinstance(node.op, ast.And) else any(found)
    if isinstance(node, ast.UnaryOp):
        return not true(node.operand, at)
    a, b = (rational(k, at) for k in (node.left, node.comparators[0]))
    return {
        ast.Lt: a < b, ast.LtE: a <= b, ast.Gt: a > b, ast.GtE: a >= b, ast.Eq: a == b,
        ast.NotEq: a != b,
    }[type(node.ops[0])]  # fmt: skip


def rational(node, at):
    """The value of a plain formula over the rationals, its constants folded in doubles."""
    if not any(isinstance(part, ast.Name) and part.id in at for part in ast.walk(node)):
        return Fraction(float(Program([parse(ast.unparse(node), set())])({})[0]))
    if isinstance(node, ast.Name):
        return at[node.id]
    if isinstance(node, ast.UnaryOp):
        return -rational(node.operand, at)
    if isinstance(node, ast.BinOp):
        a, b = rational(node.left, at), rational(node.right, at)
        kind = type(node.op)
        if kind is ast.Div:
            return a / b
        return a + b if kind is ast.Add else a - b if kind is ast.Sub else a * b
    name, arguments = node.func.id, node.args
    if name == "where":
        return rational(arguments[1 if true(arguments[0], at) else 2], at)
    values = [rational(k, at) for k in arguments]
    return {
        "abs": lambda a: abs(a),
        "floor": lambda a: Fraction(math.floor(a)),
        "ceil": lambda a: Fraction(math.ceil(a)),
        "sign": lambda a: Fraction((a > 0) - (a < 0)),
        "min": min,
        "max": max,
        "mod": lambda a, b: a - b * math.floor(a / b),
    }[name](*values)


def hammer(seed, count, points, plain):
    """Compare what is computed with the enclosure; return how many values were within a box."""
    rng = np.random.default_rng(seed)
    seen = narrow = 0
    for _ in range(count):
        text = formula(rng, int(rng.integers(1, 6)), plain)
        try:
            program = Program([parse(text, {"x", "y"})])
        except Exception:  # a constant that is not finite, or one that is compared
            continue
        low, high = box_of(rng)
        with np.errstate(all="ignore"):
            least, most, error = enclosed(program, low, high)
        at = points_of(rng, low, high, points)
        found = np.broadcast_to(program({"x": at[:, 0], "y": at[:, 1]})[0], len(at))
        whole = least == -np.inf and most == np.inf
        assert whole or np.isfinite(found).all(), text
        if whole:
            continue
        assert ((found >= least) & (found <= most)).all(), (text, low, high)
        seen += len(at)
        narrow += most - least < 1e-3 * (1 + abs(least))
        if plain:
            tree = ast.parse(text, mode="eval").body
            for point, value in zip(at[:6], found[:6], strict=True):
                try:
                    F = rational(tree, {n: Fraction(x) for n, x in zip("xy", point, strict=True)})
                except ZeroDivisionError:  # in a condition: either branch is enclosed
                    continue
                assert least <= F <= most, (text, low, high)
                if math.isfinite(error):
                    assert abs(Fraction(float(value)) - F) <= Fraction(error), (text, low, high)
    return seen, narrow


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
def test_millions_of_computed_values_lie_in_the_enclosure(seed):
    assert hammer(seed, 3000, 800, plain=seed % 2 == 1)[0] > 10**6


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

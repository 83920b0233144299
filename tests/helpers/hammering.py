"""Random formulas on random boxes: values computed, and exact ones, against enclosures."""

from __future__ import annotations

import ast
import math
from fractions import Fraction

import numpy as np

from lmdsl.formulas.enclosures import Jet, enclosure
from lmdsl.formulas.intervals import Interval, subtract
from lmdsl.formulas.language import parse
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


def hammer(seed, count, points, plain, enclosed=enclosed):
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

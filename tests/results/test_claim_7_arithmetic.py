"""The arithmetic of the script that checks claim 7, against 100 digits, NumPy and lmdsl's cells."""

from __future__ import annotations

import ast
import math
import operator
from decimal import Decimal, InvalidOperation, localcontext

import numpy as np
import precise
import pytest
from formula_texts import value
from hypothesis import given, settings
from hypothesis import strategies as st
from standing_alone import axes, formulas, jets, judge

from lmdsl.model.grid.axis import AxisCells

UNARY = ["sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt",
         "abs", "sign", "floor", "ceil"]  # fmt: skip
LEAVES = ["x", "y", "0.5", "2", "-3", "pi", "x", "y"]


def texts():
    def extend(inner):
        return st.one_of(
            st.tuples(st.sampled_from(UNARY), inner).map(lambda t: f"{t[0]}({t[1]})"),
            st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda t: f"({t[0]}{t[1]}{t[2]})"),
            st.tuples(inner, st.sampled_from(["2", "3", "0.5", "-1", "1.5", "-2", "0", "y"])).map(
                lambda t: f"({t[0]})**({t[1]})"
            ),
            st.tuples(inner, st.sampled_from(["0.5", "-0.3"])).map(
                lambda t: f"mod({t[0]}, {t[1]})"
            ),
            st.tuples(st.sampled_from(["min", "max", "atan2"]), inner, inner).map(
                lambda t: f"{t[0]}({t[1]}, {t[2]})"
            ),
            st.tuples(inner, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), inner, inner).map(
                lambda t: f"where({t[0]} {t[1]} 0.3 or not x < 2, {t[2]}, {t[3]})"
            ),
        )

    return st.recursive(st.sampled_from(LEAVES), extend, max_leaves=6)


COMPARED = {ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt,
            ast.GtE: operator.ge, ast.Eq: operator.eq, ast.NotEq: operator.ne}  # fmt: skip
PLAIN = {ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
         ast.Div: operator.truediv, ast.Pow: None}  # fmt: skip


class Real:
    """A formula over the reals, to 100 digits; what is constant is folded to doubles."""

    def __init__(self, **names):
        self.names = names

    def __call__(self, node):
        kind = type(node)
        if kind is ast.Constant:
            return float(node.value)
        if kind is ast.Name:
            return math.pi if node.id == "pi" else Decimal(self.names[node.id])
        if kind is ast.UnaryOp:
            x = self(node.operand)
            return not x if isinstance(node.op, ast.Not) else -x
        if kind is ast.BoolOp:
            return any(map(self, node.values))
        if kind is ast.Compare:
            a, b = map(Decimal, map(self, (node.left, node.comparators[0])))
            return COMPARED[type(node.ops[0])](a, b)
        if kind is ast.BinOp:
            a, b = self(node.left), self(node.right)
            plain = PLAIN[type(node.op)]
            if plain:
                if not (isinstance(a, float) and isinstance(b, float)):
                    a, b = Decimal(a), Decimal(b)
                return plain(a, b)
            a, b = Decimal(a), Decimal(b)
            return a ** int(b) if b == int(b) else precise.power(a, b) if a else Decimal(0)
        name = node.func.id
        if name == "where":
            return self(node.args[1 if self(node.args[0]) else 2])
        x, *y = (Decimal(self(argument)) for argument in node.args)
        if name in ("min", "max"):
            return min(x, *y) if name == "min" else max(x, *y)
        if name == "mod":
            return x - y[0] * (x / y[0]).to_integral_value("ROUND_FLOOR")
        plain = {
            "abs": abs, "sign": lambda x: Decimal((x > 0) - (x < 0)),
            "floor": lambda x: x.to_integral_value("ROUND_FLOOR"),
            "ceil": lambda x: x.to_integral_value("ROUND_CEILING"),
        }  # fmt: skip
        return (plain | precise.FUNCTIONS)[name](x, *y)


coordinate = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 0.5, 3.0]), st.floats(-4, 4, allow_subnormal=False)
)
width = st.sampled_from([0.0, 1e-9, 0.01, 0.3, 2.0])


def judged(text, low, high):
    """Return the jet of a box, what it encloses, or None where nothing is said."""
    read = formulas.Formulas(["x", "y"], {}, {})
    place = read.read(text)
    ends = list(zip(low, high, strict=True))
    middle = [min(max(a / 2 + b / 2, a), b) for a, b in ends]
    away = [(jets.down(a - m), jets.up(b - m)) for (a, b), m in zip(ends, middle, strict=True)]
    try:
        box, centre = (
            read.values([place], dict(zip("xy", given, strict=True)))[0]
            for given in (
                [jets.Jet(a, b, {k: (1.0, 1.0)}, 0.0) for k, (a, b) in enumerate(ends)],
                [jets.constant(m) for m in middle],
            )
        )
    except (ValueError, ArithmeticError):
        return None
    return box, jets.enclosure(box, centre, away)


def compared(text, x, y, wx, wy, seed):
    low, high = [x, y], [x + wx, y + wy]
    try:
        found = judged(text, low, high)
    except ValueError:  # a constant that is not finite
        return 0
    if found is None:
        return 0
    box, (least, most) = found
    rng = np.random.default_rng(seed)
    points = np.concatenate([[low, high], rng.uniform(low, high, (5, 2))])
    tree = ast.parse(text, mode="eval").body
    for point in points:
        try:
            computed = float(value(text, x=point[:1], y=point[1:]).ravel()[0])
        except ValueError:  # refused: a constant subexpression is not finite
            return 0
        assert least <= computed <= most, (text, point.tolist(), computed, least, most)
        with localcontext() as context:
            context.prec = 110
            try:
                real = Decimal(Real(x=float(point[0]), y=float(point[1]))(tree))
            except (InvalidOperation, ArithmeticError, ValueError):
                continue
            off = Decimal(10) ** -60  # of 110 digits
            assert Decimal(box.low) - off <= real <= Decimal(box.high) + off
            if box.slopes is not None:
                assert abs(Decimal(computed) - real) <= Decimal(box.error) + off
    return 1


@settings(max_examples=250, deadline=None, derandomize=True)
@given(texts(), coordinate, coordinate, width, width, st.integers(0, 2**32 - 1))
def test_what_formulas_yield_is_enclosed(text, x, y, wx, wy, seed):
    compared(text, x, y, wx, wy, seed)


@pytest.mark.long
@settings(max_examples=1000, deadline=None, derandomize=True)
@given(texts(), coordinate, coordinate, width, width, st.integers(0, 2**32 - 1))
def test_what_many_formulas_yield_is_enclosed(text, x, y, wx, wy, seed):
    compared(text, x, y, wx, wy, seed)


@pytest.mark.long
@pytest.mark.full
@settings(max_examples=10_000, deadline=None, derandomize=True)
@given(texts(), coordinate, coordinate, width, width, st.integers(0, 2**32 - 1))
def test_what_more_formulas_yield_is_enclosed(text, x, y, wx, wy, seed):
    compared(text, x, y, wx, wy, seed)


@pytest.mark.parametrize("name", [*UNARY, "atan2", "mod", "**", "/"])
def test_slopes_hold_difference_quotients(name):
    """To 100 digits, at pairs of points of small and large boxes."""
    text = {"atan2": "atan2(x, y)", "mod": "mod(x, 0.75)", "**": "x**1.5", "/": "y/x"}.get(
        name, f"{name}(x)"
    )
    rng, told = np.random.default_rng(3), 0
    tree = ast.parse(text, mode="eval").body
    for _ in range(60):
        low = rng.uniform(-1, 3, 2)
        high = low + rng.choice([1e-6, 0.1, 0.7], 2)
        found = judged(text, low.tolist(), high.tolist())
        if found is None or found[0].slopes is None:
            continue
        told += 1
        a, b = rng.uniform(low, high, (2, 2)).tolist()
        with localcontext() as context:
            context.prec = 110
            rise = Decimal(Real(x=a[0], y=a[1])(tree)) - Decimal(Real(x=b[0], y=a[1])(tree))
            slope = rise / (Decimal(a[0]) - Decimal(b[0]))
            least, most = found[0].slopes.get(0, (0.0, 0.0))
            assert least <= slope <= most, (text, low, high)
    assert told > 10


def the_rounding_problem():
    """Where large numbers cancel, what is left is rounding: F holds a cell, and f does not."""
    text = (
        "where(abs(x - 5.5) < 0.6, 5.000001 + 140737206880349.36*(((5.1020070614639586e-14*(x - 5)"
        " + -4.095844186343325e-14) - (((5.1020070614639586e-14*(x - 5) + -4.095844186343325e-14)"
        " + 32.0) - 32.0)) - (-4.790265519712003e-15)), 5.5)"
    )
    return {
        "states": ["x"], "controls": [], "noise": [], "formulas": [text], "let": {},
        "parameters": {}, "ode": None, "ends_on_path": True, "clip": False, "admissible": None,
        "axes": [[(0.0).hex(), (10.0).hex(), 10, False]], "attractor": [], "avoid": [],
        "control_vectors": [[]], "noise_parts": [[]],
    }  # fmt: skip


def test_rounding_is_part_of_what_is_enclosed(monkeypatch):
    said = the_rounding_problem()
    states = np.linspace(5, 6, 10_001)
    images = value(said["formulas"][0], x=states)
    assert ((images < 4.99) | (images > 6.01)).any()
    assert judge.Judge(said, [5]).unproved(5, 0)
    monkeypatch.setattr(jets, "rounded", lambda *_: 0.0)
    assert judge.Judge(said, [5]).unproved(5, 0) is None  # so the bound of the error is needed


AXES = [(0.0, 1.0, 50, True), (-math.pi, math.pi, 7, True), (-1.0, 1.5, 9, False),
        (0.1, 0.7, 6, False), (1e6, 1e6 + 1, 1000, False), (-0.3, 0.3, 6, True)]  # fmt: skip


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("clip", [False, True])
def test_cells_are_those_of_lmdsl(axis, clip):
    low, high, cells, periodic = axis
    own = axes.Axis(low.hex(), high.hex(), cells, periodic, clip)
    theirs = AxisCells(low, high, (high - low) / cells, float(cells), 1.0, periodic)
    rng = np.random.default_rng(0)
    k = rng.integers(-2 * cells, 3 * cells, 3000)
    x = low + k * theirs.width + rng.choice([0, 1e-9, -1e-9, 1e-12, 0.3], 3000) * theirs.width
    x = np.concatenate([x, np.nextafter(x, np.inf), np.nextafter(x, -np.inf), [low, high, -1e-20]])
    wanted = theirs.number(x, clip)
    for point, number in zip(x.tolist(), wanted.tolist(), strict=True):
        assert own.number(point) == (None if math.isnan(number) else number)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("clip", [False, True])
def test_all_states_of_a_cell_are_in_its_pieces(axis, clip):
    low, high, cells, periodic = axis
    own = axes.Axis(low.hex(), high.hex(), cells, periodic, clip)
    theirs = AxisCells(low, high, (high - low) / cells, float(cells), 1.0, periodic)
    every = [(*piece, i) for i in range(cells) for piece in own.pieces(i)]
    for least, most, number, i in every:
        for end in (least, most):
            assert own.number(end) % cells == i
            assert own.number(end) == number
    rng = np.random.default_rng(0)
    x = low + rng.integers(0, cells + 1, 2000) * theirs.width
    x += rng.choice([0, 1e-9, -1e-9, 1.1e-9, 1e-12, 0.3], 2000) * theirs.width
    x = theirs.state(np.concatenate([x, [low, high, np.nextafter(high, 0)]]), clip)
    for state, number in zip(x.tolist(), theirs.number(x, clip).tolist(), strict=True):
        if not math.isnan(number):
            held = [i for least, most, _, i in every if least <= state <= most]
            assert held == [number % cells], state


def test_paths_lie_between_their_bernstein_points():
    rng = np.random.default_rng(0)
    for _ in range(50):
        m, n, r = rng.normal(size=3)
        s, e = sorted(rng.random(2))
        t = np.linspace(s, e, 50)
        arc = t * (1 - t) ** 2 * m - t**2 * (1 - t) * n + t**2 * (3 - 2 * t) * r
        points = [a * m + b * n + c * r for a, b, c in judge.bernstein(s, e)]
        assert min(points) - 1e-12 <= arc.min()
        assert arc.max() <= max(points) + 1e-12
        assert points[0] == pytest.approx(arc[0])
        assert points[3] == pytest.approx(arc[-1])

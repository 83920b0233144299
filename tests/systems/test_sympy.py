"""SymPy expressions: the same systems as formulas, to the bit of the compiled model."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pages import ROOT, blocks
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program
from lmdsl.systems import from_sympy
from lmdsl.systems.base import Names
from lmdsl.systems.translated import sympy_systems, systems
from lmdsl.systems.translated.terms import Untranslatable

sp = pytest.importorskip("sympy")

x, y, u, K, t = sp.symbols("x y u K t")
NAMES = ("x", "y", "u")

TEXTS = [
    (x + y * u - 3, "u*y + x - 3"),
    (-x / (y + 2), "-x/(y + 2)"),
    (-(x + y) * u, "u*(-x - y)"),
    ((x - y) ** -2, "1/(x - y)**2"),
    (sp.Rational(4, 3) * x, "4*x/3"),
    (sp.Rational(-1, 2) * x * y / u, "-x*y/(2)/u"),
    (-x * y, "-x*y"),
    ((-x) ** 3, "-x**3"),
    (x ** sp.Rational(1, 2), "sqrt(x)"),
    (x**-0.5, "1/x**0.5"),
    (2 ** (-x), "1/2**x"),
    (sp.pi * x + sp.E, "pi*x + e"),
    (sp.Max(x, y, u), "max(max(u, x), y)"),
    (sp.Abs(x) * sp.sign(y), "abs(x)*sign(y)"),
    (sp.ceiling(x) + sp.floor(3 * y), "ceil(x) + floor(3*y)"),
    (sp.Piecewise((x, x < y), (u, True)), "where(x < y, x, u)"),
]

VALUES = [
    sp.exp(-(x**2)) / y, 1 / sp.sqrt(x**2 + 1), sp.Min(x, 2, y), sp.Mod(x, y), sp.Mod(-x, y),
    sp.frac(3 * x), sp.sec(x) + sp.csc(y) + sp.cot(x), sp.asinh(x - 1), sp.acosh(2 + y),
    sp.atanh(x / 3), sp.atan2(y, x), x ** sp.Rational(1, 3), sp.log(x, 2), x**y, sp.sinc(x),
    sp.sinc(x - x), sp.GoldenRatio * x, sp.Float(1e-20) * x, 1e10 * x - 7.5, sp.tan(x) ** 2,
    sp.Heaviside(x - y), sp.Heaviside(0, sp.Rational(1, 3)) + x, x - (y - (u - x)), x / y / u,
    x / (y / u), sp.cosh(x) - sp.tanh(y) * sp.sinh(u), 10**20 * x, x**2 * y**-3 / 7,
    sp.Piecewise((x, x < y), (y, (x > 0.5) & (y > 1)), (u, True)),
    sp.Piecewise((1, (x < 0.5) | ~(y > 1)), (2, sp.Ne(u, 1)), (3, True)),
    sp.Piecewise((1, ~((x < 0.5) | (y >= u))), (2, True)), (x - y) ** 2 - (x + 1) ** 3,
    sp.Piecewise((1, sp.ITE(x < y, u < 1, y < 1)), (2, True)),
    sp.acos(x / 2) + sp.asin(y / 2) + sp.atan(u), sp.cos(x) * sp.exp(y) * sp.log(u + 1),
]  # fmt: skip


def both(expression):
    """The values of the formula, and of SymPy to 30 digits."""
    rng = np.random.default_rng(0)
    values = {name: rng.uniform(0.1, 1.9, 40) for name in NAMES}
    formula = Program([parse(sympy_systems.text(expression), NAMES)])
    got = np.broadcast_to(formula(values)[0], 40)
    points = [dict(zip(NAMES, row, strict=True)) for row in zip(*values.values(), strict=True)]
    return got, np.array(
        [
            float(
                expression.xreplace(
                    {sp.Symbol(k): sp.Float(v, 40) for k, v in point.items()}
                ).evalf(30)
            )
            for point in points
        ]
    )


# Expressions -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("expression", "text"), TEXTS, ids=str)
def test_texts_are_those_of_people(expression, text):
    assert sympy_systems.text(expression).replace("/(2)", "/2") == text.replace("/(2)", "/2")


@pytest.mark.parametrize("expression", [*VALUES, *(e for e, _ in TEXTS)], ids=str)
def test_values_are_those_of_sympy(expression):
    got, wanted = both(expression)
    np.testing.assert_allclose(got, wanted, rtol=1e-13, atol=1e-14)


def test_random_expressions_have_the_values_of_sympy():
    rng = np.random.default_rng(1)
    unary = (
        sp.sin, sp.exp, sp.Abs, lambda a: -a, lambda a: a**2, lambda a: a / 3,
        lambda a: sp.Abs(a) ** sp.Rational(3, 2),
        lambda a: sp.Piecewise((a, a > 0.5), (1 / (2 + a**2), True)),
    )  # fmt: skip
    binary = (
        lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / (2 + b**2),
        sp.Max, sp.atan2,
    )  # fmt: skip

    def grown(depth):
        if depth == 0:
            return [x, y, u, sp.Rational(1, 3), sp.Integer(-2), sp.Float(0.7)][rng.integers(6)]
        if rng.random() < 0.4:
            return unary[rng.integers(len(unary))](grown(depth - 1))
        return binary[rng.integers(len(binary))](grown(depth - 1), grown(depth - 1))

    for _ in range(40):
        expression = grown(3)
        got, wanted = both(expression)
        np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-11, err_msg=str(expression))


@pytest.mark.parametrize(("expression", "name"), [
    (sp.erf(x), "erf"), (sp.gamma(x), "gamma"), (sp.besselj(0, x), "besselj"), (sp.I * x, "I"),
    (x + sp.oo, "oo"), (sp.nan + x, "nan"), (sp.Integral(x, x), "Integral"),
    (sp.Function("q")(x, y), "q"),
    (sp.Piecewise((x, x < 1)), "Piecewise without"), (sp.Sum(x, (y, 0, 3)), "Sum"),
    (sp.Piecewise((x, sp.Contains(x, sp.Integers)), (y, True)), "condition Contains"),
    (10 ** sp.Integer(400) * x, "constant"), (sum(x**k for k in range(1, 900)), "characters"),
])  # fmt: skip
def test_what_the_language_lacks_is_named(expression, name):
    with pytest.raises(Untranslatable, match=name):
        systems.require_size({"x": sympy_systems.text(expression)}, NAMES)


def test_what_is_far_too_large_is_refused_at_once():
    deep, nested = x, x
    for _ in range(200):
        deep = sp.Mul(deep, sp.Add(1, deep, evaluate=False), evaluate=False)
    for _ in range(2000):
        nested = sp.sin(nested, evaluate=False)
    for expression in (deep, nested):
        with pytest.raises(lm.BadInput, match=r"more than 50,000 nodes, or 150 inside one another"):
            from_sympy({x: expression})
        with pytest.raises(lm.BadInput, match=r"stage_cost: .*more than"):
            made(steps()).replaced(stage_cost=expression)


# Systems -----------------------------------------------------------------------------------------


def test_the_model_is_that_of_the_formulas(tmp_path):
    kick = K * u * sp.sin(2 * sp.pi * x)
    plain = made(standard_map(12))
    own = plain.replaced(
        system=from_sympy({x: x + y + kick, y: y + kick}, {K: 0.25}),
        stage_cost=x**2 + y**2 + u**2,
    )
    assert own.system.kind == "map"
    assert lm.compile(own).digest == lm.compile(plain.replaced(stage_cost=own.stage_cost)).digest
    own.save(tmp_path / "own.json")
    assert lm.load(tmp_path / "own.json") == own


def test_a_differential_equation_from_lagrange():
    """The pendulum from its Lagrangian, with dynamicsymbols, against the equation by hand."""
    q, w = sp.Function("q")(t), sp.Function("w")(t)
    m, l, g, d = sp.symbols("m l g d")  # noqa: E741
    energy = m * l**2 * q.diff(t) ** 2 / 2 - m * g * l * sp.cos(q)
    equation = energy.diff(q.diff(t)).diff(t) - energy.diff(q) - (u - d * q.diff(t))
    (angular,) = sp.solve(equation, q.diff(t, 2))
    values = {m: 1, l: 1, g: 9.81, d: 0.1}
    plain = made(json.loads(json.dumps(lm.systems.InvertedPendulum.problem)))
    box = {"q": plain.state_box["theta"], "w": plain.state_box["omega"]}
    own = lm.Problem(
        system=from_sympy({q: w, w: angular.subs(q.diff(t), w)}, values, step=0.1, substeps=2),
        state_box={name: axis.replaced(cells=15) for name, axis in box.items()},
        attractor={"points": [[0, 0]]}, control_grid=plain.control_grid, sampling=plain.sampling,
        stage_cost=1 - sp.cos(q),
    )  # fmt: skip
    assert (own.system.kind, own.system.step, own.system.substeps) == ("ode", 0.1, 2)
    byhand = own.replaced(
        system=lm.systems.OdeSystem(
            derivative={"q": "w", "w": "g/l*sin(q) + (u - d*w)/(m*l**2)"}, step=0.1, substeps=2,
            parameters={str(name): value for name, value in values.items()},
        )
    )  # fmt: skip
    assert lm.compile(own).digest == lm.compile(byhand).digest


def test_what_has_no_formula_is_called(tmp_path):
    with pytest.warns(UserWarning, match="no place for erf") as warned:
        system = from_sympy({"x": x - u * (1 + sp.erf(100)) / 8 + 0 * y, y: 1}, {})
    (ours,) = [each for each in warned if each.category is UserWarning]
    assert ours.filename == __file__
    with pytest.warns(UserWarning, match="no place for erf"):
        system = from_sympy({"x": x - K * u * sp.erf(x + 50)}, {K: 0.25})
    own = made(steps()).replaced(system=system)
    assert lm.compile(own).digest == lm.compile(made(steps())).digest
    with pytest.raises(lm.BadInput, match="cannot be written"):
        own.to_json()
    lm.solve(own).save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds


def test_a_differential_equation_without_formulas():
    with pytest.warns(UserWarning, match="no place for erf"):
        system = from_sympy({x: -x * sp.erf(u + 50) + 0 * u}, step=0.5, substeps=2)
    values = {"x": np.array([[1.0], [2.0]]), "u": np.array([[0.0, 1.0]])}
    h = 0.25
    factor = (1 - h + h**2 / 2 - h**3 / 6 + h**4 / 24) ** 2
    images = system.compile(Names(("x",), ("u",)))(values)[0]
    np.testing.assert_allclose(
        np.broadcast_to(images, (2, 2)), factor * values["x"] + 0 * values["u"]
    )
    with pytest.raises(lm.BadInput, match="step"), pytest.warns(UserWarning, match="erf"):
        from_sympy({x: sp.erf(x)}, step=-1.0)


@pytest.mark.parametrize(("arguments", "keys", "words"), [
    ((None,), {}, "mapping from states"), (({},), {}, "mapping from states"),
    (({x: "x + 1"},), {}, "no SymPy expression"), (({x: x < 1},), {}, "no SymPy expression"),
    (({x: None},), {}, "no SymPy expression"), (({x + y: x},), {}, "neither a symbol nor a name"),
    (({3: x},), {}, "neither a symbol"), (({x: x}, {x + 1: 2.0}), {}, "neither a symbol"),
    (({x: x},), {"substeps": 2}, "no substeps"), (({x: x},), {"step": 0}, "step"),
    (({x: x}, {K: "a"}), {}, "parameters.K"), (({sp.Symbol("2x"): x},), {}, "is not a name"),
    (({sp.Symbol("lambda"): x},), {}, "keyword"),
])  # fmt: skip
def test_what_is_no_system(arguments, keys, words):
    with pytest.raises(lm.BadInput, match=words):
        from_sympy(*arguments, **keys)


def test_symbols_are_real():
    root = sp.sqrt(sp.re(x) ** 2 + sp.im(y) ** 2)
    assert sympy_systems.text(root) == "abs(x)"
    assert sympy_systems.text(sp.Symbol("x") + sp.Symbol("x", positive=True)) == "2*x"


def test_rates_are_states():
    q = sp.Function("q")(t)
    with pytest.raises(lm.BadInput, match=r"Derivative\(q\(t\), t\) is no state"):
        from_sympy({q: -q.diff(t)}, step=0.1)
    assert from_sympy({q: sp.Derivative(x**2, x)}).next == {"q": "2*x"}


def test_what_nobody_can_compute_is_refused():
    for expression in (sp.Function("f")(x, y), sp.Integral(sp.exp(x**x), (x, 0, y))):
        with pytest.raises(lm.BadInput, match="cannot compute this either"):
            from_sympy({x: expression})


def test_names_that_no_problem_declares_are_named():
    with pytest.raises(lm.BadInput, match="'v' is not a declared name"):
        made(steps()).replaced(system=from_sympy({x: x - sp.Symbol("v")}))
    with pytest.raises(lm.BadInput, match=r"stage_cost: .*no place for erf"):
        made(steps()).replaced(stage_cost=sp.erf(x))
    with pytest.raises(lm.BadInput, match=r"stage_cost: .*'v' is not a declared name"):
        made(steps()).replaced(stage_cost=sp.Symbol("v"))


def test_the_page_is_true(capsys):
    """The code of the page runs, and prints what stands behind it."""
    page = (ROOT / "docs/systems.md").read_text()
    (block,) = [each for each in blocks(page) if "import sympy" in each.text]
    exec(block.text, {"lm": lm})
    assert capsys.readouterr().out.strip() == block.text.splitlines()[-1].partition("# ")[2]

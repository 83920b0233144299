"""CasADi Functions: the same systems as formulas, to the bit of the compiled model."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pages import ROOT, blocks
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program
from lmdsl.systems import from_casadi
from lmdsl.systems.base import Names
from lmdsl.systems.translated.casadi_systems import CasadiFunction

ca = pytest.importorskip("casadi")

x, y, u = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("u")
NAMES = ("x", "y", "u")

TEXTS = [
    (x + y * u - 3, "x + y*u - 3"),
    (-(x - (y - u)), "-(x - (y - u))"),
    (x / (y / u), "x/(y/u)"),
    (x**2 + 2 * x + 1 / x, "x**2 + 2*x + 1/x"),
    (ca.SX(3), "3"),
    (ca.if_else(x > 1, y, 0), "where(1 < x, y, 0)"),
    (ca.fmax(x, y) - ca.fmin(x, u), "max(x, y) - min(x, u)"),
]

VALUES = [
    ca.exp(-(x**2)) / y, ca.if_else(x > 1, y, u), ca.if_else(x, y, u), (x > y) + 2 * (x == x),
    ca.if_else(ca.logic_and(x > 0.5, ca.logic_not(y <= 1)), x, u),
    ca.if_else(x > 1, ca.if_else(y >= 1, 1, 2), 3), (x != y) * x, ca.fmod(-x, y),
    ca.fmod(3 * x, -y), ca.logic_or(x < 1, y < 1) * u,
    ca.atan2(y, x), x**3.5, x**y, ca.sqrt(x), ca.asinh(x - 1), ca.acosh(x + 1), ca.atanh(x / 3),
    ca.fabs(x - y) * ca.sign(x - 1), ca.floor(3 * x) + ca.ceil(y), ca.log1p(x) + ca.expm1(y),
    ca.tanh(x) - ca.cosh(y) * ca.sinh(u), 1e-20 * x - 1e20 * y, x - (-y) * u, x - (-2) * u,
    ca.sumsqr(ca.vertcat(x, y, u)), ca.norm_2(ca.vertcat(x, y)), ca.copysign(x, y - 1),
    ca.sin(x) + ca.cos(y) * ca.tan(u), ca.asin(x / 2) + ca.acos(y / 2) + ca.atan(u), ca.log(x),
    ca.mtimes(ca.vertcat(x, y).T, ca.vertcat(y, u)),
]  # fmt: skip


def scalar(expression):
    return ca.Function("f", [x, y, u], [expression], ["x", "y", "u"], ["o"])


def double(name, size):
    return ca.MX.sym(name, size)


def integrator():
    """A pendulum integrated by CVODES: nothing that can be written out."""
    state, torque = double("s", 2), ca.MX.sym("u")
    dynamics = ca.vertcat(state[1], -ca.sin(state[0]) + torque)
    inner = ca.integrator("flow", "cvodes", {"x": state, "p": torque, "ode": dynamics}, 0, 0.1)
    return ca.Function("F", [state, torque], [inner(x0=state, p=torque)["xf"]], ["s", "u"], ["n"])


# Expressions -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("expression", "text"), TEXTS, ids=str)
def test_texts_are_those_of_people(expression, text):
    system = from_casadi(scalar(expression), states=["x"])
    assert system.next == {"x": text}


@pytest.mark.parametrize("expression", [*VALUES, *(e for e, _ in TEXTS)], ids=str)
def test_values_are_those_of_casadi(expression):
    rng = np.random.default_rng(0)
    values = {name: rng.uniform(0.1, 1.9, 40) for name in NAMES}
    function = scalar(expression)
    formula = Program([parse(from_casadi(function, states=["x"]).next["x"], NAMES)])
    wanted = [float(function(*row)) for row in zip(*values.values(), strict=True)]
    got = np.broadcast_to(formula(values)[0], 40)
    np.testing.assert_allclose(got, wanted, rtol=1e-13, atol=1e-14)
    called = CasadiFunction(function, [(name,) for name in NAMES], [0], ("x",))
    np.testing.assert_array_equal(called(**values)["x"], wanted)


def test_matrices_are_taken_column_by_column():
    matrix = ca.MX.sym("X", 2, 2)
    square = ca.Function("g", [matrix, ca.MX.sym("e", 0)], [matrix @ matrix], ["X", "e"], ["o"])
    names = ("a", "b", "c", "d")
    system = from_casadi(square, {"X": names})
    rng = np.random.default_rng(0)
    values = {name: rng.uniform(size=(3, 1, 5)) for name in names}
    values["b"] = values["b"][:1]
    called = CasadiFunction(square, [names, ()], [0], names)(**values)
    written = system.compile(Names(names))(values)
    table = np.array([np.broadcast_to(values[name], (3, 1, 5)) for name in names])
    for k in np.ndindex(3, 1, 5):
        wanted = np.linalg.matrix_power(table[(slice(None), *k)].reshape(2, 2).T, 2).T.ravel()
        np.testing.assert_allclose([called[name][k] for name in names], wanted)
        np.testing.assert_allclose([image[k] for image in written], wanted)


def test_structural_zeros_are_zeros():
    f = ca.Function("f", [x, y], [ca.diag(ca.vertcat(x, y))[:, 0]], ["x", "y"], ["o"])
    assert from_casadi(f, states=["x", "y"]).next == {"x": "x", "y": "0"}


# Systems -----------------------------------------------------------------------------------------


def kicked():
    p, kick, strength = double("p", 2), ca.MX.sym("u"), ca.MX.sym("K")
    moved = strength * kick * ca.sin(2 * ca.pi * p[0])
    return ca.Function(
        "kicked", [p, kick, strength], [ca.vertcat(p[0] + p[1] + moved, p[1] + moved)],
        ["p", "u", "K"], ["next"],
    )  # fmt: skip


@pytest.mark.parametrize(
    "arguments", [{"p": ["x", "y"]}, [["x", "y"], "u", "K"], [("x", "y"), ["u"], "K"]]
)
def test_the_model_is_that_of_the_formulas(tmp_path, arguments):
    plain = made(standard_map(12))
    own = plain.replaced(system=from_casadi(kicked(), arguments, parameters={"K": 0.25}))
    assert own.system.kind == "map"
    assert lm.compile(own).digest == lm.compile(plain).digest
    own.save(tmp_path / "own.json")
    assert lm.load(tmp_path / "own.json") == own


def test_a_differential_equation_and_the_output_of_several():
    angle, rate, torque = ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("u")
    f = ca.Function(
        "f", [torque, angle, rate], [torque**2, rate, 9.81 * ca.sin(angle) + torque - 0.1 * rate],
        ["u", "theta", "omega"], ["cost", "dtheta", "domega"],
    )  # fmt: skip
    plain = made(json.loads(json.dumps(lm.systems.InvertedPendulum.problem)))
    plain = plain.replaced(
        state_box={name: axis.replaced(cells=15) for name, axis in plain.state_box.items()}
    )
    own = plain.replaced(
        system=from_casadi(
            f, states=["theta", "omega"], outputs=["dtheta", "domega"], step=0.1, substeps=2
        )
    )
    assert own.system.kind == "ode"
    byhand = own.replaced(
        system=lm.systems.OdeSystem(
            derivative={"theta": "omega", "omega": "9.81*sin(theta) + u - 0.1*omega"},
            step=0.1, substeps=2,
        )
    )  # fmt: skip
    assert lm.compile(own).digest == lm.compile(byhand).digest


def test_what_has_no_formula_is_called(tmp_path):
    f = ca.Function("f", [x, u], [x - 0.25 * u * ca.erf(x + 50)], ["x", "u"], ["n"])
    with pytest.warns(UserWarning, match="no place for erf") as warned:
        own = made(steps()).replaced(system=from_casadi(f))
    assert warned[0].filename == __file__
    assert lm.compile(own).digest == lm.compile(made(steps())).digest
    lm.solve(own).save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds
    with pytest.warns(UserWarning, match="no place for erf"):
        system = from_casadi(f, step=0.5, substeps=2)
    values = {"x": np.array([[1.0], [2.0]]), "u": np.array([[0.0, 4.0]])}
    images = system.compile(Names(("x",), ("u",)))(values)[0]
    h = 0.25
    growth, gain = (1 + h + h**2 / 2 + h**3 / 6 + h**4 / 24) ** 2, values["u"] / 4
    np.testing.assert_allclose(images, growth * (values["x"] - gain) + gain)


def test_integrators_and_tables_are_called():
    from scipy.integrate import solve_ivp

    with pytest.warns(UserWarning, match="the CvodesInterface flow"):
        system = from_casadi(integrator(), {"s": ["q", "w"]})
    step = system.compile(Names(("q", "w"), ("u",)))
    got = step({"q": np.array([0.3, 1.0]), "w": np.array([0.0, -1.0]), "u": np.array([0.5, 0.0])})
    for k, (q, w, v) in enumerate([(0.3, 0.0, 0.5), (1.0, -1.0, 0.0)]):
        flow = solve_ivp(lambda _, s, v=v: [s[1], v - np.sin(s[0])], (0, 0.1), [q, w], rtol=1e-10)
        np.testing.assert_allclose([image[k] for image in got], flow.y[:, -1], rtol=1e-5)
    table = ca.interpolant("table", "bspline", [np.linspace(0, 1, 5)], np.arange(5.0) ** 2)
    z = ca.MX.sym("z")
    with pytest.warns(UserWarning, match="BSplineInterpolant table"):
        from_casadi(ca.Function("f", [z], [table(z)], ["z"], ["n"]))


def test_the_whole_chain_with_an_integrator():
    with pytest.warns(UserWarning, match="flow"):
        system = from_casadi(integrator(), {"s": ["q", "w"]})
    problem = lm.Problem(
        system=system,
        state_box={
            "q": {"low": -1, "high": 1, "cells": 10}, "w": {"low": -1, "high": 1, "cells": 10}
        },
        attractor={"boxes": [{"q": [-0.4, 0.4], "w": [-0.4, 0.4]}]},
        control_grid={"u": {"low": -1, "high": 1, "points": 3}}, stage_cost="1",
        sampling={"kind": "grid", "per_axis": 2},
    )  # fmt: skip
    assert lm.solve(problem).verified


def test_a_stage_cost():
    own = made(steps()).replaced(
        stage_cost=ca.Function("L", [x, u], [1 + x**2 + u / 3], ["x", "u"], ["l"])
    )
    assert own.stage_cost == "1 + x**2 + u/3"
    plain = made(steps(cost="1 + x**2 + u/3"))
    assert lm.compile(own).digest == lm.compile(plain).digest
    for wrong, words in (
        (ca.Function("L", [x], [ca.vertcat(x, x)], ["x"], ["l"]), "one number as its output"),
        (ca.Function("L", [double("s", 2)], [1], ["s"], ["l"]), "one number|2 elements"),
        (ca.Function("L", [x], [ca.erf(x)], ["x"], ["l"]), "no place for erf"),
        (x**2, "no casadi.Function"),
    ):
        with pytest.raises(lm.BadInput, match=rf"stage_cost.*({words})"):
            made(steps()).replaced(stage_cost=wrong)


# What is refused ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "keys", "words"), [
    ((kicked(),), {}, r'input p has 2 elements, and 0 names; .*"p": \["p0", "p1"\]'),
    ((kicked(), {"p": ["x"]}), {}, "2 elements, and 1 names"),
    ((kicked(), {"q": ["x", "y"]}), {}, "'q' is no input; the inputs are p, u, K"),
    ((kicked(), ["x", "y"]), {}, "the inputs p, u, K; give names"),
    ((kicked(), "xy"), {}, "give names for each"),
    ((kicked(), {"p": [1, 2]}), {}, "2 elements"),
    ((kicked(), {"p": ["x", "y"]}), {"states": ["x"]}, "2 elements, and there are 1 states"),
    ((kicked(), {"p": ["x", "y"]}), {"outputs": ["xdot"]}, "'xdot' is no output"),
    ((kicked(), {"p": ["x", "y"]}), {"substeps": 2}, "no substeps"),
    ((kicked(), {"p": ["x", "pi"]}), {}, "has a meaning in formulas"),
    ((lambda x: x,), {}, "is no casadi.Function"),
    ((x + u,), {}, "is no casadi.Function"),
])  # fmt: skip
def test_names_that_do_not_fit(arguments, keys, words):
    with pytest.raises(lm.BadInput, match=words):
        from_casadi(*arguments, **keys)


def test_free_variables_are_named():
    f = ca.Function("f", [x], [x + y], {"allow_free": True})
    with pytest.raises(lm.BadInput, match="free variables: y"):
        from_casadi(f)


def test_text_that_grows_with_every_level_is_called_instead():
    deep = x
    for _ in range(60):
        deep = deep * (1 - deep)
    with pytest.warns(UserWarning, match="characters"):
        from_casadi(ca.Function("f", [x], [deep], ["x"], ["n"]))


def test_the_page_is_true(capsys):
    """The code of the page runs, and prints what stands behind it."""
    page = (ROOT / "docs/systems.md").read_text()
    (block,) = [each for each in blocks(page) if "import casadi" in each.text]
    exec(block.text, {"lm": lm})
    assert capsys.readouterr().out.strip() == block.text.splitlines()[-1].partition("# ")[2]

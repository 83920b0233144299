"""The accurate integrator against closed forms and SciPy's, run by run."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import lmdsl as lm
from lmdsl.formulas.program import Program
from lmdsl.systems.accurate import TOLERANCE, AccurateFlow, has_kinks, places
from lmdsl.systems.base import Names

EQUATIONS = {
    "van_der_pol": ({"x": "v", "v": "3*(1 - x**2)*v - x + u"}, 0.7),
    "duffing": ({"x": "v", "v": "x - x**3 - 0.1*v + u"}, 2.0),
    "pendulum": ({"x": "v", "v": "9.81*sin(x) + u*cos(x)"}, 0.5),
    "fast": ({"x": "-300*(x - cos(v))", "v": "u + 0*x"}, 0.5),
    "kinks": ({"x": "v", "v": "u - abs(x) - min(v, 0.1)"}, 0.5),
}


def made_flow(derivative, step, width=0.1, controls=("u",), substeps=1):
    system = lm.systems.OdeSystem(derivative=derivative, step=step, substeps=substeps)
    flow = system.flow(Names(tuple(derivative), controls))
    return AccurateFlow(flow, np.full(len(derivative), width))


def drawn(count=40, seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.uniform(-2, 2, count) for name in ("x", "v", "u")}


def by_scipy(flow, values, k, until):
    names = flow.flow.states

    def slope(t, y):
        named = {name: np.array([x]) for name, x in zip(names, y, strict=True)}
        held = {name: values[name][k : k + 1] for name in values}
        return [np.broadcast_to(f, 1)[0] for f in flow.flow.field({**held, **named})]

    start = [values[name][k] for name in names]
    return solve_ivp(slope, (0, until), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


@pytest.mark.parametrize("name", EQUATIONS)
def test_every_run_is_that_of_scipy(name):
    derivative, step = EQUATIONS[name]
    flow, values = made_flow(derivative, step, substeps=64 if name == "kinks" else 1), drawn()
    assert flow.smooth == (name != "kinks")
    end = flow(values)
    for k in range(0, 40, 8):
        near = 1e-5 if name == "kinks" else 1e-7
        assert end[:, k] == pytest.approx(by_scipy(flow, values, k, step), abs=near)


@pytest.mark.parametrize("name", EQUATIONS)
def test_paths_between_the_ends_are_those_of_scipy(name):
    derivative, step = EQUATIONS[name]
    flow, values = made_flow(derivative, step, substeps=64 if name == "kinks" else 1), drawn(3)
    seen = []

    def watch(arc):
        t, found = np.full(len(arc.rows), 0.37), np.empty(arc.start.shape)
        places(arc.start, arc.bends(np.ones(len(t), dtype=np.bool_)), t, found)
        seen.extend(zip(arc.rows, arc.time + t * arc.length, found.T, strict=True))
        return np.zeros(len(t), dtype=np.bool_)

    flow(values, None, watch)
    assert len(seen) >= 3
    for k, time, state in seen[:: max(1, len(seen) // 20)]:
        assert state == pytest.approx(by_scipy(flow, values, k, time), abs=1e-5)


def test_linear_systems_are_their_exponential():
    rng = np.random.default_rng(1)
    for _ in range(5):
        A = np.array(rng.normal(size=(2, 2)).tolist(), dtype=object)
        flow = made_flow(
            {"x": f"{A[0, 0]!r}*x + {A[0, 1]!r}*v", "v": f"{A[1, 0]!r}*x + {A[1, 1]!r}*v"}, 3.0
        )
        values = drawn()
        exact = expm(3.0 * A.astype(float)) @ np.stack([values["x"], values["v"]])
        scale = 0.1 + np.abs(exact)
        assert (np.abs(flow(values) - exact) <= 1e3 * TOLERANCE * scale).all()


def test_a_pendulum_keeps_its_energy():
    flow, values = made_flow({"x": "v", "v": "-sin(x)"}, 20.0), drawn()
    x, v = flow(values)
    before = values["v"] ** 2 / 2 - np.cos(values["x"])
    assert v**2 / 2 - np.cos(x) == pytest.approx(before, abs=1e-6)


def test_a_run_does_not_depend_on_the_others():
    for derivative, step in EQUATIONS.values():
        flow, values = made_flow(derivative, step, substeps=4), drawn(20_000)
        together = flow(values)
        for k in (0, 7, 8191, 8192, 19_999):
            alone = flow({name: x[k : k + 1] for name, x in values.items()})
            np.testing.assert_allclose(alone[:, 0], together[:, k], rtol=1e-12, atol=1e-12)


def test_errors_are_controlled_in_cells():
    """A narrower cell asks for more; the integral of a rate is controlled by itself."""
    values = drawn()
    derivative, step = EQUATIONS["duffing"]
    coarse, fine = (made_flow(derivative, step, width)(values) for width in (1e6, 1e-6))
    exact = np.stack([by_scipy(made_flow(derivative, step), values, k, step) for k in range(40)]).T
    assert np.abs(fine - exact).max() < 1e-8 < np.abs(coarse - exact).max()


def test_what_grows_without_limit_has_no_end():
    """x' = x^2 reaches infinity at 1/x; NaN stays NaN; no warning, and no endless loop."""
    flow = made_flow({"x": "x**2"}, 2.0, controls=())
    with np.errstate(all="raise"):
        end = flow({"x": np.array([0.25, 1.0, 50.0, np.nan])})[0]
    assert end[0] == pytest.approx(0.5, rel=1e-8)
    assert np.isnan(end[1:]).all()


@pytest.mark.parametrize(
    ("text", "kinked"),
    [("abs(u)*x", False), ("abs(x)", True), ("max(u, 0)", False), ("max(u, x)", True),
     ("where(u > 0, x, -x)", False), ("where(x > 0, u, -u)", True), ("floor(2*u) + x", False),
     ("sign(sin(x))", True), ("x*x", False)],
)  # fmt: skip
def test_kinks_count_where_the_states_stand_in_them(text, kinked):
    field = lm.systems.OdeSystem(derivative={"x": text}, step=1.0).flow(Names(("x",), ("u",))).field
    assert isinstance(field, Program)
    assert has_kinks(field, ("x",)) == kinked

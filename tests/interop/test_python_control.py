"""python-control both ways: its simulations beside ours, its gains in our problems and back."""

import importlib

import numpy as np
import pytest
from problems import made, standard_map

import lmdsl as lm
from lmdsl.interop import (
    closed_loop_system,
    control_system,
    controller_system,
    state_space,
    with_gain,
)
from lmdsl.model.grid.partition import Partition

pytest.importorskip("control.nlsys")  # tests/control is no package of theirs
ct = importlib.import_module("control")

PENDULUM = lm.Problem.model_validate({
    **lm.systems.NAMED["inverted_pendulum"].problem,
    "system": {"kind": "inverted_pendulum", "substeps": 4},
    "state_box": {"theta": {"low": -np.pi, "high": np.pi, "cells": 32, "periodic": True},
                  "omega": {"low": -9, "high": 9, "cells": 32}},
})  # fmt: skip


def test_the_system_is_the_equation():
    """Simulated by python-control, and by SciPy from the formulas alone."""
    from scipy.integrate import solve_ivp

    data = {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "parameters": {"mu": 1.0}, "step": 0.1,
                   "derivative": {"x": "y", "y": "mu*(1 - x**2)*y - x + u"}},
        "state_box": {"x": {"low": -3, "high": 3, "cells": 20},
                      "y": {"low": -3, "high": 3, "cells": 20}},
        "attractor": {"boxes": [{"x": [-0.6, 0.6], "y": [-0.6, 0.6]}]},
        "control_grid": {"u": {"low": -2, "high": 2, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
    }  # fmt: skip
    system = control_system(made(data))
    assert system.isctime()
    assert system.state_labels == ["x", "y"]
    assert system.input_labels == ["u"]
    times = np.linspace(0, 3, 31)
    for mu in (1.0, 0.3):
        found = ct.input_output_response(
            system, times, 0.5 * np.ones((1, 31)), [1.0, 0.0], params={"mu": mu},
            solve_ivp_kwargs={"rtol": 1e-9, "atol": 1e-9},
        )  # fmt: skip
        wanted = solve_ivp(
            lambda t, z, mu=mu: [z[1], mu * (1 - z[0] ** 2) * z[1] - z[0] + 0.5],
            (0, 3), [1.0, 0.0], t_eval=times, rtol=1e-10, atol=1e-10,
        )  # fmt: skip
        np.testing.assert_allclose(found.states, wanted.y, atol=1e-6)


def test_the_closed_loop_is_the_closed_loop():
    result = lm.solve(made(standard_map(20)))
    loop = closed_loop_system(result)
    assert loop.isdtime()
    for start in ([0.1, 0.2], [0.9, 0.4], [0.5, 0.5]):
        path = result.closed_loop.path(start, 400)
        found = ct.input_output_response(loop, np.arange(len(path)), X0=start)
        np.testing.assert_array_equal(found.states.T, path)
        u = result.controller(path)
        np.testing.assert_array_equal(found.outputs[2:].T, u)


def test_system_and_controller_joined_are_the_closed_loop():
    result = lm.solve(made(standard_map(20)))
    system, law = control_system(result.problem), controller_system(result, [0.0])
    joined = ct.interconnect(
        [system, law], inplist=[], outlist=["x", "y"], connections=[
            [f"{system.name}.u", f"{law.name}.u"],
            [f"{law.name}.x", f"{system.name}.x"], [f"{law.name}.y", f"{system.name}.y"],
        ],
    )  # fmt: skip
    path = result.closed_loop.path([0.1, 0.2], 400)
    found = ct.input_output_response(joined, np.arange(len(path)), X0=[0.1, 0.2])
    np.testing.assert_allclose(found.outputs.T % 1.0, path, atol=1e-9)


def test_a_sampled_equation_makes_compiled_steps():
    result = lm.solve(PENDULUM)
    loop = closed_loop_system(result)
    assert loop.dt == PENDULUM.system.step
    start = result.partition.centres(np.flatnonzero(result.cell_status == 1)[[7]])[0]
    path = result.closed_loop.path(start, 100, as_compiled=True)
    found = ct.input_output_response(loop, np.arange(len(path)) * loop.dt, X0=start)
    np.testing.assert_array_equal(found.states.T[:-1], path[:-1])  # the last ends on its way


def test_where_the_controller_says_nothing():
    result = lm.solve(made(standard_map(20)))
    attractor = np.array([0.25, 0.5])
    assert np.isnan(controller_system(result).outfcn(0, None, attractor, {})).all()
    assert controller_system(result, [0.5]).outfcn(0, None, attractor, {}).tolist() == [0.5]
    with pytest.raises(lm.BadInput, match=r"otherwise: a control has shape \(1,\)"):
        controller_system(result, [0.5, 0.0])


def test_noise_is_an_input():
    noisy = standard_map(
        8, system={"kind": "map", "next": {"x": "x + y + u", "y": "y + w"}},
        noise={"w": {"normal": {"std": 0.05, "points": 3}}},
    )  # fmt: skip
    system = control_system(made(noisy))
    assert system.input_labels == ["u", "w"]
    found = system.updfcn(0, np.array([0.1, 0.2]), np.array([0.3, 0.05]), {})
    np.testing.assert_allclose(found, [0.6, 0.25], rtol=1e-15)


# Linear-quadratic regulators ------------------------------------------------------------------


def test_a_linearisation_is_that_of_python_control():
    """Exact derivatives beside the differences of python-control, at rest."""
    rest = [0.0] * len(PENDULUM.states)
    ours = state_space(PENDULUM, rest)
    theirs = ct.linearize(control_system(PENDULUM, sampled=True), rest, [0.0])
    assert ours.dt == theirs.dt
    np.testing.assert_allclose(ours.A, theirs.A, atol=1e-5)
    np.testing.assert_allclose(ours.B, theirs.B, atol=1e-5)
    equation = ct.linearize(control_system(PENDULUM), rest, [0.0])
    exact = ct.sample_system(ct.ss(equation), ours.dt)  # zero-order hold
    np.testing.assert_allclose(ours.A, exact.A, atol=1e-4)


def test_their_gain_in_our_problem():
    """dlqr's gain as a local controller acts as it is, and is the gain of ours at its weights."""
    rest = [0.0] * len(PENDULUM.states)
    linear, width = state_space(PENDULUM, rest), Partition.of(PENDULUM).width
    reach = max(abs(u) for u in (PENDULUM.control_grid[PENDULUM.controls[0]].vector()))
    gain, _, poles = ct.dlqr(linear, np.diag(1 / width**2), np.diag([1 / reach**2]))
    assert (np.abs(poles) < 1).all()
    problem = with_gain(PENDULUM, gain, rest)
    theirs = lm.solve(problem).controller.local
    ours = PENDULUM.replaced(
        local_controller={"kind": "lqr", "orbit": [dict.fromkeys(PENDULUM.states, 0.0)]}
    )
    ours = lm.solve(ours).controller.local
    np.testing.assert_allclose(ours.gain[0], gain, rtol=1e-7)
    np.testing.assert_array_equal(theirs.gain[0], gain)
    assert theirs.multiplier == pytest.approx(max(abs(poles)), rel=1e-9)


def test_what_does_not_fit_is_refused():
    with pytest.raises(lm.BadInput, match=r"gain: a gain has shape \(1, 2\), not \(1, 3\)"):
        with_gain(PENDULUM, [[1.0, 2.0, 3.0]], [0.0, 0.0])
    with pytest.raises(lm.BadInput, match="cell widths from the next point"):
        state_space(PENDULUM, [0.5, 0.0])
    finite = lm.from_matrices([[[0.5, 0.5], [0, 1]]], [[1.0], [0.0]], targets=[1])
    for call in (control_system, lambda p: state_space(p, [0.0]), lambda p: closed_loop_system(
            lm.solve(p)), lambda p: controller_system(lm.solve(p))):  # fmt: skip
        with pytest.raises(lm.BadInput, match="system: a finite model"):
            call(finite)

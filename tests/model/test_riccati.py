"""The regulator: gains do not depend on the scale of weights or units, and refusals are true."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest
from local_controllers import ORBIT, linear_system, local_of
from problems import made, standard_map

import lmdsl as lm
from lmdsl.model.local import riccati


def gain(A, B, Q, R):
    d, p = np.shape(B)
    data = linear_system(A, B)
    data["local_controller"] = {
        "kind": "lqr",
        "orbit": [[0] * d],
        "state_weights": {f"x{i}": Q[i] for i in range(d)},
        "control_weights": {f"u{j}": R[j] for j in range(p)},
    }
    return local_of(made(data)).gain[0]


def scalar_gain(a, q, r):
    """The gain of x+ = a x + u in 400 digits."""
    with localcontext() as context:
        context.prec = 400
        a, q, r = Decimal(a), Decimal(q), Decimal(r)
        half = (r - a * a * r - q) / 2
        x = (half * half + q * r).sqrt() - half
        return float(x * a / (r + x))


@pytest.mark.parametrize("a", [1.5, -2.0, 0.5, 100.0, 0.0])
@pytest.mark.parametrize("q", [1, 1e-100, 1e100, 1e-300, 1e300])
@pytest.mark.parametrize("r", [1, 1e-16, 1e16, 1e-100, 1e100, 1e-160, 1e-300, 1e300])
def test_weights_of_any_scale(a, q, r):
    true = scalar_gain(a, q, r)
    assert gain([[a]], [[1.0]], [q], [r])[0, 0] == pytest.approx(true, rel=1e-12, abs=1e-300)


def test_the_gain_of_unit_weights():
    assert gain([[1.5]], [[1.0]], [1], [1])[0, 0] == pytest.approx(1.087, abs=5e-4)


def recursion(A, B, Q, R, steps):
    X = Q
    for _ in range(steps):
        K = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A)
        X = Q + A.T @ X @ (A - B @ K)
    return K


@pytest.mark.parametrize("seed", range(20))
def test_several_states_and_weights(seed):
    rng = np.random.default_rng(seed)
    d, p = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    A, B = rng.normal(size=(d, d)).round(3), rng.normal(size=(d, p)).round(3)
    Q, R = 10.0 ** rng.uniform(-3, 3, d), 10.0 ** rng.uniform(-3, 3, p)
    true = recursion(A, B, np.diag(Q), np.diag(R), 3000)
    for scale in (1.0, 1e-150, 1e150):
        found = gain(A.tolist(), B.tolist(), (Q * scale).tolist(), (R * scale).tolist())
        np.testing.assert_allclose(found, true, rtol=1e-7, atol=1e-9 * np.abs(true).max())


@pytest.mark.parametrize("function", [False, True])
@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (1e-9, 1e6, 1e-7), (1e80, 1e-80, 1e40)])
def test_units_of_states_and_controls(units, function):
    """A pendulum's linearisation, its angle, rate and torque in units of their own."""
    a, b, c = units
    data = linear_system([[1.0, 0.1], [0.2, 1.0]], [[0.0], [0.1]], 9)
    data["state_box"] = {
        "x0": {"low": -a, "high": a, "cells": 9},
        "x1": {"low": -b, "high": b, "cells": 9},
    }
    data["control_grid"] = {"u0": {"low": -c, "high": c, "points": 3}}
    data["system"]["next"] = {
        "x0": f"x0 + {0.1 * a / b!r}*x1",
        "x1": f"{0.2 * b / a!r}*sin(x0/{a!r})*{a!r} + x1 + {0.1 * b / c!r}*u0",
    }
    data["local_controller"] = {"kind": "lqr", "orbit": [[0, 0]]}
    problem = made(data)
    if function:

        def step(x0, x1, u0):
            kick = 0.2 * b / a * np.sin(x0 / a) * a
            return x0 + 0.1 * a / b * x1, kick + x1 + 0.1 * b / c * u0

        problem = problem.replaced(system=lm.systems.FunctionSystem(next=step))
    local = local_of(problem)
    A, B = np.array([[1.0, 0.1], [0.2, 1.0]]), np.array([[0.0], [0.1]])
    true = recursion(A, B, np.eye(2) * 4.5**2, np.eye(1), 2000)
    np.testing.assert_allclose(
        local.gain[0] * [a / c, b / c], true, rtol=1e-4 if function else 1e-9
    )
    assert local.multiplier < 1


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e30, 1e200])
def test_a_periodic_orbit_with_weights_of_any_scale(scale):
    plain = local_of(made(standard_map(50, local_controller={"kind": "lqr", "orbit": ORBIT})))
    weights = {
        "state_weights": {"x": 2500 * scale, "y": 2500 * scale},
        "control_weights": {"u": 4 * scale},
    }
    local = {"kind": "lqr", "orbit": ORBIT, **weights}
    scaled = local_of(made(standard_map(50, local_controller=local)))
    np.testing.assert_allclose(scaled.gain, plain.gain, rtol=1e-12)
    # Hardly any weight on the control, hardly any on the states.
    for ratio in (1e-20, 1e20):
        local["control_weights"] = {"u": 4 * scale * ratio}
        found = local_of(made(standard_map(50, local_controller=local)))
        assert found.multiplier < 1


def test_what_no_gain_stabilizes_is_told_from_what_doubles_cannot_solve():
    for units in (1.0, 1e-12, 1e12):
        with pytest.raises(lm.BadInput, match=r"do not reach a mode of multiplier 2;"):
            gain([[2.0, 0.0], [units, 0.5]], [[0.0], [1.0]], [1, 1], [1])
    with pytest.raises(lm.BadInput, match="could not be solved in doubles"):
        gain([[1.0]], [[1.0]], [1], [1e40])  # feedback of 1e-20: 1 - 1e-20 is 1
    assert gain([[0.5]], [[0.0]], [1], [1])[0, 0] == 0  # out of reach, but it decays


@pytest.mark.parametrize("power", [0, -8, -16, -18, -20, -30, -60])
def test_weights_that_leave_a_mode_next_to_undecayed(power):
    """x+ = x + y, y+ = y + u with a weight q of x: the gain of x falls with sqrt(q)."""
    golden = (1 + 5**0.5) / 2 - 1
    system = [[1.0, 1.0], [0.0, 1.0]], [[0.0], [1.0]], [10.0**power, 1], [1]
    if power <= -20:  # 1 minus the multiplier is below the digits of a double
        with pytest.raises(lm.BadInput, match="could not be solved in doubles"):
            gain(*system)
        return
    (found,) = gain(*system)
    assert abs(np.linalg.eigvals([[1, 1], -found + [0, 1]])).max() < 1
    if power <= -16:  # the first terms of the series
        np.testing.assert_allclose(found, [golden * 10.0 ** (power / 2), golden], rtol=1e-7)


def test_an_orbit_out_of_reach():
    A = np.array([[[2.0]], [[3.0]]])
    one = np.zeros(1)
    with pytest.raises(riccati.Unstabilizable) as caught:
        riccati.regulator(A, np.zeros((2, 1, 1)), one, one)
    assert caught.value.multiplier == pytest.approx(6)
    K = riccati.regulator(A, np.array([[[0.0]], [[1.0]]]), one, one)  # at one point suffices
    assert K[0, 0, 0] == 0
    assert abs(2 * (3 - K[1, 0, 0])) < 1

"""The judged integrals of a cost rate against the independent reference, and against SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from problems import made
from reference.paths import hermite, integral, journey, knots
from scipy.integrate import solve_ivp

from lmdsl.control import accuracy
from lmdsl.control.accuracy import integration_error
from lmdsl.model.assembly.paths.judging import PathJudge
from lmdsl.model.assembly.paths.quadrature import Quadrature, relative
from lmdsl.model.assembly.substeps import JudgedPairs

STEP, A, Z = 0.7, 0.8, (1.0, 1.6)


def oscillator(substeps=2, **more):
    """Van der Pol on 20 x 20 cells of width 0.2, to |x|, |v| <= 0.8, and not through a box."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "derivative": {"x": "v", "v": "(1 - x**2)*v - x + u + w"},
                   "step": STEP, "substeps": substeps},
        "state_box": {name: {"low": -2, "high": 2, "cells": 20} for name in ("x", "v")},
        "attractor": {"boxes": [{"x": [-A, A], "v": [-A, A]}]},
        "avoid": {"boxes": [{"x": list(Z), "v": list(Z)}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}},
        "noise": {"w": {"values": [-0.1, 0.1], "weights": [0.5, 0.5]}},
        "cost_rate": "x**2 + v**2 + 0.1*u**2",
        "sampling": {"kind": "random", "points": 8, "seed": 3},
        **more,
    }  # fmt: skip


def slope(y, u, w):
    x, v, _ = y
    return [v, (1 - x**2) * v - x + u + w, x**2 + v**2 + 0.1 * u**2]


def event(place, final=True):
    """What a place is: escaped, absorbed, or nothing, and a free cell at the end."""
    x, v = place[:2]
    if not (abs(x) < 2 and abs(v) < 2) or (Z[0] < x < Z[1] and Z[0] < v < Z[1]):
        return "escaped"
    if abs(x) < A and abs(v) < A:
        return "absorbed"
    return "free" if final else None


def by_reference(start, u, w, substeps):
    """Kind of the end, its time in Runge-Kutta steps, the cost, and that by twice as many."""
    found = knots(lambda y: slope(y, u, w), [*start, 0.0], STEP, substeps)
    kind, s, t, place = journey(*found[:2], [0.2, 0.2], event)
    cost = integral(found[0], found[2], place, s, t)
    states, slopes, stages = knots(lambda y: slope(y, u, w), [*start, 0.0], STEP, 2 * substeps)
    at = 2 * (s + t)
    s2 = math.ceil(at) - 1
    ends = zip(states[s2], states[s2 + 1], slopes[s2], slopes[s2 + 1], strict=True)
    place2 = [hermite(*four, at - s2) for four in ends]
    return kind, s + t, cost, integral(states, stages, place2, s2, at - s2)


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_every_sample_is_that_of_the_reference(substeps):
    problem = made(oscillator(substeps))
    pairs = JudgedPairs.of(problem, None, None)
    some = {name: x[:300] for name, x in pairs.drawn.items()}
    found = Quadrature(problem, pairs.partition, pairs.sets, some, lambda: None, substeps)
    expected = [
        by_reference((x, v), u, w, substeps) for x, v, u, w in zip(*some.values(), strict=True)
    ]
    kinds = [each[0] for each in expected]
    assert min(kinds.count(kind) for kind in ("escaped", "absorbed", "free")) > 5
    assert found.rows.tolist() == [k for k, kind in enumerate(kinds) if kind != "escaped"]
    _, time, cost, twice = zip(*(each for each in expected if each[0] != "escaped"), strict=True)
    assert found.time == pytest.approx(time, rel=1e-12)
    assert found.integral == pytest.approx(cost, rel=1e-9)
    error = sum(abs(a - b) for a, b in zip(cost, twice, strict=True)) / sum(twice)
    assert found.halving == pytest.approx(error, rel=1e-6)


def by_scipy(start, u, w):
    """Kind of the end of the true path, and its cost until then."""
    times = np.linspace(0, STEP, 7001)
    y = solve_ivp(
        lambda _, y: slope(y, u, w), (0, STEP), [*start, 0], method="DOP853", rtol=1e-11,
        atol=1e-11, t_eval=times,
    ).y  # fmt: skip
    for place in y.T[1:]:
        kind = event(place, False)
        if kind:
            return kind, place[2]
    return "free", y[2, -1]


def test_the_accurate_costs_are_those_of_scipy(monkeypatch):
    monkeypatch.setattr(accuracy, "FEW", 80)
    problem = made(oscillator(2))
    found, pairs = integration_error(problem), JudgedPairs.of(problem, None, None)
    rates = pairs.quadrature(2)
    rows = rates.rows[:80]
    apart = whole = 0.0
    for k, cost in zip(rows, rates.integral, strict=False):
        x, v, u, w = (column[k] for column in pairs.drawn.values())
        kind, true = by_scipy((x, v), u, w)
        if kind != "escaped":
            apart, whole = apart + abs(cost - true), whole + true
    assert found.cost_accurate == pytest.approx(apart / whole, rel=0.02)


def test_samples_in_parts_are_the_same(monkeypatch):
    problem = made(oscillator(3))
    pairs = JudgedPairs.of(problem, None, None)
    whole = pairs.quadrature(3)
    monkeypatch.setattr("lmdsl.model.assembly.paths.judging.KEPT", 5_000)
    parts = pairs.quadrature(3)
    assert np.array_equal(parts.rows, whole.rows)
    assert np.array_equal(parts.time, whole.time)
    assert np.array_equal(parts.integral, whole.integral)
    assert parts.halving == whole.halving
    assert isinstance(parts._judge(3), PathJudge)


def test_relative_differences():
    one = np.ones(4)
    assert relative(one, one) == relative(0 * one, 0 * one) == 0
    assert relative(np.array([1.0, 2, 3]), np.array([1.0, 4, 5])) == pytest.approx(0.4)
    assert relative(one, 0 * one) == relative(np.full(4, np.inf), one) == np.inf
    assert relative(np.array([1e308] * 4), one) == relative(np.array([np.nan]), one[:1]) == np.inf


def test_nothing_is_said_where_every_path_escapes():
    problem = made(oscillator(1, system={
        "kind": "ode", "derivative": {"x": "v", "v": "90 + 0*u*w"}, "step": STEP,
            "judged": "endpoint",
    }))  # fmt: skip
    found = integration_error(problem)
    assert found.cost_halving is found.cost_accurate is None
    assert found.sentence() == "no sample stays in the box"


def test_systems_without_controls_and_under_clip():
    alone = oscillator(2, control_grid={}, on_exit="clip")
    alone["system"]["derivative"]["v"] = "(1 - x**2)*v - x + w"
    alone["cost_rate"] = "1 + x**2"
    found = integration_error(made(alone))
    assert 0 < found.cost_halving < 2e-3
    assert found.cost_halving / 2 < found.cost_accurate < 0.05

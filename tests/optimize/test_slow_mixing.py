"""Long, almost-lossless problems: every step ends the run with a small probability only."""

import numpy as np
import pytest
import scipy.sparse as sp
from problems import made, standard_map
from slow_models import above, exact, mixing, transport

import lmdsl as lm
from lmdsl.common import types
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.linear import equations, gauss_seidel
from lmdsl.optimize.linear.substitution import Peeled
from lmdsl.optimize.policies import iteration


def killed(kill, cost="1", gamma=1.0, cells=40):
    """Two ways to go round on a torus; noise throws into the attractor, in the corner."""
    return {
        "system": {
            "kind": "map",
            "next": {
                "x": "where(k == 1, 0, x + 0.11 + 0.07 * u * sin(2*pi*y))",
                "y": "where(k == 1, 0, 0.5 + 0.4 * sin(2*pi*x + 3*y + u))",
            },
        },
        "state_box": {
            "x": {"low": 0, "high": 1, "cells": cells, "periodic": True},
            "y": {"low": 0, "high": 1, "cells": cells, "periodic": True},
        },
        "attractor": {"boxes": [{"y": [0, 1 / cells]}]},
        "control_grid": {"u": {"values": [1, -1]}},
        "noise": {"k": {"values": [0, 1], "weights": [1 - kill, kill]}},
        "stage_cost": cost,
        "sampling": {"kind": "grid", "per_axis": 2},
        "gamma": gamma,
    }


@pytest.mark.parametrize("kill", [0.5, 0.01, 0.0001])
@pytest.mark.parametrize("gamma", [0.99, 1.0])
def test_where_all_runs_last_as_long_the_first_bound_is_the_value(kill, gamma):
    """No step is made for differences that are rounding."""
    lp = lm.compile(made(killed(kill, gamma=gamma)))
    first = first_policy.stabilizing(lp)
    start = iteration.bound(lp, first.policy, first.w)
    done = iteration.iterate(lp, first.policy, start)
    np.testing.assert_allclose(start, 1 / (1 - gamma * (1 - kill)), rtol=1e-8)
    assert done.steps <= 1
    result = lm.solve(lp)
    assert result.status == "verified", result.message


def test_a_constant_is_no_bound_where_costs_or_losses_differ():
    lp = lm.compile(made(killed(0.01, cost="1 + x")))
    assert iteration._even(lp, lp.tree[1], 1.0, lp.cost[lp.tree[1]]) is None
    lp = lm.compile(made(standard_map(10)))
    assert iteration._even(lp, lp.tree[1], 1.0, np.ones(lp.n)) is None


@pytest.mark.parametrize("escape", [1e-1, 1e-3, 1e-6])
@pytest.mark.parametrize("make", [mixing, lambda n, escape, rng: transport(n, rng) * (1 - escape)])
def test_descending_stays_above_the_equation(escape, make):
    rng = np.random.default_rng(1)
    M = sp.csr_array(make(400, escape, rng))
    b = rng.uniform(0.5, 2.0, 400)
    x = above(M, b, rng)
    before = x.copy()
    assert equations.descend(Peeled.of(gauss_seidel.SplitMatrix.of(M)), b, x, 1e-6)
    assert (x <= before).all()
    assert (x >= (b + M @ x) * (1 - 1e-12)).all()
    np.testing.assert_allclose(x, exact(M, b), rtol=1e-3)


def test_descending_refuses_what_has_no_solution():
    rng = np.random.default_rng(2)
    M, b = mixing(300, -0.01, rng), np.ones(300)
    x = np.full(300, 1e9)
    assert (
        not equations.descend(Peeled.of(gauss_seidel.SplitMatrix.of(M)), b, x, 1e-6)
        or (x == 1e9).all()
    )


@pytest.mark.parametrize("patience", [0, 10**9])
def test_the_optimum_is_the_same_however_policies_are_evaluated(patience, monkeypatch):
    lp = lm.compile(made(killed(0.001, cost="1 + 10*(x - 0.3)**2 + y")))
    monkeypatch.setattr(iteration, "PATIENCE", patience)
    result = lm.solve(lp)
    assert result.status == "verified", result.message
    assert result.gap < 1e-10
    monkeypatch.undo()
    assert result.cost == pytest.approx(lm.solve(lp).cost, rel=1e-10)


def test_a_policy_that_only_loses_by_chance_is_proved_stabilizing():
    lp = lm.compile(made(killed(1e-5)))
    found = first_policy._proved(lp, lp.tree[1], np.ones(lp.n), types.never)
    assert found is not None

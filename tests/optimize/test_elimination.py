"""Columns left out before a linear program is solved are in no optimal policy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from models import random_lp
from problems import made, standard_map

import lmdsl as lm
from lmdsl import backends
from lmdsl.backends import Backend, Solution, Stop
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.policies import iteration, presolve


def first(lp):
    found = first_policy.stabilizing(lp)
    assert isinstance(found, first_policy.Feasible)
    return found


def optimum(lp):
    found = first(lp)
    return iteration.iterate(lp, found.policy, iteration.bound(lp, found.policy, found.w)).value


def left_out_are_worse(lp):
    """Return how many columns are left out; each must cost more than the optimum."""
    found = first(lp)
    kept = presolve.survivors(lp, found.policy, found.w)
    assert (np.diff(kept) > 0).all()
    out = np.setdiff1d(np.arange(lp.K), kept)
    V = optimum(lp)
    Q = lp.gamma * (lp.P @ V) + lp.cost
    assert (Q[out] > V[lp.cell[out]]).all()
    smaller = lp.part(kept, np.arange(lp.n))
    np.testing.assert_allclose(optimum(smaller), V, rtol=1e-12)
    return len(out)


def test_standard_map():
    lp = lm.compile(made(standard_map(20)))
    assert left_out_are_worse(lp) > lp.K / 2


@pytest.mark.parametrize("seed", range(20))
def test_random_models(seed):
    gamma = (1.0, 1.01, 0.9)[seed % 3]
    zeros = 0.3 if seed % 2 else 0.0
    lp = random_lp(np.random.default_rng(seed), 30, 4, gamma=gamma, zero=zeros)
    if isinstance(first_policy.stabilizing(lp), first_policy.Feasible):
        left_out_are_worse(lp)


def test_time_is_up():
    lp = lm.compile(made(standard_map(10)))
    found = first(lp)
    kept = presolve.survivors(lp, found.policy, found.w, lambda: True)
    assert np.isin(found.policy, kept).all()


@pytest.mark.parametrize("name", ["highs:simplex", "clarabel", "cvxpy"])
def test_solvers_get_the_survivors_and_answer_for_all(monkeypatch, name):
    lp = lm.compile(made(standard_map(12)))
    expected = lm.solve(lp)
    backend, algorithm = backends.resolve(name)
    asked = []

    def watched(model, options):
        asked.append(model)
        solution = backend.solve(model, options)
        assert len(solution.occupation) == model.K
        return solution

    spy = replace(backend, solve=watched)
    monkeypatch.setattr(backends, "resolve", lambda _: (spy, algorithm))
    result = lm.solve(lp, name)
    assert asked[0].K < lp.K / 2
    assert result.verified
    assert result.pairs == lp.K  # certified over all
    np.testing.assert_array_equal(result.control_index, expected.control_index)


def test_other_backends_get_every_column():
    lp = lm.compile(made(standard_map(12)))
    asked = []

    def solve(model, options):
        asked.append((model, options.start is not None))
        return Solution(Stop.FAILED, "looked")

    lm.solve(lp, Backend("looker", solve))
    assert asked == [(lp, True)]

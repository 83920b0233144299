"""A search that begins at an earlier controller; a compiled model with another gamma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import random_lp
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.optimize.feasibility import lifting
from lmdsl.results.solving import _earlier


def solved(cells, **more):
    return lm.solve(made(standard_map(cells, **more)))


COARSE = solved(20)


def same(found, cold):
    assert found.status == cold.status == "verified"
    assert found.cost == pytest.approx(cold.cost, rel=1e-9)
    np.testing.assert_allclose(found.value, cold.value, rtol=1e-9)
    np.testing.assert_array_equal(found.control_index, cold.control_index)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"gamma": 1.2},
        {"gamma": 0.99},
        {"control_grid": {"u": {"low": -0.4, "high": 0.5, "points": 8}}},
        {"sampling": {"kind": "grid", "per_axis": 2}},
    ],
    ids=str,
)
@pytest.mark.parametrize("cells", [12, 20, 31])
def test_the_answer_is_the_same_wherever_the_search_begins(cells, changes):
    problem = made(standard_map(cells)).replaced(**changes)
    same(lm.solve(problem, start=COARSE), lm.solve(problem))


def test_a_search_that_begins_at_its_own_answer_ends_at_once():
    again = lm.solve(COARSE.lp, start=COARSE)
    assert again.iterations == 0
    same(again, COARSE)


def test_a_search_from_a_gamma_nearby_takes_fewer_steps():
    lp = lm.compile(lm.Problem.model_validate(lm.systems.VanDerPol.problem).replaced(gamma=1.0))
    first, other = lm.solve(lp), lp.with_gamma(1.01)
    cold, warm = lm.solve(other), lm.solve(other, start=first)
    same(warm, cold)
    assert warm.iterations < cold.iterations


def test_the_lifted_control_is_that_of_the_centre_or_the_nearest():
    problem = made(standard_map(34, control_grid={"u": {"low": -0.45, "high": 0.45, "points": 7}}))
    lp = lm.compile(problem)
    policy = lifting._column(lp, _earlier(COARSE))
    asked = COARSE.controller(lp.partition.centres(lp.cells))[:, 0]
    grid = lp.controls[:, 0]
    for i in range(0, lp.n, 7):
        if np.isnan(asked[i]):
            assert policy[i] == -1
            continue
        nearest = int(np.abs(grid - asked[i]).argmin())
        column = lp.column(int(lp.cells[i]), nearest)
        assert policy[i] == (-1 if column is None else column)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31), gamma=st.sampled_from([0.7, 1.0, 1.02]))
def test_any_controller_may_be_the_start(seed, gamma):
    """Nonsense, and holes in it, included."""
    rng = np.random.default_rng(seed)
    lp = replace(random_lp(rng), gamma=gamma)
    cold = lm.solve(lp)
    if cold.status != "verified":
        return
    nonsense = rng.integers(-1, len(lp.controls), lp.partition.size).astype(np.int32)
    if (nonsense < 0).all():
        return
    warm = lm.solve(lp, start=replace(cold, control_index=nonsense))
    assert warm.status == "verified"
    assert warm.cost == pytest.approx(cold.cost, rel=1e-9)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**31))
def test_what_is_lifted_reaches_the_attractor_from_everywhere(seed):
    """Whatever is lifted: where it does not lead there, Algorithm 1 does."""
    rng = np.random.default_rng(seed)
    lp = replace(random_lp(rng), gamma=1.0)
    index = rng.integers(-1, len(lp.controls), lp.partition.size).astype(np.int32)
    earlier = lifting.Earlier(lp.partition, lp.problem.controls, lp.controls, index)
    found = lifting.lifted(lp, earlier)
    assert found is not None
    rows = lp.P[found.policy]
    assert (found.w > rows @ found.w).all()
    np.testing.assert_allclose(found.value, lp.cost[found.policy] + rows @ found.value, rtol=1e-9)


def test_a_gamma_that_is_infeasible_is_refused_from_any_start():
    problem = made(doubling())
    start = lm.solve(problem)
    found = lm.solve(problem.replaced(gamma=3.0), start=start)
    assert (found.status, found.cause) == ("not_stabilizable", "gamma")


def test_another_gamma_needs_no_compilation():
    lp = lm.compile(made(standard_map(20)))
    for gamma in (0.8, 1.0, 1.3):
        other, anew = lp.with_gamma(gamma), lm.compile(made(standard_map(20, gamma=gamma)))
        assert (other.gamma, other.problem) == (gamma, anew.problem)
        assert other.digest == anew.digest
        assert other.rows is lp.rows
        same(lm.solve(other), lm.solve(anew))
    assert lp.with_gamma(1.02).digest == lp.digest


def test_where_more_than_gamma_depends_on_it_compiling_is_asked_for():
    discounted = steps(discount=0.8)
    for data, gamma in (
        (steps(terminal_cost="1 + x"), 0.5),
        (discounted, 1.25),
        ({**discounted, "gamma": 1.5}, 1.0),
    ):
        with pytest.raises(lm.BadInput, match="compile the problem again") as caught:
            lm.compile(made(data)).with_gamma(gamma)
        assert caught.value.where == "gamma"
    assert lm.compile(made(discounted)).with_gamma(1.2).gamma == 1.2
    rewarded = lm.from_matrices(
        np.eye(2)[None], np.ones((2, 1)), (), discount=0.5, layout="states", maximise=True
    )
    with pytest.raises(lm.BadInput, match="reward"):
        lm.compile(rewarded).with_gamma(0.5)
    for bad in (0, -1, np.nan, "1", None):
        with pytest.raises(lm.BadInput, match="gamma"):
            lm.compile(made(steps())).with_gamma(bad)


def test_what_is_no_start_is_refused():
    none = lm.solve(made(doubling(3.0)))
    for start, word in (
        ("out", "not a Result"),
        (none, "no controller"),
        (lm.solve(made(steps())), "states"),
        (lm.solve(made(doubling())), "states"),
    ):
        with pytest.raises(lm.BadInput, match=word) as caught:
            lm.solve(made(standard_map(9)), start=start)
        assert caught.value.where == "start"
    with pytest.raises(lm.BadInput, match="controls"):
        lm.solve(made(steps()), start=lm.solve(made(doubling())))

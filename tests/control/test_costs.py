"""Mean costs of discounted runs: staying away for ever counts, what is cut off is said."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import run
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made, steps

import lmdsl as lm

STILL = {"kind": "map", "next": {"x": "x"}}
QUANTILES = ("min", "q50", "q90", "q99", "max")


def chain(seed, states=5, actions=2):
    """Rows and costs at random."""
    rng = np.random.default_rng(seed)
    P = rng.dirichlet(np.full(states, 0.4), (actions, states))
    return P, rng.integers(0, 9, (states, actions)).astype(float)


def closed_form(P, G, policy, rate, ends=()):
    """V = (I - rate P_u)^-1 G_u, 0 where a run ends."""
    on = [i for i in range(len(G)) if i not in ends]
    rows = np.array([P[policy[i], i] for i in on])[:, on]
    V = np.zeros(len(G))
    V[on] = np.linalg.solve(np.eye(len(on)) - rate * rows, [G[i, policy[i]] for i in on])
    return V


@pytest.mark.parametrize(("gamma", "b"), [(1.0, 0.9), (1.05, 0.9), (0.5, 0.5), (0.25, 0.999)])
@pytest.mark.parametrize("targets", [(), (2,)])
def test_chains_cost_what_elimination_says(gamma, b, targets):
    P, G = chain(7)
    result = lm.solve(lm.from_matrices(P, G, targets, gamma=gamma, discount=b, layout="states"))
    V = closed_form(P, G, result.control_index, gamma * b, targets)
    found = result.simulate(4000, 400)
    expected = result.weight @ V / result.weight.sum()
    assert found.cost["runs"] == 4000
    assert found.cost["cut_off"] < 1e-6 * expected
    assert abs(found.cost["mean"] - expected) < 4.5 * found.cost["standard_error"]
    assert result.cost == pytest.approx(expected, rel=1e-5)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**31), b=st.sampled_from([0.3, 0.9, 0.99]), count=st.integers(1, 30))
def test_the_bound_covers_what_is_cut_off(seed, b, count):
    P, G = chain(seed)
    result = lm.solve(lm.from_matrices(P, G, discount=b, layout="states"))
    V = closed_form(P, G, result.control_index, b)
    found = result.simulate(500, count).cost
    expected, spread = result.weight @ V / result.weight.sum(), 5.5 * found["standard_error"]
    assert found["mean"] - spread - 1e-9 <= expected
    assert expected <= (found["mean"] + found["cut_off"]) * (1 + 1e-9) + spread


@pytest.mark.parametrize("count", [1, 5, 60])
def test_a_state_that_stays_costs_a_geometric_sum(count):
    """x+ = x at cost 1: after n steps r^n/(1 - r) are missing, exactly."""
    data = steps(system=STILL, control_grid={}, attractor={}, discount=0.75, gamma=1.2)
    r = 0.9
    found = lm.solve(made(data)).simulate(50, count)
    assert (found.cycling, found.reached) == (50, 0)
    assert found.cost["runs"] == 50
    assert found.cost["mean"] == pytest.approx((1 - r**count) / (1 - r))
    assert found.cost["standard_error"] == pytest.approx(0, abs=1e-12)
    assert found.cost["cut_off"] == pytest.approx(r**count / (1 - r))


@pytest.mark.parametrize(("cost", "controls", "reached"), [
    ("where(u > 0, 1, 0.4*x)", [0, 0, 0], 0),
    ("where(u > 0, 0.6, 1 - x)", [1, 0, 0], 1 / 3),
    ("where(u > 0, 0.4, x)", [1, 1, 1], 1),
])  # fmt: skip
def test_staying_away_where_that_is_optimal(cost, controls, reached):
    """To stay costs twice a step; of the second case 1.25, 0.75, 0.25, and to go 0.6, 0.9, 1.05.

    Costs are linear: that of a cell is the mean over its states too.
    """
    result = lm.solve(made(steps(cost=cost, discount=0.5)))
    assert result.control_index.tolist() == [-1, *controls]
    runs = result.simulate(4000, 200)
    assert runs.reached / 4000 == pytest.approx(reached, abs=0.04)
    assert runs.cost["runs"] == 4000
    assert abs(runs.cost["mean"] - result.cost) <= 4.5 * runs.cost["standard_error"] + 1e-9


def test_ends_that_come_later_count_in_the_bound():
    """Three steps to A, free, where 5 is paid: before, all of it may be missing, by b^n."""
    data = steps(cost="0", control_grid={"u": {"values": [1]}}, discount=0.5, terminal_cost="5")
    data["measure"] = {"boxes": [{"x": [0.75, 1]}]}
    result = lm.solve(made(data))
    for count, mean, cut_off in ((1, 0, 2.5), (2, 0, 1.25), (3, 0.625, 0)):
        found = result.simulate(20, count).cost
        assert (found["mean"], found["cut_off"]) == pytest.approx((mean, cut_off))


def test_rewards_missed_later_count_in_the_bound():
    P, R = chain(3)
    problem = lm.from_matrices(P, R, discount=0.8, layout="states", maximise=True)
    result = lm.solve(problem)
    V = closed_form(P, R.max() - R, result.control_index, 0.8)
    found = result.simulate(4000, 8).cost
    expected, spread = result.weight @ V / result.weight.sum(), 4.5 * found["standard_error"]
    assert found["mean"] - spread <= expected <= found["mean"] + found["cut_off"] + spread
    assert found["mean"] + found["standard_error"] < expected  # cut off indeed


def test_the_lost_have_no_cost():
    """Samples stay, states near 0 leave: what these paid before would look cheap."""
    data = steps(system={"kind": "map", "next": {"x": "where(x < 0.05, -1, x)"}}, control_grid={})
    data |= {"attractor": {}, "discount": 0.9, "sampling": {"kind": "grid", "per_axis": 1}}
    found = lm.solve(made(data)).simulate(2000, 300)
    assert 0 < found.lost < 2000
    assert found.cost["runs"] == 2000 - found.lost == found.cycling
    assert found.cost["mean"] == pytest.approx(10)
    assert "cost of runs kept" in found.text()


def test_where_the_attractor_has_to_be_reached_the_others_have_no_cost():
    """Without a discount, and with one where gamma times it is 1 or more."""
    for more in ({}, {"gamma": 0.5}, {"gamma": 1.25, "discount": 0.8}):
        result = lm.solve(made(steps(**more)))
        found = result.simulate(900, 1)
        assert 0 < found.reached < 900
        assert found.cost == {
            "mean": 1.0, "standard_error": 0.0, "runs": found.reached, "cut_off": 0.0,
            **dict.fromkeys(QUANTILES, 1.0),
        }  # fmt: skip
        assert "cost of the reached" in found.text()


def test_an_equation_with_a_rate_and_no_target():
    """x' = -x at the rate x: a step costs x (1 - q), all of them x (1 - q)/(1 - b q)."""
    b, h = 0.9, 0.25
    q = np.exp(-h)
    data = steps(system={"kind": "ode", "derivative": {"x": "-x"}, "step": h}, control_grid={})
    data |= {"attractor": {}, "discount": b, "cost_rate": "x"}
    data["state_box"]["x"]["cells"] = 40
    del data["stage_cost"]
    result = lm.solve(made(data))
    start = np.array([[0.3], [0.9]])
    runs = result.closed_loop.run(start, 400, np.random.default_rng(0))
    assert runs.cost == pytest.approx(start[:, 0] * (1 - q) / (1 - b * q), rel=1e-8)
    found = result.simulate(4000, 400).cost
    mean = 0.5 * (1 - q) / (1 - b * q)
    assert abs(found["mean"] - mean) < 4.5 * found["standard_error"]
    assert found["mean"] == pytest.approx(result.cost, rel=0.05)


def test_what_is_said(tmp_path, capsys):
    data = steps(system=STILL, control_grid={}, attractor={}, discount=0.75)
    (tmp_path / "problem.json").write_text(json.dumps(data))
    out = tmp_path / "out"
    assert run(capsys, "solve", tmp_path / "problem.json", "--out", out)[0] == 0
    args = ("simulate", out, "--starts", 10, "--steps", 4)
    _, said, _ = run(capsys, *args)
    assert (
        "cost of all runs       2.73438 +- 0 (standard error), and 1.3 more at most after 4" in said
    )
    _, said, _ = run(capsys, *args, "--json")
    known = {"mean", "standard_error", "runs", "cut_off", *QUANTILES}
    assert set(json.loads(said)["cost"]) == known

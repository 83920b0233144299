"""What would help: lost mass, and hints with cases that must not give them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from infeasible import covered, line, three_causes
from problems import doubling, made

import lmdsl as lm
from lmdsl.errors import LmdslError
from lmdsl.explanation.causes import phase_one


def kinds(explanation):
    return {hint.kind for hint in explanation.hints}


# Phase one ------------------------------------------------------------------------------------


def test_phase_one_by_hand():
    # Cells 0 to 4 hold 1/5 each: 0 and 1 are lost, half of 2 goes to A, half to 1.
    found = phase_one(made(three_causes()))
    np.testing.assert_allclose(found.lost, np.array([1, 1, 0.5, 0, 0]) / 5, atol=1e-12)
    np.testing.assert_allclose(found.residual, np.array([1, 1.5, 0, 0, 0]) / 5, atol=1e-12)
    assert found.total == pytest.approx(2.5 / 5)
    by = found.by_cause()
    assert by["leads to these"]["lost"] == pytest.approx(0.1)
    assert by["trapped"]["residual"] == pytest.approx(0.3)
    assert found.largest().tolist() == [0, 1, 2]


@pytest.mark.parametrize("gamma", [0.5, 1.0])
def test_phase_one_takes_traps_for_lost_at_any_discount(gamma):
    assert phase_one(made({**three_causes(), "gamma": gamma})).total == pytest.approx(0.5)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.9])
def test_phase_one_of_a_feasible_problem_is_zero(gamma):
    found = phase_one(made(doubling(gamma)))
    assert found.total == pytest.approx(0, abs=1e-12)
    assert not found.lost.any()


def test_phase_one_beyond_gamma_bar():
    # Half of the one free cell returns: at gamma = 3 its theta removes 1 and brings 1.5.
    found = phase_one(made(doubling(3.0)))
    assert found.total == pytest.approx(1)
    assert found.lost.tolist() == pytest.approx([1])


def test_phase_one_weighs_the_support_only():
    found = phase_one(made(three_causes(measure={"boxes": [{"x": [2, 4]}]})))
    assert found.weight.tolist() == [0, 0, 0.5, 0.5, 0]
    np.testing.assert_allclose(found.lost, [0, 0, 0.25, 0, 0], atol=1e-12)
    assert found.total == pytest.approx(0.25)


def test_phase_one_is_greatest_probability_of_reaching():
    # Under u = 0 a third cell in four stays lost; the LP must choose u = 1, which loses one half.
    data = three_causes()
    data["system"]["next"] = {
        "x": "where(x < 2, x, where(x < 3, where(x < 2.75 - 0.25*u, 1.5, 5.5), x + u))"
    }
    data["sampling"]["per_axis"] = 4
    assert phase_one(made(data)).lost[2] == pytest.approx(0.5 / 5)


def test_phase_one_agrees_with_value_iteration():
    problem = lm.load("examples/double_integrator.json").replaced(attractor={"points": [[0, 0]]})
    axes = {"x": {"low": -2, "high": 2, "cells": 20}, "v": {"low": -1.5, "high": 1.5, "cells": 15}}
    system = {"kind": "double_integrator", "parameters": {"h": 0.4}}
    explanation = lm.explain(problem.replaced(state_box=axes, system=system), phase_one=True)
    found, t = explanation.phase_one, explanation.transitions
    P = t.rows.matrix()
    y = np.ones(t.rows.columns)
    for _ in range(3_000):
        best = np.ones_like(y)
        np.minimum.at(best, np.repeat(np.arange(len(y)), np.diff(t.pair_pointer)), P @ y)
        y = best
    np.testing.assert_allclose(found.lost / found.weight, y, atol=5e-5)
    assert found.total == pytest.approx((found.weight * y).sum(), rel=5e-5)
    assert found.lost.sum() == pytest.approx(found.total, rel=5e-5)
    # Exactly the cells outside C lose mass.
    assert found.cause.min() == lm.CellStatus.STABILIZED
    assert ((found.lost > 0) == (found.cause != lm.CellStatus.STABILIZED)).all()


def test_phase_one_says_when_it_is_not_solved():
    with pytest.raises(LmdslError, match="phase-one"):
        phase_one(lm.load("examples/standard_map.json"), time_limit=1e-9)


# Hints ----------------------------------------------------------------------------------------


def test_a_larger_box_helps_what_overshoots_and_returns():
    # Velocity v must first be braked: x runs over the upper side, then comes back.
    found = lm.explain(lm.load("examples/double_integrator.json"))
    sides = {h.numbers["end"]: h.numbers for h in found.hints if h.kind == "larger box"}
    assert set(sides) == {"low", "high"}
    # Braking from v = 1.5 at -1 takes 1.5^2/2 = 1.125; the quantile of those near must be below.
    assert 2 < sides["high"]["extend_to"] < 2 + 1.125
    assert sides["low"]["extend_to"] == pytest.approx(-sides["high"]["extend_to"], rel=0.05)


def test_no_larger_box_for_what_never_returns():
    # x+ = 1.5 x + 0.1 u: beyond 0.2 nothing returns, however near the side.
    found = lm.explain(line("1.5*x + 0.1*u", -1, 1, 40, at=0.0))
    assert found.lost > 10
    assert "larger box" not in kinds(found)


def test_no_larger_box_where_the_overshoot_is_large():
    # One visit far outside (70 % of the axis) and back to A: not a matter of a slightly larger box.
    near = lm.explain(line("where(x > 1, 0.05, where(x > 0.5, 1.1, x - 0.1))"))
    far = lm.explain(line("where(x > 1, 0.05, where(x > 0.5, 1.7, x - 0.1))"))
    assert "larger box" in kinds(near)
    assert near.hints[0].numbers["overshoot"] == pytest.approx(0.1)
    assert "larger box" not in kinds(far)


def test_more_controls_where_the_overshoot_falls_to_the_end():
    # x+ = x + 0.4 + 0.2 u, u in -1, -0.5, 0: leaves above x = 0.8; u = -2 would hold it.
    found = lm.explain(line("x + 0.4 + 0.2*u", controls=(-1, -0.5, 0)))
    (hint,) = [h for h in found.hints if h.kind == "more controls"]
    assert (hint.numbers["control"], hint.numbers["end"]) == ("u", "low")
    # The cell up to x = 1 needs 0.2 |u| >= 0.4 - 1/80, and 1.875 is not tried; 2 is the next.
    assert hint.numbers["extend_to"] == -2
    assert hint.numbers["cells"] == hint.numbers["tried"] == 2


@pytest.mark.parametrize(
    ("formula", "controls"),
    [
        ("x + 0.4 + 0.2*u", (-1, 0)),  # two values are no trend
        ("x + 0.4 + 0.2*u**2", (-1, 0, 1)),  # least in the middle
        ("x + 0.4 + 0*u", (-1, 0, 1)),  # no effect
        ("x + 9 + 0.2*u", (-1, 0, 1)),  # falls, but much too slowly
        ("x + 0.4 - 0.2/(1 + exp(-u))", (0, 5, 10)),  # falls, and saturates
    ],
)
def test_no_more_controls_without_a_trend_that_suffices(formula, controls):
    found = lm.explain(line(formula, controls=controls))
    assert any(c.name == "escapes" for c in found.causes)
    assert "more controls" not in kinds(found)


def test_a_finer_grid_where_samples_stay_although_the_map_moves():
    # Steps of 0.02 in cells of 0.1: no sample leaves its cell, so all are trapped.
    two = {"kind": "grid", "per_axis": 2}
    found = lm.explain(line("x + 0.02*u", sampling=two))
    assert [(c.name, c.cells) for c in found.causes] == [("trapped", 9)]
    (hint,) = [h for h in found.hints if h.kind == "finer grid"]
    assert hint.numbers["trapped"] == hint.numbers["cells"] == 9
    assert hint.numbers["own_cell_share"] == 1
    finer = lm.explain(line("x + 0.02*u", cells=100, sampling=two))
    assert finer.lost == 0


def test_no_finer_grid_where_the_map_itself_stays():
    found = lm.explain(line("x + 0*u"))
    assert [c.name for c in found.causes] == ["trapped"]
    assert found.hints == ()
    assert "nothing that was tried" in found.text()


def test_hints_are_bounded_for_many_controls_and_samples():
    problem = line("x + 0.4 + 1e-4*u", controls=range(-500, 500))
    found = lm.explain(problem.replaced(sampling={"kind": "random", "points": 500}))
    assert found.lost > 0


@pytest.mark.parametrize("name", ["henon_map", "van_der_pol", "inverted_pendulum"])
def test_examples_are_explained(name):
    found = lm.explain(lm.load(f"examples/{name}.json"))
    status = lm.compile(found.problem).cell_status
    for cause in found.causes:
        code = lm.CellStatus[cause.name.upper().replace(" ", "_")]
        assert cause.cells == (status == code).sum()
        for region in cause.regions:
            assert (status[covered(found.partition, region)] == code).all()
    json.dumps(found.to_dict(), allow_nan=False)


def test_trials_do_not_go_through_walls():
    """Beyond a wall nothing helps: a run whose path is judged does not jump over it."""
    problem = lm.Problem(
        system={"kind": "ode", "derivative": {"x": "4*u"}, "step": 0.2},
        state_box={"x": {"low": -1, "high": 1, "cells": 20}},
        attractor={"boxes": [{"x": [-0.1, 0.1]}]},
        avoid={"boxes": [{"x": [0.52, 0.58]}]},
        control_grid={"u": {"values": [-1, 0, 1]}},
        stage_cost="1",
        sampling={"kind": "grid", "per_axis": 1},
    )
    found = lm.explain(problem)
    assert found.lost == 4
    assert found.hints == ()


@pytest.mark.parametrize("judged", ["path", "endpoint"])
def test_a_run_may_come_back_into_the_box_along_its_path(judged):
    """Towards an end at speed 1 with a brake of 1: x goes out, and comes back under it."""
    problem = lm.Problem(
        system={"kind": "ode", "derivative": {"x": "v", "v": "u"}, "step": 0.25, "judged": judged},
        state_box={axis: {"low": -1, "high": 1, "cells": 10} for axis in "xv"},
        attractor={"boxes": [{"x": [-0.4, 0.4], "v": [-0.6, 0.6]}]},
        control_grid={"u": {"values": [-1, 0, 1]}},
        stage_cost="1",
        sampling={"kind": "grid", "per_axis": 1},
    )
    sides = [hint.numbers for hint in lm.explain(problem).hints if hint.kind == "larger box"]
    assert {(side["axis"], side["end"]) for side in sides} >= {("x", "low"), ("x", "high")}

"""What is asked of a controller in use: given starts, times, costs, paths, other parameters."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import run
from problems import made, steps

import lmdsl as lm

EXAMPLES = {"x": [0.1, 0.3, 0.6, 0.9, 1.5], "outcome": ["reached"] * 4 + ["lost"]}


def drift(**more):
    """x' = -u k on [0, 4], A = [0, 1]: from x at u = 1 A is entered at the time x - 1."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "parameters": {"k": 1}, "derivative": {"x": "-k*u"},
                   "step": 0.4},
        "state_box": {"x": {"low": 0, "high": 4, "cells": 8}},
        "attractor": {"boxes": [{"x": [0, 1]}]},
        "control_grid": {"u": {"values": [1]}},
        "cost_rate": "1 + x",
        "sampling": {"kind": "grid", "per_axis": 2},
        **more,
    }  # fmt: skip


def leaving(p):
    """A is the cell 0, left with probability p; one step later a run is back."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "where(x < 1, x + w, x - 1) + 0*u"}},
        "state_box": {"x": {"low": 0, "high": 2, "cells": 2}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0]}},
        "noise": {"w": {"values": [0, 1], "weights": [1 - p, p]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        "local_controller": {"kind": "constant"},
    }


RESULT = lm.solve(made(steps(gamma=2.0)))
DRIFT = lm.solve(made(drift()))


def test_given_starts_are_followed_in_their_order():
    runs = RESULT.simulate(np.array(EXAMPLES["x"])[:, None])
    each = runs.each
    assert each.outcome.tolist() == EXAMPLES["outcome"]
    assert each.lost_to.tolist() == [""] * 4 + ["outside"]
    assert each.steps.tolist() == each.times.tolist() == [0, 1, 2, 3, 0]
    np.testing.assert_array_equal(each.cost, [0, 1, 3, 7, np.nan])  # 1 + 2 + 4
    assert (runs.starts, runs.reached, runs.lost) == (5, 4, 1)
    assert runs.lost_to == {"outside": 1, "avoid": 0, "no_control": 0}
    assert [runs.cost[key] for key in ("runs", "min", "q50", "max")] == [4, 0, 1, 7]
    assert "from given starts" in runs.text()
    assert runs.times is None  # a map has steps, no time
    named = RESULT.simulate({"x": EXAMPLES["x"]})
    assert named == runs
    assert RESULT.simulate([0.6]).each.steps.tolist() == [2]


def test_costs_of_runs_are_the_values_where_the_model_is_exact():
    x = np.array([[0.05], [0.3], [0.55], [0.8]])
    np.testing.assert_allclose(RESULT.simulate(x).each.cost, RESULT.value_at(x), rtol=1e-9)


def test_values_of_states():
    np.testing.assert_allclose(RESULT.value_at([[0.1], [0.3], [0.6], [0.9]]), [0, 1, 3, 7])
    assert RESULT.value_at([1.5]) == np.inf
    assert RESULT.value_at({"x": [0.6, 0.6]}).shape == (2,)
    assert RESULT.value_at(np.full((2, 3, 1), 0.3)).shape == (2, 3)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_time_of_arrival_is_that_of_the_event(compiled):
    x = np.array([1.1, 1.5, 1.9, 3.05])
    each = DRIFT.simulate(x[:, None], as_compiled=compiled).each
    # Compiled paths are judged at parts of a step, some time after the entry.
    late = 0.4 / 2 if compiled else 1e-9
    assert (each.times >= x - 1 - 1e-9).all()
    assert (each.times <= x - 1 + late + 1e-9).all()
    assert each.steps.tolist() == np.ceil((x - 1) / 0.4 - 1e-9).tolist()
    if not compiled:  # the integral of 1 + x down to 1
        np.testing.assert_allclose(each.cost, (x - 1) + (x**2 - 1) / 2, rtol=1e-8)


def test_a_path_has_controls_times_costs_and_an_outcome():
    path = DRIFT.path([2.1])
    assert len(path) == 3
    np.testing.assert_allclose(path.states[:, 0], [2.1, 1.7, 1.3, 1.0], atol=1e-8)
    np.testing.assert_allclose(path.times, [0, 0.4, 0.8, 1.1], atol=1e-8)
    np.testing.assert_array_equal(path.controls, [[1], [1], [1]])
    assert path.cost == pytest.approx(path.costs.sum()) == pytest.approx(1.1 + (2.1**2 - 1) / 2)
    assert (path.outcome, path.lost_to) == ("reached", None)
    weighed = RESULT.path([0.9])
    assert (weighed.costs.tolist(), weighed.cost) == ([1, 1, 1], 7)
    assert weighed.times.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(weighed.states, RESULT.closed_loop.path([0.9], 9))
    assert RESULT.path([0.9], steps=2).outcome == "cycling"
    gone = RESULT.path([7.0])
    assert (len(gone), gone.outcome, gone.lost_to) == (0, "lost", "outside")
    assert (gone.controls.shape, gone.cost) == ((0, 1), 0)
    assert "cost 7, reached" in repr(weighed)


def test_other_parameters_change_the_map_and_not_the_controller():
    fast = DRIFT.simulate([[3.0]], parameters={"k": 2}).each
    assert fast.times[0] == pytest.approx(1.0)
    still = DRIFT.simulate([[3.0]], steps=9, parameters={"k": 0})
    assert (still.cycling, still.times) == (1, None)
    away = DRIFT.path([3.0], parameters={"k": -1})
    assert (away.outcome, away.lost_to) == ("lost", "outside")
    assert away.times[-1] == pytest.approx(1.0)
    assert DRIFT.simulate(50, parameters={}) == DRIFT.simulate(50)
    assert DRIFT.simulate(50, parameters={"k": 1}) == DRIFT.simulate(50)


def test_sets_that_name_a_parameter_stay_as_they_were_compiled():
    found = lm.solve(made(drift(attractor={"where": "x < k"})))
    for compiled in (False, True):
        runs = found.simulate([[1.9]], as_compiled=compiled, parameters={"k": 1.5})
        assert runs.each.times[0] == pytest.approx(0.6, abs=0.1)


def test_time_in_the_attractor_and_until_it_is_left():
    p = 0.2
    held = lm.solve(made(leaving(p))).simulate(400, hold=300).held
    assert held.stayed == 0
    assert held.inside == pytest.approx(1 / (1 + p), abs=0.01)  # of the chain A -> out -> A
    assert held.mean_to_leave == pytest.approx(1 / p, rel=0.2)  # geometric
    assert held.left["min"] == 1
    assert held.left["q50"] == pytest.approx(3, abs=1)  # 0.8^3 = 0.51
    short = lm.solve(made(leaving(p))).simulate(4000, hold=2).held
    assert short.mean_to_leave == pytest.approx(1 / p, rel=0.15)  # those that stay count
    kept = lm.solve(made(leaving(0))).simulate(20, hold=5).held
    assert (kept.inside, kept.left, kept.mean_to_leave) == (1, None, None)


def test_what_is_no_start_and_no_parameter_is_refused():
    for starts, word in (
        (np.zeros((0, 1)), "shape"),
        (np.zeros((2, 2, 1)), "shape"),
        ([[np.nan]], "finite"),
        ([[1, 2]], "shape"),
    ):
        with pytest.raises(lm.BadInput, match=word) as caught:
            RESULT.simulate(starts)
        assert caught.value.where == "starts"
    with pytest.raises(lm.BadInput, match="one state"):
        RESULT.path([[0.1], [0.2]])
    for parameters, word in (
        ({"K": 1}, "did you mean 'k'"),
        ({"k": np.nan}, "finite"),
        ({"k": "2"}, "finite"),
        ([1], "by name"),
    ):
        with pytest.raises(lm.BadInput, match=word) as caught:
            DRIFT.simulate(3, parameters=parameters)
        assert caught.value.where.startswith("parameters")
    with pytest.raises(lm.BadInput, match="it has none"):
        RESULT.path([0.1], parameters={"k": 1})


def test_from_the_command_line(tmp_path, capsys):
    DRIFT.save(tmp_path / "out")
    out = str(tmp_path / "out")
    given = ["simulate", out, "--from", "3.0", "--from", "1.5", "--parameter", "k=2"]
    status, found, _ = run(capsys, *given, "--json")
    found = json.loads(found)
    assert (status, found["starts"], found["reached"]) == (0, 2, 2)
    assert (found["times"]["min"], found["times"]["max"]) == pytest.approx((0.25, 1))
    assert "from given starts" in run(capsys, *given)[1]
    for bad, word in (
        (["--parameter", "k"], "NAME=VALUE"),
        (["--parameter", "k=x"], "not a number"),
        (["--parameter", "q=1"], "not a parameter"),
        (["--from", "1,2"], "shape"),
        (["--from", "a"], "not a number"),
    ):
        status, _, error = run(capsys, "simulate", out, *bad)
        assert (status, error.count("\n")) == (2, 1)
        assert word in error

"""Hints that were compiled: a longer step, a periodic axis, a box as attractor."""

from __future__ import annotations

import json
import math

import pytest
from problems import made

import lmdsl as lm
from lmdsl.explanation import remedies

PI = math.pi


def pendulum(step=0.1, periodic=True, **more):
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "ode",
            "derivative": {"th": "om", "om": "9.81*sin(th) + u"},
            "step": step,
        },
        "state_box": {
            "th": {"low": -PI, "high": PI, "cells": 30, "periodic": periodic},
            "om": {"low": -8, "high": 8, "cells": 30},
        },
        "attractor": {"boxes": [{"th": [-0.3, 0.3], "om": [-0.8, 0.8]}]},
        "control_grid": {"u": {"low": -4, "high": 4, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 3},
        **more,
    }


def hints(problem):
    found = lm.explain(problem)
    json.dumps(found.to_dict(), allow_nan=False)
    return {hint.kind: hint for hint in found.hints}


def share(problem):
    lp = lm.compile(problem)
    free = (lp.cell_status != lm.CellStatus.ATTRACTOR) & (lp.cell_status != lm.CellStatus.AVOID)
    return lp.n / free.sum()


def test_a_longer_step_frees_what_is_trapped():
    problem = made(pendulum(0.01))
    hint = hints(problem)["longer step"]
    numbers = hint.numbers
    assert numbers["share"] == pytest.approx(share(problem))
    system = problem.system.replaced(step=numbers["step"], substeps=numbers["substeps"])
    assert numbers["share_then"] == pytest.approx(share(problem.replaced(system=system)))
    assert numbers["share_then"] > numbers["share"] + 0.1
    assert numbers["stuck"] > 0
    assert f'"step": {numbers["step"]!r}' in hint.text


def test_a_longer_step_where_compiling_again_takes_too_long(monkeypatch):
    monkeypatch.setattr(remedies, "TRIAL", 0.0)
    problem = made(pendulum(0.002))
    numbers = hints(problem)["longer step"].numbers
    assert numbers["stuck"] > 0.05 * numbers["tried"]
    assert numbers["share_then"] is None
    assert numbers["stuck_then"] <= 0.1 * numbers["stuck"]
    # Half of that step leaves more of them.
    assert numbers["step"] > 0.004
    assert "longer step" not in hints(made(pendulum()))


def test_no_longer_step_where_the_step_is_long_enough():
    assert "longer step" not in hints(made(pendulum()))


def test_a_periodic_axis_for_an_angle():
    problem = made(pendulum(periodic=False))
    hint = hints(problem)["periodic axis"]
    assert hint.numbers["axis"] == "th"
    assert hint.numbers["share"] == pytest.approx(share(problem))
    assert hint.numbers["share_then"] == pytest.approx(share(made(pendulum())))
    assert '"periodic": true in state_box.th' in hint.text
    assert "periodic axis" not in hints(made(pendulum()))


def test_a_box_as_attractor_for_points_that_shrank():
    problem = lm.load("examples/double_integrator.json").replaced(attractor={"points": [[0, 0]]})
    axes = {name: axis.replaced(cells=2 * axis.cells) for name, axis in problem.state_box.items()}
    fine = problem.replaced(state_box=axes)
    hint = hints(fine)["box attractor"]
    boxed = fine.replaced(attractor={"boxes": hint.numbers["boxes"]})
    assert hint.numbers["share"] == pytest.approx(0.594, abs=0.001)
    assert hint.numbers["share_then"] == pytest.approx(share(boxed))
    assert hint.numbers["share_then"] > 0.85
    # What is lost on the problem's own grid leaves the box: a larger attractor is no cure.
    assert "box attractor" not in hints(problem)
    assert "box attractor" not in hints(boxed)

"""Runs of the true equation by SciPy alone, as the newcomers' examples make them.

The examples print what these count beside lmdsl's own figures; here the counting is tried by hand,
and by an equation that a single Runge-Kutta step misses.
"""

from __future__ import annotations

import importlib.util
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import lmdsl as lm
from lmdsl.cli import main

PLACE = Path(__file__).parents[2] / "examples/newcomers/_truth.py"
SPEC = importlib.util.spec_from_file_location("_truth", PLACE)
truth = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(truth)


def line(control, cells=4, periodic=False):
    """A result on [0, cells]: the first cell is A, the others have these controls, or none."""
    return SimpleNamespace(
        problem=SimpleNamespace(
            state_box={"x": SimpleNamespace(low=0, high=cells, cells=cells, periodic=periodic)}
        ),
        cell_status=np.array([0] + [1] * (cells - 1)),
        control_index=np.array([-1, *control]),
        control_vectors=np.array([[-1.0], [1.0], [-3.0]]),
        message="the message",
    )


def straight(x, u, rng):
    """x moves by u, seen half-way and at the end."""
    return np.stack([x + u / 2, x + u])


def arrived(x):
    return (x[0] >= 0) & (x[0] < 1)


def test_what_becomes_of_runs():
    left = truth.runs(line([0, 0, 0]), straight, arrived)
    assert left == {"starts": 4000, "reached": 4000, "safe": 4000,
                    "outside": 0, "avoid": 0, "no_control": 0}  # fmt: skip
    # From the last cell out of the box; the second and third arrive.
    some = truth.runs(line([0, 0, 1]), straight, arrived)
    assert some["outside"] == 4000 - some["reached"] == 4000 - some["safe"]
    assert some["reached"] == pytest.approx(4000 * 2 / 3, abs=4 * math.sqrt(4000 * 2 / 9))
    # From the third cell into the last, which has no control: that is no harm.
    stuck = truth.runs(line([0, 1, -1]), straight, arrived)
    assert stuck["no_control"] > 2000
    assert stuck["reached"] + stuck["no_control"] == stuck["safe"] == 4000
    # On a circle nothing is outside.
    round_ = truth.runs(line([1, 1, 1], periodic=True), straight, arrived)
    assert (round_["reached"], round_["outside"]) == (4000, 0)


def test_what_is_touched_on_the_way():
    def wall(x):
        return (x[0] > 1.0) & (x[0] < 1.25)

    # From 3..4 by -3 in one step: half-way at 1.5..2.5, past the wall; at its end 0..1.
    over = truth.runs(line([-1, -1, 2]), straight, arrived, wall)
    assert over["avoid"] == over["outside"] == 0

    def ways(x, u, rng):
        return np.stack([x + share * u for share in np.linspace(0, 1, 65)[1:]])

    # Seen all along, every run that comes by the wall has touched it.
    seen = truth.runs(line([-1, -1, 2]), ways, arrived, wall)
    assert seen["avoid"] == over["reached"] > 1000
    # What comes first counts: the target before the wall, the wall before the outside.
    first = truth.runs(line([0, 0, 0]), ways, lambda x: x[0] < 2, wall)
    assert first["avoid"] == pytest.approx(4000 / 3 / 4, abs=4 * math.sqrt(333))  # began in it


def test_disagreement_stops_the_examples(capsys):
    result = line([0, 0, 0])
    right = truth.runs(result, straight, arrived)

    def said(reached, **lost):
        lost = {"outside": 0, "avoid": 0, "no_control": 0, **lost}
        return SimpleNamespace(starts=4000, reached=reached, lost_to=lost)

    truth.beside("name", result, right, said(4000))
    assert "never unsafe" in capsys.readouterr().out
    with pytest.raises(AssertionError, match="arrive"):
        truth.beside("name", result, right, said(3980, no_control=20))
    with pytest.raises(AssertionError, match="never unsafe"):
        truth.beside("name", result, {**right, "safe": 3980, "avoid": 20}, said(4000))


# Steps that miss the equation ------------------------------------------------------------------


def van_der_pol(**system):
    """Fast motions in a wide box: Runge-Kutta steps of 0.4 are far beyond their stability."""
    return lm.Problem(
        system={"kind": "van_der_pol", "parameters": {"mu": 2}, "step": 0.4, **system},
        state_box={"x": {"low": -3, "high": 3, "cells": 60},
                   "v": {"low": -12, "high": 12, "cells": 60}},
        attractor={"boxes": [{"x": [-0.1, 0.1], "v": [-0.4, 0.4]}]},
        control_grid={"u": {"low": -5, "high": 5, "points": 9}},
        stage_cost="x**2 + v**2 + u**2",
        sampling={"kind": "grid", "per_axis": 4},
    )  # fmt: skip


def by_scipy(result):
    def derivative(x, u):
        return np.stack([x[1], 2 * (1 - x[0] ** 2) * x[1] - x[0] + u[0]])

    def at_rest(x):
        return (np.abs(x[0]) <= 0.1) & (np.abs(x[1]) <= 0.4)

    path = truth.flow(derivative, 0.4)
    if result.problem.judged == "endpoint":
        return truth.runs(result, lambda *a: path(*a)[-1:], at_rest, starts=1000)
    return truth.runs(result, path, at_rest, starts=1000)


@pytest.mark.parametrize("judged", ["endpoint", pytest.param("path", marks=pytest.mark.long)])
def test_one_step_of_runge_kutta_is_told_and_simulated_as_it_is(judged, tmp_path, capsys):
    """Verified, and of the compiled steps 99 % arrive; of the equation four in five: both said."""
    result = lm.solve(van_der_pol(substeps=1, judged=judged))
    assert result.status == "verified"
    assert result.integration_error.excessive
    assert min(result.integration_error.halving, result.integration_error.accurate) > 1000
    warning = result.integration_error.warning()
    assert warning.startswith("the steps are more than a tenth of a cell from the equation: raise")
    result.problem.save(tmp_path / "problem.json")
    assert main(["solve", str(tmp_path / "problem.json")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert warning in said
    assert re.search(r"true map: 7\d\d of 1,000 runs arrive, 2\d\d are lost", said)
    compiled, simulated = result.simulate(1000, as_compiled=True), result.simulate(1000)
    assert compiled.reached >= 990
    assert simulated.reached <= 820
    truth.beside("van der Pol", result, by_scipy(result), simulated)
    assert "few_substeps" in {finding.code for finding in lm.check(result.problem).findings}


@pytest.mark.parametrize("judged", ["endpoint", "path"])
def test_automatic_substeps_cure_it(judged):
    coarse = lm.solve(van_der_pol(substeps=1, judged=judged))
    result = lm.solve(van_der_pol(substeps="auto", judged=judged))
    assert max(result.integration_error.halving, result.integration_error.accurate) < 0.01
    assert result.stabilizable_cells > 2.5 * coarse.stabilizable_cells
    simulated = result.simulate(1000)
    assert simulated.reached >= 995
    truth.beside("van der Pol", result, by_scipy(result), simulated)

"""How far compiled steps are from the equation, and how many of them it takes."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from command_line import run
from problems import made, steps

import lmdsl as lm
from lmdsl.model.assembly.substeps import IntegrationError, integration_error, settled


def decay(rate=-3.0, substeps=1, step=0.4, **more):
    """x' = rate x on [0, 2]: the image is x times a polynomial of z = rate h."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "parameters": {"r": rate}, "derivative": {"x": "r*x + 0*u"},
                   "step": step, "substeps": substeps},
        "state_box": {"x": {"low": 0, "high": 2, "cells": 20}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 3},
        **more,
    }  # fmt: skip


def growth(z):
    return 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24


@pytest.mark.parametrize(("rate", "count"), [(-3.0, 1), (-3.0, 4), (2.0, 2), (-20.0, 2)])
def test_the_error_is_that_of_the_polynomial(rate, count):
    """Of x' = r x every image errs by x |p(z)^k - e^(rT)|; the largest x that stays counts."""
    found = integration_error(made(decay(rate, count)))
    exact = math.exp(0.4 * rate)
    mine, twice = (growth(0.4 * rate / k) ** k for k in (count, 2 * count))
    samples = (np.arange(3, 60) + 0.5) / 30  # of free cells
    staying = samples[samples * exact <= 2]
    least, most = np.quantile(staying, [0.97, 1.0], method="lower") / 0.1
    for error, factor in ((found.halving, mine - twice), (found.accurate, mine - exact)):
        assert least * abs(factor) * 0.99 <= error <= most * abs(factor) * 1.01
    assert found.substeps == count
    share = len(staying) / len(samples)
    assert found.pairs == pytest.approx(10_000 * share, abs=250)
    assert found.excessive == (max(found.halving, found.accurate) > 0.1)


def test_auto_is_the_smallest_power_of_two_that_keeps_a_hundredth():
    for rate in (-1.0, -3.0, -10.0, -60.0, 1.5):
        chosen = settled(made(decay(rate, "auto"))).system.substeps
        errors = {}
        count = 1
        while count <= 512:
            errors[count] = integration_error(made(decay(rate, count))).halving
            if errors[count] < 0.01:
                break
            count *= 2
        assert chosen == count
    many = settled(made(decay(-3000.0, "auto"))).system.substeps
    assert many == 512  # steps of 2.3 along e^(-3000 t): the limit
    assert settled(made(decay(-3.0, 7))).system.substeps == 7
    assert settled(made(steps())) == made(steps())
    assert integration_error(made(steps())) is None


def test_nothing_stays():
    problem = made(decay(5.0, "auto", step=3.0))
    assert settled(problem).system.substeps == 1
    found = lm.solve(problem).integration_error
    assert (found.pairs, found.halving, found.accurate, found.excessive) == (0, None, None, False)
    assert found.sentence() == "no sample stays in the box"


def test_what_is_saved_holds_the_number(tmp_path, capsys):
    (tmp_path / "problem.json").write_text(json.dumps(decay(-10.0, "auto")))
    out = tmp_path / "out"
    _, said, _ = run(capsys, "solve", tmp_path / "problem.json", "--out", out, "--json")
    error = json.loads(said)["integration_error"]
    stored = json.loads((out / "problem.json").read_text())
    assert stored["system"]["substeps"] == error["substeps"] > 1
    assert "integration_error" not in json.loads((out / "certificate.json").read_text())
    assert run(capsys, "verify", out)[0] == 0
    assert lm.Result.load(out).integration_error is None
    _, said, _ = run(capsys, "solve", tmp_path / "problem.json")
    assert "\nintegration   99 % of the steps within" in said


def test_a_warning_above_a_tenth_of_a_cell(tmp_path, capsys):
    (tmp_path / "problem.json").write_text(json.dumps(decay(-6.0, 1)))
    status, said, _ = run(capsys, "solve", tmp_path / "problem.json")
    assert status == 0
    warning = (
        "the steps are more than a tenth of a cell from the equation: raise substeps, or write"
    )
    assert said.count(warning) == 2  # in the report, and in the message


def test_the_remedy_where_no_more_substeps_are_to_be_had():
    text = str(IntegrationError(512, 100, 1.0, 1.0))
    assert "shorten step" in text
    assert "raise substeps" not in text
    assert 'raise substeps, or write "auto"' in str(IntegrationError(500, 100, 1.0, 1.0))


def test_kinks_are_judged_by_finer_fixed_steps():
    data = decay(-3.0, 2)
    data["system"]["derivative"]["x"] = "r*abs(x) + 0*u"  # the same: x is positive
    smooth, kinked = integration_error(made(decay(-3.0, 2))), integration_error(made(data))
    assert kinked.accurate == pytest.approx(smooth.accurate, rel=1e-3)
    assert kinked.halving == smooth.halving


@pytest.mark.parametrize("word", ["Auto", "", "4", None, True, 2.0])
def test_other_words_are_refused(word):
    with pytest.raises(lm.BadInput, match=r"system\.substeps"):
        made(decay(-3.0, word))


@pytest.mark.parametrize("name", ["inverted_pendulum", "pendulum_on_cart", "van_der_pol", "lorenz"])
def test_what_init_writes_settles_below_a_hundredth(name):
    data = lm.systems.NAMED[name].problem
    assert data["system"]["substeps"] == "auto"
    problem = settled(made(data))
    assert problem.system.substeps == {
        "inverted_pendulum": 1, "pendulum_on_cart": 2, "van_der_pol": 4, "lorenz": 8,
    }[name]  # fmt: skip
    found = integration_error(problem)
    assert found.halving < 0.01
    assert found.accurate < 0.011


def test_a_short_problem_is_settled_whatever_the_limit():
    result = lm.solve(made(decay(-10.0, "auto")), time_limit=1e-9)
    assert result.problem.system.substeps > 1
    assert result.integration_error is None or result.integration_error.halving < 0.01


def test_stiff_equations_heed_the_limit():
    """Few cells, but an equation that an accurate integrator follows in steps beyond number."""
    data = decay(-1e7, "auto")
    with pytest.raises(lm.TimeLimitReached):
        lm.compile(made(data), time_limit=1e-9)

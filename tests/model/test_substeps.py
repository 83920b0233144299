"""How far compiled steps are from the equation, and how many of them it takes."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
from command_line import run
from problems import made, steps

import lmdsl as lm
from lmdsl.control.accuracy import IntegrationError, integration_error
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.substeps import settled


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
    assert re.search(r"^integration +99 % of the steps within", said, re.MULTILINE)


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


@pytest.mark.parametrize(
    "name", ["inverted_pendulum", "pendulum_on_cart", "van_der_pol", "lorenz", "cart_pole"]
)
def test_what_init_writes_settles_below_a_hundredth(name):
    data = lm.systems.NAMED[name].problem
    assert data["system"]["substeps"] == "auto"
    problem = settled(made(data))
    assert problem.system.substeps == {
        "inverted_pendulum": 1, "pendulum_on_cart": 2, "van_der_pol": 4, "lorenz": 8,
        "cart_pole": 2,
    }[name]  # fmt: skip
    found = integration_error(problem)
    assert found.halving < 0.01
    assert found.accurate < 0.011


def test_a_short_problem_is_settled_whatever_the_limit():
    result = lm.solve(made(decay(-10.0, "auto")), time_limit=1e-9)
    assert result.problem.system.substeps > 1
    assert result.integration_error is None or result.integration_error.halving < 0.01


def fast(rate=-1e7, substeps="auto", **more):
    """Few cells, but an equation that an accurate integrator follows in steps beyond number."""
    return made(decay(rate, substeps, **more))


@pytest.mark.parametrize("limit", [None, 1e-9])
def test_automatic_substeps_of_stiff_equations_end_with_one_message(limit):
    with pytest.raises(lm.BadInput, match=r"stiff, .* more than 1,000 steps .* 0\.4; shorten step"):
        lm.compile(fast(), time_limit=limit)
    with pytest.raises(lm.BadInput) as raised:
        lm.check(fast())
    assert raised.value.where == "system.substeps"


@pytest.mark.parametrize(("others", "stiff"), [(30, True), (400, False)])
def test_stiffness_counts_from_a_hundredth_of_the_pairs_on(others, stiff):
    """One control of so many makes the equation stiff."""
    data = decay(1.0, "auto")
    data["system"]["derivative"]["x"] = "-x*exp(u)"
    data["control_grid"] = {"u": {"values": [17, *(i / others for i in range(others))]}}
    if stiff:
        with pytest.raises(lm.BadInput, match="stiff"):
            settled(made(data))
    else:
        assert settled(made(data)).system.substeps <= 2


def test_numbers_of_substeps_of_stiff_equations_are_judged(tmp_path, capsys):
    found = integration_error(fast(substeps=4))
    assert found.given_up
    assert found.accurate == np.inf
    assert "gives up after 1,000 steps: shorten step" in found.sentence()
    (tmp_path / "problem.json").write_text(json.dumps(decay(-1e7, 4)))
    _, said, _ = run(capsys, "solve", tmp_path / "problem.json", "--no-simulate", "--json")
    error = json.loads(said)["integration_error"]
    assert (error["accurate"], error["given_up"]) == ("inf", True)
    findings = {f.code: f for f in lm.check(fast(substeps=4)).findings}
    assert findings["few_substeps"].figures["substeps_needed"] == 0
    assert "shorten step" in findings["few_substeps"].remedy


def test_steps_that_explode_where_the_equation_can_be_followed():
    found = integration_error(fast(-3000.0, 1))
    assert not found.given_up
    assert found.excessive
    assert 'write "auto"' in found.warning()


def test_judging_heeds_the_limit():
    with pytest.raises(lm.TimeLimitReached):
        integration_error(fast(substeps=4), None, Deadline(1e-9))


def pole(substeps=1, step=0.4, cells=20, points=2, **more):
    """x' = u across A, |x| <= 0.1, at the rate 1/x**2: from x to A it costs 10 - 1/|x|."""
    data = decay(step=step, substeps=substeps, sampling={"kind": "grid", "per_axis": points})
    data["system"] |= {"derivative": {"x": "u"}, "parameters": {}}
    data["state_box"]["x"] = {"low": -1, "high": 1, "cells": cells}
    data |= {"attractor": {"boxes": [{"x": [-0.1, 0.1]}]}, "cost_rate": "1/x**2"}
    data["control_grid"] = {"u": {"values": [-1, 1]}}
    del data["stage_cost"]
    return data | more


@pytest.mark.parametrize(("step", "points"), [(0.3, 3), (0.3, 2), (0.4, 2), (0.4, 4)])
def test_a_rate_that_is_integrated_across_its_pole(step, points):
    """A stage beyond A meets the pole: 7.5 in the mean, but 3e29 in the model (first case)."""
    result = lm.solve(made(pole(step=step, points=points)))
    assert result.cost > 3 * 7.5
    assert result.integration_error.halving < 1e-9
    assert result.integration_error.excessive
    assert min(result.integration_error.cost_halving, result.integration_error.cost_accurate) > 0.5
    assert "the costs of steps miss the integrals of cost_rate by" in result.message
    assert result.message.endswith('raise substeps, or write "auto"')
    assert result.simulate(4000, 100).cost["mean"] == pytest.approx(7.5, abs=0.15)


def test_automatic_substeps_heed_the_rate():
    settled_ = settled(made(pole("auto")))
    count = settled_.system.substeps
    assert count > 1
    assert integration_error(settled_).cost_halving < 0.001
    assert integration_error(made(pole(count // 2))).cost_halving >= 0.001
    constant = settled(made(pole("auto", cost_rate="3")))
    assert constant.system.substeps == 1
    assert settled(made(pole("auto", cost_rate="0"))).system.substeps == 1


def test_what_remains_is_where_paths_end_and_goes_with_the_cells():
    """The entry into A is looked for in steps of half a cell; more substeps look closer."""
    found = lm.solve(made(pole("auto")))
    assert found.integration_error.cost_accurate > 0.01
    assert "half a cell inside the attractor: raise substeps, or use more cells" in found.message
    closer = lm.solve(made(pole(512)))
    assert closer.integration_error.cost_accurate < 0.01
    assert not closer.integration_error.excessive
    assert closer.cost == pytest.approx(7.5, rel=0.1)  # the rate is convex: cells cost more
    finer = lm.solve(made(pole("auto", cells=320)))
    assert finer.integration_error.cost_accurate < 0.05
    assert finer.cost == pytest.approx(7.5, rel=0.1)


@pytest.mark.parametrize(("rate", "count"), [(-3.0, 1), (-3.0, 2), (-8.0, 2)])
@pytest.mark.parametrize("judged", ["path", "endpoint"])
def test_errors_of_a_quadrature_in_closed_form(rate, count, judged):
    """Of x' = r x at the rate x**2 every step costs x**2 times a number: Simpson's weights."""
    step = 0.4
    data = decay(rate, count, step, cost_rate="x**2", attractor={"cells": [[0]]})
    data["state_box"]["x"] = {"low": 0, "high": 2, "cells": 2000}  # none enters A
    data["state_box"]["x"]["low"] = -1e-3
    data["attractor"] = {"cells": [[0]]}
    data["system"]["judged"] = judged
    del data["stage_cost"]

    def made_of(k):
        z, total, x = rate * step / k, 0.0, 1.0
        for _ in range(k):
            k2 = 1 + z / 2
            k3 = 1 + z / 2 * k2
            k4 = 1 + z * k3
            total += step / k / 6 * (1 + 2 * k2**2 + 2 * k3**2 + k4**2) * x**2
            x *= growth(z)
        return total

    exact = (np.exp(2 * rate * step) - 1) / (2 * rate)
    found = integration_error(made(data))
    mine, twice = made_of(count), made_of(2 * count)
    assert found.cost_halving == pytest.approx(abs(mine / twice - 1), rel=1e-6)
    assert found.cost_accurate == pytest.approx(abs(mine / exact - 1), rel=1e-6)


def test_costs_until_the_entry_into_the_attractor_in_closed_form():
    """x' = -1 at the rate x from 1: (x**2 - a**2)/2 exactly, whatever the substeps."""
    data = pole(4, cost_rate="abs(x)", control_grid={"u": {"values": [-1]}})
    data["state_box"]["x"] = {"low": 0, "high": 1, "cells": 1000}
    data["attractor"] = {"boxes": [{"x": [0, 0.1]}]}
    found = integration_error(made(data))
    assert found.cost_halving < 1e-12
    assert found.cost_accurate < 2e-3  # half a cell of a thousand, at 0.1, of the mean path


def test_maps_and_stage_costs_have_no_quadrature():
    found = integration_error(made(decay()))
    assert found.cost_halving is found.cost_accurate is None
    assert "costs" not in found.sentence()
    assert "their costs within" in integration_error(made(pole(64, cost_rate="1"))).sentence()

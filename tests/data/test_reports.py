"""What is said of recorded data beside the result: explanations, exports, limits, edges."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from saved_results import put

import lmdsl as lm
from lmdsl.cli import main

KEYS = {
    "state_box": {"x": {"low": 0, "high": 2, "cells": 4}},
    "control_grid": {"u": {"values": [0, 1]}},
    "stage_cost": "1",
    "attractor": {"boxes": [{"x": [0, 0.5]}]},
}
CHECKER = Path(lm.__file__).parents[1] / "tools/check_certificate.py"


def problem(**more):
    """Cell 1 goes to A under 0; cell 2 to cell 1, or out under 1; cell 3 has no data."""
    x = [0.6] * 40 + [1.1] * 40 + [1.2] * 4
    u = [0] * 80 + [1] * 4
    x_next = [0.2] * 30 + [0.7] * 10 + [0.8] * 40 + [0.8] * 3 + [9]
    return lm.from_data(x, u, x_next, **{**KEYS, **more})


def test_why_a_cell_is_lost():
    found = lm.explain(problem())
    text = str(found)
    assert "every control recorded there was seen to leave" in text
    assert "u = 0 was not recorded here, or not often enough" in text
    alone = lm.from_data([1.2] * 4, [1] * 4, [0.2] * 3 + [9], **KEYS)
    assert "u = 1 was seen to leave the box in 25 % of the recorded transitions" in str(
        lm.explain(alone, regions=9)
    )


def test_exports_name_what_is_assumed(tmp_path, capsys):
    lm.solve(problem()).save(tmp_path / "out")
    for kind in ("certificate", "drn"):
        file = str(tmp_path / kind)
        assert main(["export", str(tmp_path / "out"), "--format", kind, "--out", file]) == 0
        assert "assumption `support`" in Path(file).read_text()
    done = subprocess.run([sys.executable, str(CHECKER), str(tmp_path / "certificate")],
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done
    assert "assumption `support`" in done.stdout


def test_the_command_line_names_what_is_assumed(tmp_path, capsys):
    result = lm.solve(problem(confidence=0.9))
    result.save(tmp_path / "out")
    assert main(["verify", str(tmp_path / "out")]) == 0
    assert "assumed: no transition occurs that was not recorded" in capsys.readouterr().out
    assert main(["simulate", str(tmp_path / "out"), "--starts", "50"]) == 0
    assert "50 runs of the recorded rows from random starts" in capsys.readouterr().out
    from lmdsl.cli.solving import summary

    text = summary(result)
    for word in ("84 of 84 transitions used", "support, independence", "true cost", "unseen"):
        assert word in text


def test_without_time_the_range_is_not_bounded(tmp_path):
    from lmdsl.data.report import DataReport
    from lmdsl.machine.deadline import Deadline

    lp = lm.compile(problem(confidence=0.9))
    late = Deadline(1e-9)

    def guard():
        late.raise_if_over("testing")

    policy = lm.solve(lp).lp.pair_pointer[:-1]
    assert DataReport.of(lp, policy, guard).cost == (0.0, None)
    assert DataReport.of(lp, policy).cost[1] is not None


def test_a_wider_range_than_the_one_found_is_confirmed(tmp_path):
    """A range cut short by a time limit says less, and nothing wrong."""
    lm.solve(problem(confidence=0.9)).save(tmp_path / "out")
    file = tmp_path / "out/certificate.json"
    before, after = file.read_text().split('"cost": [\n', 1)
    low, high, rest = after.split("\n", 2)
    file.write_text(f'{before}"cost": [\n      0.0,\n      null\n{rest}')
    assert lm.verify(tmp_path / "out").holds
    file.write_text(f'{before}"cost": [\n      0.0,\n      {float(high) * 0.99}\n{rest}')
    assert "data.cost" in str(lm.verify(tmp_path / "out").reasons)
    assert low


def test_a_result_that_is_restricted_to_its_gamma():
    """From cell 2 staying is too likely for gamma = 2; cell 1 alone is solved and reported on."""
    x, x_next = [0.6] * 100 + [1.1] * 100, [0.2] * 100 + [1.1] * 60 + [0.7] * 40
    slow = lm.from_data(x, [0] * 200, x_next, gamma=2, confidence=0.9, **KEYS)
    assert lm.solve(slow).status == "not_stabilizable"
    result = lm.solve(slow, restrict_to_gamma=True)
    assert result.verified
    assert result.data.cost == pytest.approx((1, 1))


def test_an_autonomous_system_and_two_axes():
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (4000, 2))
    declared = {
        "state_box": {name: {"low": -1, "high": 1, "cells": 8} for name in "ab"},
        "control_grid": {}, "stage_cost": "a**2 + b**2",
        "attractor": {"boxes": [{"a": [-0.25, 0.25], "b": [-0.25, 0.25]}]},
    }  # fmt: skip
    result = lm.solve(lm.from_data(x, None, 0.7 * x, confidence=0.5, **declared))
    assert result.verified
    table = {"a": x[:, 0], "b": x[:, 1], "a_next": 0.7 * x[:, 0], "b_next": 0.7 * x[:, 1]}
    assert lm.from_data(table, confidence=0.5, **declared) == result.problem


def test_definitions_and_conditions_of_a_problem_file():
    both = problem(let={"far": "where(x > 1, 2, 1)"}, stage_cost="far", admissible="u < 1")
    result = lm.solve(both)
    assert result.value[[1, 2]] == pytest.approx([4 / 3, 2 + 4 / 3])


def test_simulated_runs_pay_what_was_recorded():
    """The stage cost once: the mean over the recorded states is what a run pays."""
    result = lm.solve(problem(stage_cost="1 + x"))
    runs = result.simulate(4000, 1000)
    assert runs.reached == 4000
    assert abs(runs.cost["mean"] - result.cost) < 5 * runs.cost["standard_error"]
    assert runs.method == "recorded rows"


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A saved result of noisy data, its files' content, and the arrays of its rows."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0, 2, 3000), rng.integers(0, 2, 3000)
    noisy = lm.from_data(x, u, 0.7 * x + rng.uniform(-0.1, 0.2, 3000).clip(-0.7 * x), **KEYS,
                         confidence=0.9)  # fmt: skip
    result = lm.solve(noisy)
    assert result.verified
    place = tmp_path_factory.mktemp("saved") / "out"
    result.save(place)
    assert lm.verify(place).holds
    return place


def spoiled(saved, tmp_path):
    return Path(shutil.copytree(saved, tmp_path / "copy"))


@pytest.mark.parametrize("number", range(13))
def test_every_figure_of_the_report_is_checked(saved, tmp_path, number):
    target = spoiled(saved, tmp_path)
    certificate = json.loads((target / "certificate.json").read_text())
    data = certificate["data"]
    figures = [(key, None) for key in data if isinstance(data[key], int | float)]
    figures += [(key, k) for key in ("unseen", "cost") for k in (0, 1)]
    key, k = figures[number]
    better = 1.01 if (key, k) == ("cost", 0) else 0.99
    if k is None:
        data[key] = data[key] + 1 if isinstance(data[key], int) else data[key] * better
    else:
        data[key][k] *= better
    put(target, certificate)
    assert f"data.{key}" in str(lm.verify(target).reasons)
    assert len(figures) == 13


@pytest.mark.parametrize("place", [-3, -2, -1])  # of cells that are not attractor
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("cell", 1), ("control", 1), ("cost", -0.3), ("cost", np.nan), ("cost", 0.3),
        ("pointer", 1), ("target", 1), ("target", -9), ("code", 1), ("code", 10**6),
        ("numerator", 1), ("denominator", 1),
    ],
)  # fmt: skip
def test_spoiled_rows_are_refused(saved, tmp_path, name, change, place):
    target = spoiled(saved, tmp_path)
    with np.load(target / "model.npz", allow_pickle=False) as stored:
        arrays = {key: stored[key] for key in stored.files}
    flat = arrays[name].reshape(-1)
    flat[place] = flat[place] + change if name == "cost" else (int(flat[place]) + change) % 2**31
    put(target, model=arrays)
    try:
        found = lm.verify(target)
    except lm.BadInput:
        return
    assert not (found.holds and found.same_model)


def test_check_says_where_data_are_few():
    """Cell 3 has no data under either control, cell 1 and 2 none or 4 under 1: 3 of 6 pairs."""
    (few, *_) = lm.check(problem()).findings
    assert few.code == "few_data"
    assert few.figures["missing"] == pytest.approx(1 / 2)
    rng = np.random.default_rng(0)
    x, u = rng.uniform(0, 2, 10_000), rng.integers(0, 2, 10_000)
    assert not lm.check(lm.from_data(x, u, 0.7 * x, **KEYS)).findings
    wanted = few.figures["wanted"]  # of one more draw a pair the limit is what it aims at
    enough = lm.from_data([1.1] * wanted, [0] * wanted, [0.2] * wanted, **KEYS)
    assert 0.05 < lm.solve(enough).data.unseen[1] <= 0.1

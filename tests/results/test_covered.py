"""What is said beside "verified": the share that is served, and runs of the true map."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from problems import doubling, made, steps

import lmdsl as lm
from lmdsl.cli import main, solving
from lmdsl.control.simulation import Simulation
from lmdsl.machine.deadline import Deadline
from lmdsl.results import result
from lmdsl.results.summary import Coverage

PENDULUM = {
    "format": "lmdsl/1",
    "system": {"kind": "inverted_pendulum", "parameters": {"m": 1, "l": 1, "g": 9.81, "d": 0.1},
               "step": 0.1, "substeps": 2},
    "state_box": {"theta": {"low": -3.141592653589793, "high": 3.141592653589793, "cells": 32,
                            "periodic": True}, "omega": {"low": -9, "high": 9, "cells": 32}},
    "attractor": {"points": [{"theta": 0, "omega": 0}]},
    "control_grid": {"u": {"low": -3, "high": 3, "points": 9}},
    "stage_cost": "1 - cos(theta) + 0.02*omega**2 + 0.01*u**2",
    "sampling": {"kind": "grid", "per_axis": 1},
}  # fmt: skip


@pytest.fixture
def solve(capsys, tmp_path):
    def run(data, *options):
        (tmp_path / "p.json").write_text(json.dumps(data))
        status = main(["solve", str(tmp_path / "p.json"), *options])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


def circling(cells=4):
    """Every sample is absorbed at once; every other state stays where it is for ever."""
    data = steps()
    data["system"]["next"] = {"x": "where(abs(x - 0.625) < 1e-9, 0.125, x)"}
    data["control_grid"] = {}
    data["state_box"] = {"x": {"low": 0, "high": 1, "cells": 4}}
    data["attractor"] = {"cells": [[0], [1], [3]]}
    data["sampling"] = {"kind": "grid", "per_axis": 1}
    return data


@pytest.mark.long
def test_a_pendulum_with_one_sample_a_cell_says_so(solve, monkeypatch):
    status, out, err = solve(PENDULUM)
    assert (status, err) == (0, "")
    last = out.splitlines()[-1]
    arrive = re.match(r"verified on the finite model; true map: (\d+) of 1,000 runs arrive, ", last)
    assert 250 < int(arrive.group(1)) < 380
    assert "cycle" in last
    assert last.endswith(": too few samples, or too large cells")
    # Also where a slow machine makes few of the steps.
    monkeypatch.setattr(solving, "STEPS", 100_000)
    monkeypatch.setattr(Deadline, "__call__", Counting(100_000))
    status, out, err = solve(PENDULUM, "--json")
    runs = json.loads(out)["simulation"]
    assert runs["cut"]
    assert 100 < runs["steps_made"] < 2_500
    assert runs["reached"] + runs["lost"] + runs["cycling"] == 1_000
    monkeypatch.setattr(Deadline, "__call__", Counting(100_000))
    assert "too few" in solve(PENDULUM)[1]


class Counting:
    """A deadline that comes after so many questions."""

    def __init__(self, most):
        self.left = most

    def __get__(self, deadline, _):
        return lambda: deadline.seconds is not None and self.ask()

    def ask(self):
        self.left -= 1
        return self.left < 0


def test_what_cycles_is_counted(solve):
    status, out, _ = solve(circling(), "--json")
    report = json.loads(out)
    assert (status, report["status"]) == (0, "verified")
    assert report["simulation"]["cycling"] == 1000
    assert report["simulation"]["steps"] is None
    assert report["simulation"]["cut"] or report["simulation"]["steps_made"] == 10_000
    assert report["message"].startswith("the controller brings every one of 1 cells (of 1 free)")


def test_no_simulation_where_it_is_not_wanted_or_cannot_be(solve):
    for data, options, code in (
        (steps(), ["--no-simulate"], 0),
        (doubling(3.0), [], 3),
        ({**steps(), "gamma": -1}, [], 2),
    ):
        status, out, _ = solve(data, "--json", *options)
        assert status == code
        assert json.loads(out)["simulation"] is None
        assert "true map" not in solve(data, *options)[1]
    assert lm.solve(made(steps())).simulation is None
    assert lm.solve(made(steps())).to_dict()["simulation"] is None


@pytest.mark.parametrize("error", [KeyboardInterrupt(), MemoryError(), ZeroDivisionError("\x1b")])
@pytest.mark.parametrize("json_too", [True, False])
def test_a_failed_simulation_loses_nothing(solve, tmp_path, monkeypatch, error, json_too):
    def fail(*_, **__):
        assert lm.verify(tmp_path / "out").holds  # saved by now
        raise error

    monkeypatch.setattr(result.Result, "simulate", fail)
    options = ["--json"] if json_too else []
    status, out, err = solve(steps(), "--out", str(tmp_path / "out"), *options)
    assert status == (130 if isinstance(error, KeyboardInterrupt) else 0)
    assert err.count("\n") == 1
    assert "\x1b" not in err
    if json_too:
        report = json.loads(out)
        assert report["status"] == "verified"
        assert report["simulation"] is None
    else:
        assert "every one of 3 cells (of 3 free)" in out
    assert lm.verify(tmp_path / "out").holds


def test_coverage_counts_free_cells(solve):
    avoided = steps(avoid={"boxes": [{"x": [0.5, 0.75]}]})
    found = lm.solve(made(avoided))
    by_hand = np.asarray(found.cell_status)
    assert found.coverage.free == 2 == ((by_hand != 0) & (by_hand != 5)).sum()
    assert found.coverage.stabilizable == (by_hand == 1).sum() == found.stabilizable_cells
    assert found.coverage.share == found.coverage.stabilizable / 2
    assert "cells stabilizable" in repr(found)
    everything = lm.solve(made(steps()))
    assert str(everything.coverage) == "3 of 3 free cells stabilizable (100 %)"
    assert "3 of 4" not in repr(everything)
    nothing = steps(attractor={"cells": [[0], [1], [2], [3]]})
    status, out, _ = solve(nothing, "--json")
    assert status == 3
    assert json.loads(out)["coverage"] == {"stabilizable": 0, "free": 0, "share": None}


def test_nearly_all_is_not_all():
    status = np.ones(100_001, dtype=np.uint8)
    status[5] = 3
    assert str(Coverage.of(status)).endswith("(99.99 %)")


def runs(reached, lost, cycling, median=5, made=10_000, cut=False):
    found = dict.fromkeys(("min", "q50", "q90", "q99", "max"), median) if reached else None
    starts = reached + lost + cycling
    return Simulation(starts, reached, lost, cycling, found, (0, 1), None, made, cut).sentence()


def test_sentences():
    assert runs(1000, 0, 0) == "true map: 1,000 of 1,000 runs arrive"
    assert runs(998, 1, 1) == "true map: 998 of 1,000 runs arrive, 1 is lost, 1 cycles"
    assert "too few samples" in runs(285, 49, 666)
    assert "too few samples" in runs(980, 20, 0)
    late = runs(100, 0, 900, median=30, made=50, cut=True)  # most may still be on their way
    assert late.endswith("100 of 1,000 runs arrive, 900 cycle or are cut off after 50 steps")
    assert "too few samples" in runs(100, 0, 900, median=30, made=400, cut=True)
    assert "too few" not in runs(0, 0, 1000, made=3, cut=True)

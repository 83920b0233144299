"""The command line: exit statuses, JSON, and directories that appear whole or not at all."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from command_line import run, spoil_array
from problems import doubling, standard_map, steps

import lmdsl as lm

KEYS = [
    "status", "backend", "solver_status", "gamma", "cost", "lower_bound", "gap", "tolerance",
    "contraction", "gamma_bar", "cells", "controls", "pairs", "attractor_cells",
    "stabilizable_cells", "polish_steps", "seconds", "message",
    "local_controller", "beyond_gamma", "coverage", "simulation", "data",
    "integration_error", "sure_cells", "claims", "proved",
]  # fmt: skip


def run_json(capsys, *arguments):
    status, out, _ = run(capsys, *arguments, "--json")
    assert out.count("\n") == 1 or arguments[0] in ("systems", "backends")

    def refuse(word):
        raise AssertionError(f"{word} in JSON")

    return status, json.loads(out, parse_constant=refuse)


def test_solve_and_everything_after(capsys, file, tmp_path):
    out = tmp_path / "out"
    status, report = run_json(capsys, "solve", file(standard_map(20)), "--out", out)
    assert status == 0
    assert list(report) == KEYS
    assert report["status"] == "verified"
    assert set(report["seconds"]) == {"compile", "solve", "verify"}
    assert sorted(p.name for p in out.iterdir()) == [
        "certificate.json",
        "problem.json",
        "solution.npz",
    ]
    stored = json.loads((out / "certificate.json").read_text())
    assert report.pop("coverage") == {"stabilizable": 392, "free": 392, "share": 1}
    runs = report.pop("simulation")
    assert report.pop("integration_error") is None
    assert report.pop("sure_cells") is None
    assert (runs["starts"], runs["reached"]) == (1000, 1000)
    assert {"coverage", "simulation", "integration_error", "sure_cells"} & stored.keys() == set()
    assert {key: stored[key] for key in report} == report
    assert len(stored["model_sha256"]) == 64
    with np.load(out / "solution.npz", allow_pickle=False) as arrays:
        assert arrays["control_index"].dtype == np.int32
        assert arrays["cell_status"].dtype == np.uint8
        assert arrays["value"].shape == arrays["lower"].shape == arrays["measure"].shape == (400,)
    status, found = run_json(capsys, "verify", out)
    assert status == 0
    assert found["holds"]
    assert found["same_model"]
    status, exact = run_json(capsys, "verify", out, "--exact")
    assert status == 0
    assert exact["holds"]
    assert exact["gap"] <= found["gap"]
    status, runs = run_json(capsys, "simulate", out, "--starts", 200, "--steps", 500)
    assert status == 0
    assert runs["starts"] == 200 == runs["reached"] + runs["lost"] + runs["cycling"]
    assert set(runs["steps"]) == {"min", "q50", "q90", "q99", "max"}
    assert 0 <= runs["interval"][0] <= runs["reached"] / 200 <= runs["interval"][1] <= 1
    # The same once more, into the same directory.
    status, _, _ = run(capsys, "solve", file(standard_map(20)), "--out", out)
    assert status == 0


def test_text_output(capsys, file, tmp_path):
    status, out, err = run(capsys, "solve", file(standard_map(20)), "--out", tmp_path / "o")
    assert status == 0
    assert "verified" in out
    assert err == ""
    status, out, _ = run(capsys, "verify", tmp_path / "o")
    assert "every claim holds" in out
    status, out, _ = run(capsys, "simulate", tmp_path / "o", "--starts", 50)
    assert "reached the attractor" in out


def test_overrides_are_saved(capsys, file, tmp_path):
    run(capsys, "solve", file(steps()), "--gamma", "1.25", "--out", tmp_path / "o")
    assert json.loads((tmp_path / "o" / "problem.json").read_text())["gamma"] == 1.25
    loaded = lm.Result.load(tmp_path / "o")
    assert loaded.gamma == 1.25
    np.testing.assert_allclose(loaded.value[1:], [1, 2.25, 1 + 1.25 + 1.25**2])
    assert loaded.controller([[0.6]]) == 1


def test_exit_statuses(capsys, file, tmp_path):
    assert run_json(capsys, "solve", file(steps()))[0] == 0
    status, report = run_json(capsys, "solve", file(steps(0.5, cost="u")))
    assert (status, report["status"]) == (1, "unverified")
    status, report = run_json(capsys, "solve", file({**steps(), "gama": 1}))
    assert (status, report["status"]) == (2, "bad_input")
    assert list(report) == KEYS
    assert "gama" in report["message"]
    status, report = run_json(capsys, "solve", file(doubling(3.0)), "--out", tmp_path / "r")
    assert (status, report["status"]) == (3, "not_stabilizable")
    assert report["cost"] is report["gap"] is report["lower_bound"] is report["contraction"] is None
    assert run(capsys, "verify", tmp_path / "r")[0] == 0
    avoided = steps(avoid={"boxes": [{"x": [0.5, 0.75]}]})
    status, report = run_json(capsys, "solve", file(avoided))
    assert status == 0
    status, report = run_json(capsys, "solve", file(avoided), "--require-all")
    assert (status, report["status"]) == (3, "not_stabilizable")
    status, report = run_json(
        capsys, "solve", file(standard_map(20)), "--max-iterations", "1", "--out", tmp_path / "u"
    )
    assert (status, report["status"]) == (4, "solver_failed")
    assert run(capsys, "verify", tmp_path / "u")[0] == 1
    assert lm.Result.load(tmp_path / "u").simulate(starts=100).reached > 0


@pytest.mark.parametrize("json_too", [False, True])
@pytest.mark.parametrize(
    "command",
    [["solve"], ["solve", "--proved", "0.9"], ["compare", "--backends", "policy-iteration,highs"]],
)
def test_no_time_at_all_is_said(capsys, file, command, json_too):
    name, *options = command
    more = ["--json"] if json_too else []
    status, out, err = run(
        capsys, name, file(standard_map(20)), *options, "--time-limit", "1e-9", *more
    )
    assert status in (1, 4)
    assert "internal error" not in out + err
    assert "time" in out + err


def test_function_results_keep_their_rows(tmp_path, capsys):
    from problems import made

    from lmdsl.systems import FunctionSystem

    own = made(steps()).replaced(system=FunctionSystem(next=lambda x, u: (x - 0.25 * u,)))
    lm.solve(own).save(tmp_path / "own")
    found = lm.verify(tmp_path / "own")
    assert found.holds
    assert "not re-evaluated" in found.notes[0]
    loaded = lm.Result.load(tmp_path / "own")
    assert loaded.controller([[0.3]]) == 1
    with pytest.raises(lm.BadInput, match="Python function"):
        loaded.simulate(starts=3)
    spoil_array(tmp_path / "own", "value", lambda a: a.__imul__(0.5))
    assert not lm.verify(tmp_path / "own").holds


def test_compare(capsys, file):
    status, found = run_json(
        capsys, "compare", file(standard_map(10)), "--backends", "policy-iteration,highs"
    )
    assert status == 0
    assert [list(r) for r in found["results"]] == [KEYS, KEYS]
    agreement = found["agreement"]
    assert agreement["cost"] < 1e-6
    assert agreement["controls"] == 1
    assert agreement["value"] < 1e-6
    status, found = run_json(capsys, "compare", file(doubling(3)), "--backends", "highs")
    assert status == 3
    assert found["agreement"] is None
    status, out, _ = run(capsys, "compare", file(standard_map(10)))
    assert status == 0
    for name in ("policy-iteration", "highs", "clarabel", "cvxpy", "agreement"):
        assert name in out


def test_listings_and_init(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_json(capsys, "systems")[1]["standard_map"]["parameters"] == {"K": 0.25}
    assert "standard_map" in run(capsys, "systems")[1]
    assert run_json(capsys, "backends")[1]["policy-iteration"]["available"]
    assert "highs" in run(capsys, "backends")[1]
    assert json.loads(run(capsys, "schema")[1])["title"] == "lmdsl problem file"
    assert run(capsys, "init", "standard_map")[0] == 0
    assert lm.load("standard_map.json").gamma == 1.02
    assert run(capsys, "init", "standard_map")[0] == 2  # not overwritten
    assert run(capsys, "init", "standard_map", "--out", "other.json")[0] == 0


def test_names_are_safe_for_terminals(capsys, file):
    data = steps(name="\x1b[31mred\x07\u202e \u00e9")
    status, out, _ = run(capsys, "solve", file(data))
    assert status == 0
    assert "\x1b" not in out
    assert "\x07" not in out
    assert "\u202e" not in out
    assert "\u00e9" in out


def test_as_a_process(tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}

    def call(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "lmdsl", *arguments],
            capture_output=True, text=True, env=environment, cwd=tmp_path, check=False,
        )  # fmt: skip

    (tmp_path / "p.json").write_text(json.dumps(steps(name="\u00e9")))
    done = call("solve", "p.json", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert call("--version").stdout.startswith("lmdsl ")
    assert call("solve", "q.json").returncode == 2


def test_an_internal_error_is_one_message(capsys, file, monkeypatch):
    import lmdsl.results.solving

    def explode(*_, **__):
        raise RuntimeError("boom\x1b[31m")

    monkeypatch.setattr(lmdsl.results.solving, "solve", explode)
    status, _, err = run(capsys, "solve", file(steps()))
    assert status == 4
    assert "internal error" in err
    assert "\x1b" not in err


def test_interrupt_is_one_message(capsys, file, monkeypatch):
    import lmdsl.results.solving

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(lmdsl.results.solving, "solve", interrupt)
    status, _, err = run(capsys, "solve", file(steps()))
    assert status == 130
    assert err == "lmdsl: interrupted\n"

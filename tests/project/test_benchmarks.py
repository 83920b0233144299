"""The benchmarks run, compare values first, and survive contestants of every kind. No times."""

import json
import subprocess
import sys

import numpy as np
import pytest
from contestants import FATES, ROOT

from benchmarks import rivals
from benchmarks.process import Failed, call


def run(*words):
    command = [sys.executable, "-m", "benchmarks", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmarks")
    done = run("--smoke", "--out", str(out))
    assert done.returncode == 0, done.stderr
    return json.loads((out / "results.json").read_text()), (out / "results.md").read_text()


@pytest.mark.long
def test_the_smoke_run_measures_everyone_who_is_installed(smoke):
    results, _ = smoke
    seen = set()
    for group in results["groups"]:
        for row in group["rows"]:
            seen.add(row["contestant"])
            if row["status"] == "ok":
                assert len(row["wall"]) == len(row["cpu"]) == 1
                assert row["median"] > 0
                assert row["ratio"] > 0
            else:
                assert row["status"].startswith(("not installed", "not supported"))
    assert seen == {one.name for one in rivals.ALL}
    assert {group["gamma"] for group in results["groups"]} == {1.02, 1.0, 0.99}


@pytest.mark.long
def test_the_values_of_all_contestants_agree(smoke):
    results, _ = smoke
    compared = 0
    for group in results["groups"]:
        assert group["status"] == "verified"
        for row in group["rows"]:
            if row["status"] == "ok" and "compile" not in row["contestant"]:
                assert row["error"] <= row["accuracy"] <= 1e-3
                compared += 1
    assert compared >= 3 * 3 + 8  # lmdsl and NumPy at three gammas, HiGHS and Clarabel at one


@pytest.mark.long
def test_the_stages_are_all_measured(smoke):
    results, _ = smoke
    (micro,) = results["micro"]
    assert not [row for row in micro["rows"] if "missing" in row]
    (pipeline,) = results["pipelines"]
    assert pipeline["status"] == "verified"
    assert pipeline["estimates"]
    assert pipeline["peak"] > 0


@pytest.mark.long
def test_the_report_says_what_ran_where(smoke):
    results, text = smoke
    about = results["about"]
    assert {"lmdsl", "numpy", "scipy", "numba", "highspy", "clarabel"} <= set(about["versions"])
    for fact in (about["date"], about["commit"], about["processor"], about["command"]):
        assert fact
        assert fact in text
    for group in results["groups"]:
        assert f"## {group['model']}, gamma {group['gamma']:g}" in text
        for row in group["rows"]:
            assert f"| {row['contestant']} |" in text


def test_bad_names_are_refused():
    for words in (("--models", "standard-map"), ("--models", "x-1"), ("--rivals", "nobody")):
        done = run(*words)
        assert done.returncode == 2
        assert words[1] in done.stderr


# Contestants that misbehave -------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", FATES)
def test_a_row_says_what_became_of_a_contestant(contest, name):
    row = contest[0][name]
    assert row.status == FATES[name]
    assert (row.median is None) == (row.status != "ok")
    assert (row.ratio is None) == (row.status != "ok")


@pytest.mark.long
def test_a_contest_notes_who_is_absent_and_logs_everyone(contest):
    rows, lines = contest
    assert rows["is not there"].status == "not installed"
    assert rows[rivals.OURS].ratio == 1
    assert len(lines) == len(rows)


@pytest.mark.long
def test_a_solver_that_prints_cannot_forge_an_answer(contest):
    assert min(contest[0]["prints"].wall) >= 0


@pytest.mark.long
def test_the_first_solve_of_a_slow_contestant_counts(contest):
    rows, _ = contest
    assert len(rows["is slow"].wall) == 1
    assert len(rows["behaves"].wall) == 2


@pytest.mark.long
def test_wrong_values_are_measured_against_the_certified_bounds(contest):
    rows, _ = contest
    for name in ("lies", "lies later"):
        assert rows[name].error == pytest.approx(1e-4, rel=1e-3)
    assert rows["returns nan"].error == rows["returns too few"].error == np.inf
    assert rows["behaves"].error == 0


def test_a_call_that_fails_says_how():
    with pytest.raises(Failed, match="No module named"):
        call("no_such:thing")
    with pytest.raises(Failed, match=r"^> 0\.1 s$"):
        call("time:sleep", 60, limit=0.1)
    assert call("math:hypot", 3, 4) == 5

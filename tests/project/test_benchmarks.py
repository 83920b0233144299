"""The benchmarks run, compare values first, and survive contestants of every kind. No times."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lmdsl as lm

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import measure, models, pipeline, report, rivals, targets  # noqa: E402
from benchmarks import run as running  # noqa: E402
from benchmarks.arrays import Arrays  # noqa: E402
from benchmarks.process import Failed, call  # noqa: E402
from benchmarks.rivals import Contestant  # noqa: E402


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


# Contestants that misbehave -----------------------------------------------------------------

FATES = {
    "behaves": "ok",
    "prints": "ok",
    "is slow": "ok",
    "lies": "wrong value",
    "lies later": "wrong value",
    "returns nan": "wrong value",
    "returns too few": "wrong value",
    "raises": "failed: ZeroDivisionError: by nothing",
    "cannot build": "failed: MemoryError: no room",
    "is unable": "not supported: NotImplementedError: not this form",
    "exits": "failed: exited with status 3",
    "is killed": "failed: killed, probably for want of memory",
    "hangs": "> 3 s",
    "hangs later": "> 3 s",
}


@pytest.fixture(scope="module")
def contest(tmp_path_factory):
    """The contest of all fake rivals, and the processes that are left after it."""
    folder = tmp_path_factory.mktemp("contest")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT / "tests/helpers"))
        facts = measure.prepared("standard-map-10", 1.02, folder, 100)
        fakes = [Contestant(name, "fake_rival", name) for name in FATES]
        gone = Contestant("is not there", "fake_rival", package="no_such_package_anywhere")
        ours = [one for one in rivals.ALL if one.name == rivals.OURS]
        rules = measure.Rules(repeats=2, limit=3.0, budget=0.5)
        lines = []
        rows = measure.contest(facts, [*ours, gone, *fakes], folder, rules, lines.append)
    return {row.contestant: row for row in rows}, lines


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


# Parts --------------------------------------------------------------------------------------


def arrays(lower, upper):
    """Cell 0 pays 1 and goes to cell 1 or the attractor; cell 1 pays 2 or 3 and is done."""
    return Arrays(
        "by hand", 0.5, "", np.array([0, 1, 3]), np.array([0, 0, 1]),
        np.array([0, 2, 3, 4]), np.array([1, 2, 2, 2]), np.array([0.25, 0.75, 1.0, 1.0]),
        np.array([1.0, 2.0, 3.0]), np.array(lower), np.array(upper),
    )  # fmt: skip


def test_the_error_is_the_relative_distance_to_the_bounds():
    model = arrays([1.0, 2.0], [1.25, 2.0])
    assert model.error(np.array([1.1, 2.0])) == 0
    assert model.error(np.array([1.5, 2.0])) == pytest.approx(0.2)
    assert model.error(np.array([1.1, 1.0])) == pytest.approx(0.5)
    assert model.error(np.array([1.1, np.inf])) == np.inf


def test_the_matrices_of_the_rivals_by_hand(tmp_path):
    arrays([1.25, 2.0], [1.25, 2.0]).save(tmp_path / "model.npz")
    model = Arrays.load(tmp_path / "model.npz")
    assert (model.name, model.gamma, model.n, model.K) == ("by hand", 0.5, 2, 3)
    np.testing.assert_array_equal(model.P.toarray(), [[0, 0.25], [0, 0], [0, 0]])
    np.testing.assert_array_equal(model.A.toarray(), [[1, 0, 0], [-0.125, 1, 1]])
    from benchmarks.rivals.value_iteration import Solver

    solver = Solver(model, "")
    solver.renew()
    solver.solve()
    np.testing.assert_allclose(solver.value(), [1.25, 2.0], rtol=1e-8)


def test_every_model_is_declared_and_can_be_asked_for():
    for name, model in models.MODELS.items():
        assert models.get(name).name == name == model.name
        assert model.family in models.MAKERS
    problem = models.get("slow-pendulum-200").make()
    assert problem.to_dict()["system"]["step"] == 0.01
    assert (
        models.get("standard-map-50").make().gamma
        == lm.load(ROOT / "examples/standard_map.json").gamma
    )


def test_the_random_model_can_be_certified_at_every_gamma_of_the_contests():
    model = models.get("random-100")
    for gamma in (1.0, 0.99):
        result = lm.solve(model.compiled(gamma))
        assert result.status == "verified"
        assert result.stabilizable_cells == 100


def test_the_report_is_written_whole_and_repeatedly(tmp_path):
    results = {
        "about": {
            "command": "c", "date": "d", "commit": "e", "processor": "p", "cores": 2,
            "memory": None, "system": "s", "load": None, "python": "3", "variables": {},
            "versions": {"lmdsl": "0"},
        },
        "rules": {"repeats": 1, "budget": 1.0, "limit": 1.0},
        "targets": [{"target": "a | b", "goal": "1 s", "measured": "2 s", "met": False}],
        "groups": [{"model": "m-1", "gamma": 1.0, "failed": "no value", "rows": []}],
        "micro": [{"model": "m-1", "failed": "> 1 s"}],
        "pipelines": [{"model": "m-1", "failed": "> 1 s"}],
    }  # fmt: skip
    for _ in range(2):
        report.write(tmp_path, results)
    assert sorted(os.listdir(tmp_path)) == ["results.json", "results.md"]
    text = (tmp_path / "results.md").read_text()
    assert "| a \\| b | 1 s | 2 s | **no** |" in text
    assert text.count("> 1 s") == 2
    assert json.loads((tmp_path / "results.json").read_text()) == results


def test_who_exceeds_its_limits_is_not_tried_on_a_larger_model(monkeypatch, tmp_path):
    held = []

    def contest(facts, contestants, *rest):
        held.append((facts["model"], [one.name for one in contestants]))
        fates = {"HiGHS IPX": "> 9 s", "IPOPT": "failed: killed, probably for want of memory"}
        return [measure.Row(one.name, fates.get(one.name, "ok")) for one in contestants]

    monkeypatch.setattr(running, "contest", contest)
    monkeypatch.setattr(running, "prepared", lambda name, *rest: {
        "model": name, "gamma": 1.02, "stabilizable": 1, "pairs": 1, "transitions": 1,
        "status": "verified", "gap": 0.0,
    })  # fmt: skip
    among = rivals.chosen(["IPX", "IPOPT"])
    a_run = running.Run(tmp_path, measure.Rules(limit=9), among, log=lambda text: None)
    for name in ("standard-map-50", "standard-map-100"):
        a_run.group(name, 1.02)
    a_run.group("standard-map-100", 1.02)
    a_run.group("random-100", 1.0)
    everyone = [one.name for one in among]
    fit = [name for name in everyone if name not in ("HiGHS IPX", "IPOPT")]
    assert held == [("standard-map-50", everyone), ("standard-map-100", fit),
                    ("random-100", everyone)]  # fmt: skip
    rows = {row["contestant"]: row for row in a_run.group("standard-map-100", 1.02)}
    assert rows["IPOPT"]["note"] == "not tried: exceeded its limits on standard-map-50"
    assert "not tried" in (tmp_path / "results.md").read_text()


class Canned:
    """Stands for a run: contestants take 10 times as long as lmdsl, which takes 1 µs a pair."""

    rules = measure.Rules(repeats=1)
    targets: list
    pairs = 1_000_000

    def __init__(self, broken=False):
        self.targets, self.broken = [], broken

    def log(self, text):
        pass

    def save(self):
        pass

    def among(self, *words):
        return rivals.chosen(list(words))

    def group(self, name, gamma, contestants):
        if self.broken:
            return []
        return [
            {"contestant": one.name, "ratio": 10.0, "median": 1.0, "status": "ok"}
            for one in contestants
        ]

    def stages(self, name):
        if self.broken:
            return {"model": name, "failed": "> 1 s"}
        whats = ("formula with NumPy, as written", "formula with NumPy, each sine once")
        rows = [{"what": what, "seconds": 1.0} for what in whats]
        return {"rows": [*rows, {"what": "compile", "seconds": 0.5},
                         {"what": "solve", "seconds": 1.0, "ratio": 41.0}]}  # fmt: skip

    def bracket(self, name, width):
        return {"failed": "> 1 s"} if self.broken else self.pipeline(name)

    def pipeline(self, name, gamma=None, repeats=1, processes=1):
        if self.broken:
            return {"model": name, "failed": "> 1 s"}
        times = {stage: [1.0, 1.0] for stage in ("compile", "solve", "verify")}
        return {
            "pairs": self.pairs, "status": "verified", "base": 10**9, "peak": 2 * 10**9,
            "estimates": [1, 8 * 10**8], "seconds": {**times, "total": [2.0, 2.0]},
        }  # fmt: skip


def verdicts(monkeypatch, broken, seconds):
    monkeypatch.setattr(targets, "_command", lambda cache: seconds)
    canned = Canned(broken)
    targets.measure(canned, 3162)
    return {one["target"]: one["met"] for one in canned.targets}


def test_targets_are_judged(monkeypatch):
    found = verdicts(monkeypatch, False, 2.0)
    command = "lmdsl solve examples/standard_map.json from process start"
    assert found == {
        "times faster than Storm's best sound method, standard-map-200": False,
        "times faster than QuantEcon modified policy iteration, standard-map-200": True,
        "times faster than HiGHS IPX without crossover, standard-map-100": False,
        **{
            f"compile, of the time of the formula {what}, standard-map-{cells}": True
            for what in ("as written", "each sine once")
            for cells in (200, 1000)
        },
        "solve, of one reading of the compact rows, standard-map-200": False,
        "solve, of one reading of the compact rows, standard-map-1000": False,
        "compile, solve and verify, standard-map-1000": True,
        "memory estimate of the measured peak, standard-map-1000": True,
        "compile, solve and verify, standard-map-3162": True,
        "memory estimate of the measured peak, standard-map-3162": True,
        "cost per pair, largest over least, standard map of 1e5 to 2e8 pairs": True,
        "compile, solve and verify in a warm process, standard-map-50": False,
        f"{command}, kernels cached": False,
        f"{command}, first ever": True,
        "slow-pendulum-200, solve and verify per pair over standard-map-200": True,
        **{
            f"{what}, of solve and verify at gamma = 1, {name}": True
            for what in ("gamma = 5 refused", "gamma_bar to 1 %")
            for name in ("standard-map-200", "slow-pendulum-200")
        },
        "compile, solve and verify, boost-converter-800": True,
    }


def test_the_bracket_of_gamma_is_measured():
    found = pipeline.bracket("standard-map-8", 0.01, 2)
    low, high = found["gamma_bar"]
    assert 1 < low <= high <= 1.01 * low
    assert len(found["seconds"]["total"]) == 2


def test_the_boost_converter_is_absorbed_by_chance_alone():
    lp = models.get("boost-converter-60").compiled()
    result = lm.solve(lp)
    assert result.status == "verified", result.message
    assert 0 < result.cost <= 100 * (1 + 1e-6)
    absorbed = 1 - lp.rows.matrix().sum(axis=1)
    np.testing.assert_allclose(absorbed, 0.01, rtol=1e-9)


def test_a_target_that_could_not_be_measured_is_not_met(monkeypatch):
    assert True not in verdicts(monkeypatch, True, None).values()

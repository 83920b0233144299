"""The parts of the benchmarks: models, clocks, tables, reports."""

import json
import os

import numpy as np
import pytest
from contestants import ROOT

import lmdsl as lm
from benchmarks import internals, measure, models, pipeline, report, rivals, targets
from benchmarks import run as running
from benchmarks.arrays import Arrays


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


def test_the_single_steps_of_the_micro_benchmarks_run():
    lp = models.get("standard-map-8").compiled()
    result = lm.solve(lp)
    V = result.value[lp.cells]
    policy = lp.pair_pointer[:-1] + np.array(
        [
            np.flatnonzero(lp.control[a:b] == result.control_index[cell])[0]
            for a, b, cell in zip(lp.pair_pointer, lp.pair_pointer[1:], lp.cells, strict=False)
        ]
    )
    np.testing.assert_allclose(internals.evaluation(lp, policy)(), V, rtol=1e-9)
    internals.evaluation_sweep(lp, policy)()
    assert (internals.improvement_sweep(lp, V)().value <= V * (1 + 1e-9)).all()
    assert internals.certificate(lp, policy, V)().certificate.verified

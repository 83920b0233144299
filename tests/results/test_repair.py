"""Repair: pairs that lose runs of the true map are dropped, saved, and checked anew."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from problems import made
from saved_results import put, refused

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline
from lmdsl.proof import proving
from lmdsl.results.directory import reading
from lmdsl.results.directory.repair.repairing import _advice
from lmdsl.results.directory.repair.rounds import LAST, NONE, SOON, Round, Rounds

pytestmark = pytest.mark.long  # in other versions it would find nothing else


def line(formula, **more):
    """x+ = formula on [0, 1], 4 cells, A = the first; u = 0 is cheaper than u = 1."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": formula}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 4}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0, 1]}},
        "stage_cost": "1 + u",
        "sampling": {"kind": "grid", "per_axis": 1},
        **more,
    }


# In a part of the last cell that no sample sees the cheaper control loses runs, or keeps them.
LOSES = "where(abs(x - 0.95) < 0.03, where(u < 0.5, 2, x - 0.25), x - 0.25)"
KEEPS = "where(abs(x - 0.95) < 0.03, where(u < 0.5, 0.5*x + 0.475, x - 0.25), x - 0.25)"
HOPELESS = "where(abs(x - 0.95) < 0.03, 2, x - 0.25)"  # by every control


@pytest.fixture(scope="module")
def repaired():
    return lm.solve(made(line(LOSES)), proved=0.999)


@pytest.fixture
def saved(repaired, tmp_path):
    repaired.save(tmp_path / "out")
    return tmp_path / "out"


@pytest.mark.parametrize("formula", [LOSES, KEEPS])
def test_the_pair_at_fault_is_dropped_and_no_other(formula):
    declared, found = lm.solve(made(line(formula))), lm.solve(made(line(formula)), proved=0.999)
    assert declared.control_index.tolist() == [-1, 0, 0, 0]
    assert found.dropped.tolist() == [[3, 0]]
    assert found.control_index.tolist() == [-1, 0, 0, 1]
    assert found.verified
    assert found.exit_status == 0
    assert found.proved.reached
    assert (found.proof.lost, found.proof.stays) == (0, 0)
    # 1, 2, 3 steps at a cost of 1 each, the first from the last cell at 2.
    assert declared.cost == pytest.approx(2)
    assert found.cost == pytest.approx((1 + 2 + 4) / 3)
    assert found.lower_bound == pytest.approx(found.cost)
    assert found.proved.lower_bound == pytest.approx(2)
    assert "declared" in found.message


def test_what_no_control_repairs_is_missed_and_said():
    """The last cell is given up: the share counts the first C, 3 cells."""
    found = lm.solve(made(line(HOPELESS)), proved=0.999)
    assert found.exit_status == 1
    assert found.verified
    assert found.proved.cells == 3
    assert found.proved.arrives < 0.999
    assert found.proof.lost > 0 or found.proved.arrives == pytest.approx(2 / 3, abs=1e-3)
    assert "missed" in found.message
    lower = lm.solve(made(line(HOPELESS)), proved=0.6)  # what may be given up is
    assert lower.exit_status == 0
    assert lower.proof.lost == 0
    assert lower.stabilizable_cells == 2
    assert lower.proved.arrives == pytest.approx(2 / 3, abs=1e-3)


def test_which_part_can_be_kept_without_a_loss_at_most_is_said_and_checked(tmp_path):
    found = lm.solve(made(line(HOPELESS)), proved=0.999)
    assert found.proved.without_loss == pytest.approx(2 / 3)
    assert "66.6667 % of the first C" in found.message
    found.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds
    path = tmp_path / "out" / "certificate.json"
    stored = json.loads(path.read_text())
    for without_loss, holds in ((0.6, False), (0.7, True), (None, True)):
        stored["proved"]["without_loss"] = without_loss
        path.write_bytes(reading.text(stored))
        assert lm.verify(tmp_path / "out").holds == holds
    del stored["proved"]["without_loss"]  # as it was before
    path.write_bytes(reading.text(stored))
    assert lm.verify(tmp_path / "out").holds


def test_where_some_loss_is_unavoidable_the_control_that_loses_less_is_taken():
    steep = "where(x > 0.9 + 0.05*u, 2, x - 0.25)"  # of the last cell 40 % are lost, or 20 %
    found = lm.solve(made(line(steep)), proved=0.9)
    assert found.proved.without_loss == pytest.approx(2 / 3)
    assert found.dropped.tolist() == [[3, 0]]
    assert found.control_index.tolist() == [-1, 0, 0, 1]
    assert found.proof.lost == pytest.approx(0.2 / 3, abs=1e-3)
    assert found.proved.reached
    given_up = lm.solve(made(line(steep)), proved=0.6)
    assert (given_up.proof.lost, given_up.stabilizable_cells) == (0, 2)


def plane(seed):
    """A random map of a square, sampled so sparsely that controllers lose runs."""
    a, b, c = np.random.default_rng(seed).uniform(0.6, 1.0, size=3).round(3).tolist()
    return {
        "format": "lmdsl/1",
        "system": {
            "kind": "map",
            "next": {"x": f"x + {a}*y + 0.1*u", "y": f"y - {b}*sin({c}*x) + 0.4*u"},
        },
        "state_box": {name: {"low": -1, "high": 1, "cells": 16} for name in "xy"},
        "attractor": {"boxes": [{"x": [-0.375, 0.375], "y": [-0.375, 0.375]}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
        "stage_cost": "1 + 0.1*u**2",
        "sampling": {"kind": "grid", "per_axis": 1},
    }  # fmt: skip


def test_runs_of_the_true_map_are_lost_before_repair_and_not_after(monkeypatch):
    monkeypatch.setattr(proving, "FEW", 0)  # bounds of the cost are of no interest here
    monkeypatch.setattr(proving, "GROWN", 1)
    problem = made(plane(0))
    declared, found = lm.solve(problem), lm.solve(problem, proved=0.2)
    assert declared.prove(0.9).lost > 0.01
    assert (found.proof.lost, found.proof.stays) == (0, 0)
    assert 0.2 <= found.proved.arrives <= found.proved.without_loss
    runs = found.simulate(100_000, 200, seed=0, as_compiled=True)
    undecided = found.proof.undecided
    assert runs.lost <= 1e5 * undecided + 5 * np.sqrt(1e5 * undecided)
    assert declared.simulate(1000, 200, seed=0, as_compiled=True).lost > 0
    assert found.stabilizable_cells / declared.stabilizable_cells <= found.proved.without_loss


def test_nothing_to_repair_drops_nothing(tmp_path):
    found = lm.solve(made(line("x - 0.25")), proved=0.999)
    assert found.dropped is None
    assert found.proved.dropped == 0
    found.save(tmp_path / "out")
    assert not (tmp_path / "out" / "dropped.npz").exists()
    assert lm.verify(tmp_path / "out").holds


def test_the_law_of_sure_arrival_is_the_last_resort(monkeypatch):
    """u = 0 may leave the last cell for any other or stay: enclosed, it is admissible."""
    problem = made(line(KEEPS.replace("x - 0.25", "0.9*x - 0.21"), successors="enclosed"))
    monkeypatch.setattr(Rounds, "guilty", lambda *_: NONE)
    monkeypatch.setattr(Rounds, "undecided", lambda *_: NONE)
    declared, found = lm.solve(problem), lm.solve(problem, proved=0.999)
    assert declared.prove().stays > 0
    assert found.proved.reached
    assert found.sure_cells == 3
    assert found.control_index[3] == 1


@pytest.mark.parametrize(("limit", "part"), [(60, SOON), (None, LAST)])
def test_other_laws_leave_time_for_that_of_sure_arrival(limit, part, monkeypatch):
    seen, best = [], Rounds.best
    monkeypatch.setattr(Rounds, "best", lambda self: (seen.append(self.part), best(self))[1])
    lm.solve(made(line("0.9*x - 0.21", successors="enclosed")), proved=0.9, time_limit=limit)
    lm.solve(made(line("x - 0.25")), proved=0.9, time_limit=limit)
    assert seen == [part, LAST]


def test_that_the_time_ran_out_is_said():
    first, deadline = lm.solve(made(line(LOSES))), Deadline(60.0)

    def again(_):
        deadline.cancel()
        return replace(first, lp=None)

    rounds = Rounds(first, again, 0.999, deadline, None)
    assert rounds.solved(np.array([[3, 0]]), None) is None
    assert rounds.why == "the time ran out while it was solved without more pairs"


def test_a_proof_that_the_limit_ended_is_said_to_be_the_reason(repaired):
    rounds = Rounds(repaired, lambda _: repaired, 1.0, Deadline(), None)
    for stopped, why in ((True, "the time limit ended the proof"), (False, rounds.why)):
        proof = replace(repaired.proof, stopped=stopped)
        told = _advice(rounds, Round(repaired, proof, proof.arrives, True))
        assert told.startswith(why)


def test_a_model_without_pairs_is_that_of_a_problem_without_them():
    """Random models: the rows left out by hand, where every state keeps one."""
    random = np.random.default_rng(5)
    for _ in range(30):
        S, A = 7, 3
        P = random.dirichlet(np.full(S, 0.2), size=(S, A)).round(1)
        P[..., 0] += 1 - P.sum(axis=-1)
        P = np.where(P < 0, 0, P)
        P /= P.sum(axis=-1, keepdims=True)
        s, a = np.divmod(np.arange(S * A), A)
        left = (s == 0) | (random.random(S * A) < 0.6)
        left[np.arange(S) * A + random.integers(A, size=S)] = True
        cost = random.random(S * A)
        whole = lm.from_matrices((P[s, a], s, a), cost, targets=[0], layout="pairs")
        fewer = lm.from_matrices(
            (P[s, a][left], s[left], a[left]), cost[left], targets=[0], layout="pairs"
        )
        pairs = np.stack([s, a], axis=-1)[~left]
        one, other = lm.compile(whole, dropped=pairs), lm.compile(fewer)
        assert np.array_equal(one.cell_status, other.cell_status)
        assert np.array_equal(one.control, other.control)
        assert np.array_equal(one.cost, other.cost)
        assert (one.digest == lm.compile(whole).digest) == (not len(pairs))
        if one.n:
            V, W = lm.solve(one).value, lm.solve(other).value
            assert np.allclose(V[one.cells], W[one.cells], rtol=1e-9)


@pytest.mark.parametrize("pairs", [[[9, 0]], [[1, 5]], [[-1, 0]], [[0, 0]], [1, 2], [[1.5, 0]]])
def test_lists_that_are_no_pairs_are_refused(pairs):
    with pytest.raises(lm.BadInput, match="dropped"):
        lm.compile(made(line(LOSES)), dropped=pairs)


def test_a_directory_keeps_what_was_dropped_and_is_checked(repaired, saved):
    assert {"dropped.npz", "proof.npz"} <= {path.name for path in saved.iterdir()}
    assert lm.verify(saved).holds
    assert lm.verify(saved, exact=True).holds
    loaded = lm.Result.load(saved)
    assert np.array_equal(loaded.dropped, repaired.dropped)
    assert loaded.proved == repaired.proved
    stored = json.loads((saved / "certificate.json").read_text())
    assert stored["proved"]["arrives"] == repaired.proved.arrives


def test_a_result_saved_without_its_proof_says_no_share_until_it_is_proved(saved, tmp_path):
    lm.Result.load(saved).save(tmp_path / "kept")
    assert lm.Result.load(tmp_path / "kept").proved.reached
    replace(lm.Result.load(saved), proof=None).save(tmp_path / "again")
    assert lm.Result.load(tmp_path / "again").proved.arrives is None
    assert lm.verify(tmp_path / "again").holds
    assert main(["prove", str(tmp_path / "again")]) == 0
    assert lm.Result.load(tmp_path / "again").proved.reached
    assert lm.verify(tmp_path / "again").holds


def spoiled(saved, **changes):
    """Change dropped.npz, its digest right."""
    path = saved / "dropped.npz"
    with np.load(path) as held:
        found = {name: held[name] for name in held.files}
    put(saved, dropped={**found, **changes})


@pytest.mark.parametrize(
    "changes",
    [
        {"cell": np.array([2])},
        {"control": np.array([1], dtype=np.int32)},
        {"control": np.array([7], dtype=np.int32)},
        {"cell": np.array([2, 3]), "control": np.array([0, 0], dtype=np.int32)},
        {"cell": np.zeros(0, dtype=np.int64), "control": np.zeros(0, dtype=np.int32)},
        {"lower": np.array([0.0, 2.0, 2.0, 3.0])},
        {"lower": np.full(4, np.nan)},
        {"lower": np.zeros(4)},
    ],
)
def test_a_spoiled_list_is_refused(saved, changes):
    spoiled(saved, **changes)
    assert refused(saved)


@pytest.mark.parametrize(
    "changes",
    [
        {"arrives": 1.0},
        {"arrives": None},
        {"dropped": 0},
        {"dropped": 2},
        {"dropped": 10**12},
        {"cells": 2},
        {"cells": 0},
        {"lower_bound": 2.1},
        {"sha256": ""},
        {"without_loss": 0.9},
        {"without_loss": -1.0},
        {"without_loss": "all"},
        None,
    ],
)
def test_a_spoiled_report_is_refused(saved, changes):
    path = saved / "certificate.json"
    stored = json.loads(path.read_text())
    stored["proved"] = None if changes is None else {**stored["proved"], **changes}
    path.write_bytes(reading.text(stored))
    assert refused(saved)


def test_the_command(tmp_path, capsys):
    path = tmp_path / "line.json"
    path.write_text(json.dumps(line(HOPELESS)))
    out = str(tmp_path / "out")
    assert main(["solve", str(path), "--proved", "0.95", "--json", "--out", out]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["status"] == "verified"
    assert report["proved"]["target"] == 0.95
    assert {"target", "arrives", "dropped"} <= report["proved"].keys()
    assert lm.verify(out).holds
    assert main(["solve", str(path), "--json", "--no-simulate"]) == 0
    assert json.loads(capsys.readouterr().out)["proved"] is None


@pytest.mark.parametrize("target", [0, 1.5, float("nan"), "much"])
def test_no_share_is_bad_input(target):
    with pytest.raises(lm.BadInput, match="proved"):
        lm.solve(made(line(LOSES)), proved=target)


def test_what_cannot_be_enclosed_is_bad_input_before_the_work():
    model = lm.from_matrices(np.array([[[1.0, 0], [1, 0]]]), np.ones((2, 1)), targets=[0])
    with pytest.raises(lm.BadInput, match="proved"):
        lm.solve(model, proved=0.9)
    with pytest.raises(lm.BadInput, match="proved"):
        lm.solve(made(line(LOSES)), proved=0.9, restrict_to_gamma=True)

"""The goals over ranks: by hand from reports, and measured where an MPI is."""

import pytest
from launching import needs_mpi

from benchmarks import ranks, rivals
from benchmarks.measure import Rules
from benchmarks.run import Run


def report(cells, cpu, wall, sent, calls, peak):
    """What a rank that takes the same in every stage says."""
    stage = {"cpu": cpu, "wall": wall, "sent": sent, "calls": calls}
    stages = dict.fromkeys(("compile", "solve", "verify"), stage)
    return {"cells": cells, "status": "verified", "peak": peak, "stages": stages}


def test_the_goals_by_hand():
    one = [[report(10, 2.0, 2.0, 0, 0, 100)], [report(10, 1.0, 1.0, 0, 0, 90)]]
    many = [[report(6, 0.5, 0.6, 1000, 100, 50), report(4, 0.5, 0.7, 200, 100, 40)]]
    found = {row["target"].removeprefix("x: "): row for row in ranks.rows("x", 2, one, many)}
    assert found["same status and cells"]["met"]
    assert found["memory of a rank / one process"]["measured"] == "0.556"
    assert found["processor time of solve / one process"]["measured"] == "1"
    assert found["time of compile / one process"] == {
        "target": "x: time of compile / one process", "goal": "at most 0.6", "measured": "0.7",
        "met": False,
    }  # fmt: skip
    assert found["bytes sent an own cell"]["measured"] == "360 (the most of a rank 500)"
    assert not found["bytes sent an own cell"]["met"]
    assert found["collective calls"]["measured"] == "300"
    assert len([*ranks.rows("x", 4, one, many)]) == 4


def test_other_cells_are_seen():
    one, many = [[report(10, 1, 1, 0, 0, 1)]], [[report(4, 1, 1, 0, 0, 1)] * 2]
    assert not next(ranks.rows("x", 2, one, many))["met"]


def test_where_no_mpi_is_it_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(ranks, "_missing", lambda: "no mpiexec is found")
    run = Run(tmp_path, Rules(), rivals.chosen(["lmdsl"]), log=lambda text: None)
    ranks.measure(run, (50,), (2,), False)
    assert [row["measured"] for row in run.targets] == ["skipped: no mpiexec is found"]


@pytest.mark.long
@needs_mpi
def test_ranks_are_measured_beside_one_process(tmp_path):
    run = Run(tmp_path, Rules(1), rivals.chosen(["lmdsl"]), log=lambda text: None)
    ranks.measure(run, (40,), (2,), True)
    targets = {row["target"]: row["met"] for row in run.targets}
    assert targets["standard map, 40 x 40, 2 ranks: same status and cells"]
    assert len(run.targets) == 13  # with what two processes side by side take from each other
    assert "collective calls" in (tmp_path / "results.md").read_text()

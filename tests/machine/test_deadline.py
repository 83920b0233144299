"""Time limits and interrupts, by what they end; none of these tests reads a clock."""

from __future__ import annotations

import json
import threading
import time

import numpy as np
import pytest
from endless import Asked, checked, local, sines
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.threads import in_order
from lmdsl.model.assembly.estimates import SHORT
from lmdsl.model.lp import compile
from lmdsl.optimize import witness
from lmdsl.results import solving

FOR_EVER = sines(points=10**5, cells=10_000)  # 4e14 sines, 4 GB of paths


@pytest.mark.parametrize("limit", [0, -1.0, float("nan"), "5", True, [1]])
def test_a_limit_is_a_positive_number(limit):
    problem = made(steps())
    for call in (lm.solve, lm.compare, lambda p, time_limit: lm.compile(p, None, time_limit)):
        with pytest.raises(lm.BadInput, match="time_limit"):
            call(problem, time_limit=limit)


def test_a_deadline_counts_down():
    assert Deadline().left is None
    assert not Deadline()()
    assert 0 < Deadline(1e6).left <= 1e6
    late = Deadline(1e-9)
    while not late():
        pass
    assert late.left == 1e-9  # what a solver is given is positive
    assert Deadline.of(late) is late
    with pytest.raises(TimeLimitReached, match=r"time limit reached while knitting; raise the lim"):
        late.raise_if_over("knitting")
    interrupted = Deadline()
    interrupted.cancel()
    assert interrupted()


def test_compiling_for_ever_is_ended():
    problem = made(FOR_EVER)
    with pytest.raises(TimeLimitReached, match="while compiling"):
        lm.compile(problem, time_limit=1e-9)
    result = lm.solve(problem, time_limit=1e-9)
    assert (result.status, result.exit_status, result.solver_status) == (
        "solver_failed", 4, "time limit",
    )  # fmt: skip
    assert result.message.startswith("time limit reached while compiling")
    assert result.cost is result.lower_bound is result.gap is result.pairs is None
    assert result.cells == 10_000
    assert (result.control_index == -1).all()
    assert not result.verified
    with pytest.raises(lm.BadInput, match="no model to save"):
        result.save("nowhere")
    compared = lm.compare(problem, ["policy-iteration", "highs"], time_limit=1e-9)
    assert [r.backend for r in compared.results] == ["policy-iteration", "highs"]
    assert compared.agreement is None
    assert compared.exit_status == 4
    json.dumps([result.to_dict(), compared.to_dict()], allow_nan=False)


def test_the_command_says_so(tmp_path, capsys):
    (tmp_path / "problem.json").write_text(json.dumps(FOR_EVER))
    out = tmp_path / "out"
    arguments = [str(tmp_path / "problem.json"), "--time-limit", "1e-9"]
    assert main(["solve", *arguments, "--out", str(out), "--json"]) == 4
    report = json.loads(capsys.readouterr().out)
    assert report["status"] == "solver_failed"
    assert "while compiling" in report["message"]
    assert not out.exists()
    assert main(["solve", *arguments]) == 4
    assert "while compiling" in capsys.readouterr().out
    assert main(["compare", *arguments, "--json"]) == 4
    assert len(json.loads(capsys.readouterr().out)["results"]) == 4


@pytest.mark.long
@pytest.mark.parametrize("threads", [1, 2])
def test_it_ends_within_a_block(monkeypatch, threads):
    monkeypatch.setattr("lmdsl.machine.threads.count", lambda: threads)
    deadline = Asked(200)  # a block of this problem asks 800,000 times
    with pytest.raises(TimeLimitReached):
        compile(made(sines(points=10**6)), None, deadline)
    assert deadline.count < 200 + 2 * threads + 2


def test_what_compiles_in_a_moment_is_compiled(monkeypatch):
    lp = lm.compile(made(standard_map(20)), time_limit=1e-9)
    assert lp.digest == lm.compile(made(standard_map(20))).digest
    monkeypatch.setattr("lmdsl.model.assembly.estimates.SHORT", 0)
    with pytest.raises(TimeLimitReached):
        lm.compile(made(standard_map(20)), time_limit=1e-9)
    assert SHORT > 0


def test_a_python_function_is_no_moment():
    problem = made({**steps(), "system": lm.systems.FunctionSystem(next=lambda x, u: [x - u / 4])})
    with pytest.raises(TimeLimitReached):
        lm.compile(problem, time_limit=1e-9)
    assert lm.solve(problem, time_limit=1e6).verified


def test_an_interrupt_ends_the_threads_that_help(monkeypatch):
    monkeypatch.setattr("lmdsl.machine.threads.count", lambda: 2)
    monkeypatch.setattr("lmdsl.model.assembly.estimates.SHORT", 0)
    deadline = Deadline()

    def interrupt(stage, done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compile(made(standard_map(50)), interrupt, deadline)
    assert deadline()


def test_an_interrupt_does_not_wait_for_the_end_of_a_long_part(monkeypatch):
    monkeypatch.setattr("lmdsl.machine.threads.count", lambda: 2)
    deadline, begun = Deadline(), threading.Event()

    def work(part):
        if threading.current_thread() is threading.main_thread():
            begun.wait()
            raise KeyboardInterrupt
        begun.set()
        for _ in range(10_000):
            if deadline():
                return "ended"
            time.sleep(0.001)
        return deadline.cancel()  # for the test to end

    cancelled = []

    def cancel():
        cancelled.append(deadline())
        deadline.cancel()

    with pytest.raises(KeyboardInterrupt):
        list(in_order(work, range(100), cancel))
    assert cancelled == [False]


def test_the_restricted_solve_gets_what_is_left(monkeypatch):
    given = []
    found = solving.first_policy.stabilizing

    def noted(lp, stop):
        given.append(stop)
        return found(lp, stop)

    monkeypatch.setattr(solving.first_policy, "stabilizing", noted)
    # Cell 0 of the first half is left half the time; the second half knows no such corner.
    data = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "where(x < 2, 2*x - where(x<1, 0, 2), x + 1)"}},
        "state_box": {"x": {"low": 0, "high": 4, "cells": 4}},
        "attractor": {"cells": [[3]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 4},
    }
    data["system"]["next"]["x"] = "where(x < 1, where(x < 0.5, x, 3.5), x + 1)"
    result = lm.solve(made({**data, "gamma": 3.0}), restrict_to_gamma=True, time_limit=1e6)
    assert result.status == "verified"
    assert result.beyond_gamma is not None
    assert len(given) == 2
    assert given[0] is given[1]


def test_verifying_ends_too_and_claims_no_more_than_it_proved(monkeypatch):
    lp = lm.compile(made(standard_map(20)))
    pair = lp.tree[1]
    whole = witness.certify(lp, pair, 1e-6)
    assert whole.certificate.stabilizing
    for n in (1, 2, 5, 20):
        cut = witness.certify(lp, pair, 1e-6, time_up=Asked(n))
        assert not cut.certificate.verified
        np.testing.assert_array_equal(cut.witness.policy, pair)
        for name in ("stabilizing", "upper_bound", "lower_bound", "measure"):
            assert getattr(cut.certificate, name) <= getattr(whole.certificate, name)


@pytest.mark.long
def test_the_local_check_ends_with_what_it_knows():
    problem = local(nodes=2, substeps=1)
    whole = Asked()
    found = checked(problem, whole)
    assert found.samples == found.kept == 10_000
    assert found.proved > 0
    for part in (0.2, 0.5, 0.9, 0.99):
        cut = Asked(int(part * whole.count))
        less = checked(problem, cut)
        assert cut.count < part * whole.count + 10
        assert less.cells == found.cells
        assert less.proved <= found.proved
        assert less.kept == less.samples <= found.samples
    assert (less.samples, less.proved) > (0, 0)
    late = checked(problem, Asked(1))
    assert (late.samples, late.kept, late.proved) == (0, 0, 0)
    assert "no attractor cell is proved to be kept" in late.sentence()
    assert "0 of 0 random" in late.sentence()
    assert f"{found.proved} of {found.cells} attractor cells are proved" in found.sentence()


@pytest.mark.long
def test_the_local_check_takes_fewer_samples_where_they_are_dear():
    few = checked(local(nodes=50, substeps=100))
    assert 10 <= few.kept == few.samples < 10_000
    assert checked(local(nodes=50, substeps=100), samples=37).samples == 37


@pytest.mark.long
def test_a_directory_with_another_number_of_samples_is_verified(tmp_path):
    problem = local(cells=8, substeps=1)
    lm.solve(problem).save(tmp_path / "out")
    file = tmp_path / "out" / "certificate.json"
    data = json.loads(file.read_text())
    data["local_controller"] |= {"samples": 700, "kept": 700}
    file.write_text(json.dumps(data))
    assert lm.verify(tmp_path / "out").holds
    for false in ({"samples": 10**9, "kept": 10**9}, {"samples": 700, "kept": 701}):
        data["local_controller"] |= false
        file.write_text(json.dumps(data))
        assert not lm.verify(tmp_path / "out").holds

"""Kill at any moment, Ctrl-C, limits, and the same bytes from run to run and thread to thread."""

from __future__ import annotations

import itertools
import json
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import interrupted_saves
import numpy as np
import pytest
from models import mdp
from problems import made, standard_map

import lmdsl as lm
from lmdsl.machine import deadline
from lmdsl.optimize.feasibility import first_policy, gamma_bar, stopping
from lmdsl.optimize.linear import classes
from lmdsl.optimize.policies import evaluation
from lmdsl.results.directory import writing

HERE = Path(__file__).parents[1] / "helpers"
posix = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and signals")


def killing(*arguments):
    program = str(HERE / "interrupted_saves.py")
    done = subprocess.run(  # Python 3.12 deprecates forking among threads: BLAS keeps idle ones
        [sys.executable, "-W", "ignore::DeprecationWarning", program, *map(str, arguments)],
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@posix
@pytest.mark.long
def test_killed_at_random_moments(tmp_path):
    found = killing("random", tmp_path, 200, 0)
    print(found)
    assert sum(found.get(name, 0) for name in ("old", "new", "none")) == 200
    assert found["old"] > 0  # kills did fall into saves
    assert found["left behind"] > 0
    assert found["saves finished"] > 0


@posix
@pytest.mark.long
@pytest.mark.parametrize("new", [0, 1])
def test_killed_at_every_line(tmp_path, new):
    """There is the old result or the new one, whole, also between any two renames."""
    found = killing("lines", tmp_path, new)
    print(found)
    assert found["old"] > 30
    assert found["new"] >= 1
    assert found["left behind"] > 5


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # from the tracing
def test_interrupted_at_every_line_of_a_save(tmp_path, monkeypatch):
    """Ctrl-C during a save never loses the directory: it is the old one or the new one."""
    monkeypatch.setattr(writing, "PATIENCE", 0.0)  # a lock may stay until the process ends
    monkeypatch.setattr(os, "fsync", lambda _: None)
    results = interrupted_saves.solved()
    target = tmp_path / "out"

    def interrupt():
        raise KeyboardInterrupt

    tracer, interruptions, left = sys.gettrace(), 0, 0
    for line in itertools.count(1):
        results[0].save(target)
        interrupted_saves.at_line(line, interrupt)
        try:
            results[1].save(target)
        except KeyboardInterrupt:
            interruptions += 1
        else:
            break
        finally:
            sys.settrace(tracer)
        assert interrupted_saves.gamma_held(target, results) in (1.0, 1.01)
        left += bool(interrupted_saves.leftovers(target))
    print(interruptions, left)
    assert interruptions > 30
    assert left <= 20  # an interrupted clean-up, or files that the certificate needs
    assert interrupted_saves.leftovers(target) == []


# Ctrl-C -------------------------------------------------------------------------------------


def start(folder, data, **streams):
    (folder / "problem.json").write_text(json.dumps(data))
    return subprocess.Popen(
        [sys.executable, "-m", "lmdsl", "solve", "problem.json", "--out", "out"],
        cwd=folder, stdout=subprocess.PIPE, **streams,
    )  # fmt: skip


SAYS_WHEN = """
import os, sys
from lmdsl.cli import output
from lmdsl.__main__ import run
told = int(sys.argv.pop(1))
output.ProgressLine.__call__ = lambda *_: os.write(told, b".")
sys.exit(run())
"""


@posix
def test_ctrl_c(tmp_path):
    (tmp_path / "problem.json").write_text(json.dumps(standard_map(700)))
    hear, tell = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", SAYS_WHEN, str(tell), "solve", "problem.json", "--out", "out"],
        cwd=tmp_path, pass_fds=[tell], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    os.close(tell)
    assert os.read(hear, 1) == b"."
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=600)
    os.close(hear)
    assert process.returncode == 130
    assert err == b"lmdsl: interrupted\n"
    assert out == b""
    assert [path.name for path in tmp_path.iterdir()] == ["problem.json"]


@posix
@pytest.mark.parametrize(
    "stage", ["transitions", pytest.param("solve", marks=pytest.mark.long),
              pytest.param("verify", marks=pytest.mark.long)],
)  # fmt: skip
def test_ctrl_c_on_a_terminal(tmp_path, stage):
    ours, theirs = os.openpty()
    process = start(tmp_path, standard_map(700), stderr=theirs)
    os.close(theirs)
    screen, sent, deadline = b"", False, time.monotonic() + 600
    while time.monotonic() < deadline:
        if not select.select([ours], [], [], 1)[0]:
            continue
        try:
            said = os.read(ours, 1000)
        except OSError:  # closed
            break
        if not said:
            break
        screen += said
        if not sent and stage.encode() in screen:
            process.send_signal(signal.SIGINT)
            sent = True
    os.close(ours)
    out = process.communicate(timeout=600)[0]
    assert sent
    assert out == b""
    assert process.returncode == 130
    assert screen.endswith(b"\r\x1b[Klmdsl: interrupted\r\n")
    assert screen.count(b"\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["problem.json"]


STUCK = """
import sys, threading, time
import lmdsl.cli
from lmdsl import __main__ as command

def main():
    lock = threading.Lock()
    lock.acquire()
    print("ready", flush=True)
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        if sys.argv[1] == "after":
            print("lmdsl: interrupted", file=sys.stderr)
            threading.Thread(target=lock.acquire).start()  # Python waits for it at its end
            return 130
        lock.acquire()

lmdsl.cli.main = main
command.PATIENCE = 0.3
sys.exit(command.run())
"""


@posix
@pytest.mark.parametrize("when", ["during", "after"])
def test_ctrl_c_ends_a_command_that_waits_for_a_lock_for_ever(when):
    process = subprocess.Popen(
        [sys.executable, "-c", STUCK, when], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout.readline() == b"ready\n"
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130
    assert err == b"lmdsl: interrupted\n"


# The same bytes -----------------------------------------------------------------------------

NOISY = {
    "format": "lmdsl/1",
    "system": {"kind": "map", "next": {"x": "1.3*x + u + w"}},
    "state_box": {"x": {"low": -1, "high": 1, "cells": 200}},
    "attractor": {"boxes": [{"x": [-0.1, 0.1]}]},
    "control_grid": {"u": {"low": -0.5, "high": 0.5, "points": 21}},
    "noise": {"w": {"normal": {"std": 0.03, "points": 7}}},
    "stage_cost": "x**2 + u**2",
    "sampling": {"kind": "random", "points": 20, "seed": 3},
    "gamma": 1.01,
}
HASHES = """
import hashlib, json, sys
import numpy as np
import lmdsl as lm
found = {}
for k, (data, backend) in enumerate(json.load(sys.stdin)):
    result = lm.solve(lm.Problem.model_validate(data), backend)
    assert result.status == "verified", result.message
    result.save(f"out{k}")
    with np.load(f"out{k}/solution.npz", allow_pickle=False) as arrays:
        for name in arrays.files:
            found[f"{k} {name}"] = hashlib.sha256(arrays[name].tobytes()).hexdigest()
print(json.dumps(found))
"""


@pytest.mark.long
@posix
def test_same_bytes_in_every_process(tmp_path):
    jobs = [(standard_map(30), "policy-iteration"), (NOISY, "policy-iteration"), (NOISY, "highs")]
    jobs.append((standard_map(30), "highs"))
    processes = []
    for run, threads in enumerate((1, 2, 1)):
        names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        folder = tmp_path / str(run)
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", HASHES],
            input=json.dumps(jobs), cwd=folder, capture_output=True, text=True, check=False,
            env={**os.environ, **dict.fromkeys(names, str(threads))}, timeout=600,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        processes.append(json.loads(done.stdout))
    assert len(processes[0]) == 6 * len(jobs)
    assert processes[0] == processes[1] == processes[2]
    # And the controller is the same one whoever solved it.
    assert processes[0]["1 control_index"] == processes[0]["2 control_index"]
    assert processes[0]["0 control_index"] == processes[0]["3 control_index"]


# Limits -------------------------------------------------------------------------------------


def bracketed(result):
    """The best certified answer so far: stabilizing, both bounds proved, the gap stated."""
    proof = result.certificate
    assert proof.stabilizing
    assert proof.upper_bound
    assert proof.lower_bound
    assert np.isfinite([result.cost, result.lower_bound, result.gap, result.contraction]).all()
    assert 0 <= result.lower_bound <= result.cost
    assert result.gap == pytest.approx(1 - result.lower_bound / result.cost, rel=1e-6)
    assert result.contraction < 1


def test_iteration_limit():
    problem = made(standard_map(20))
    best = lm.solve(problem)
    gaps = []
    for limit in (1, 2, 3):
        result = lm.solve(problem, max_iterations=limit)
        bracketed(result)
        assert result.lower_bound <= best.cost
        assert result.cost >= best.lower_bound
        gaps.append(result.gap)
        if limit == 1:
            assert result.status == "solver_failed"
            assert result.exit_status == 4
            assert "iteration limit" in result.message
            assert f"the gap {result.gap:.3g} is above" in result.message
    assert gaps == sorted(gaps, reverse=True)


@pytest.mark.parametrize("limit", [1e-9, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1])
def test_time_limit(limit, tmp_path):
    result = lm.solve(made(standard_map(20)), time_limit=limit)
    assert result.status in ("solver_failed", "verified")
    bracketed(result)
    if result.status != "verified":
        assert "time limit" in result.message
        assert f"the gap {result.gap:.3g} is above" in result.message
    if limit == 1e-9:
        assert result.status == "solver_failed"
    result.save(tmp_path / "out")
    loaded = lm.Result.load(tmp_path / "out")
    assert (loaded.cost, loaded.gap, loaded.status) == (result.cost, result.gap, result.status)


def slow(n=4):
    """A ring of cells that is left with a chance of 1e-4 a step: sweeps converge in 10^5 steps."""
    return mdp([[({(i + 1) % n: 9999, -1: 1}, 1.0)] for i in range(n)], 10_000, 1.0)


def test_a_time_limit_holds_within_the_sweeps_of_one_evaluation(monkeypatch):
    monkeypatch.setattr(classes, "MAX_FACTORED", 0)  # as if the class were too large to factor
    lp = slow()
    pair = np.arange(lp.n)
    asked = itertools.count()

    def late():
        return next(asked) >= 100

    with pytest.raises(deadline.Stopped):
        evaluation.evaluate(lp, pair, time_up=late)
    assert next(asked) < 105
    assert isinstance(first_policy.stabilizing(lp, late), first_policy.Undecided)
    assert stopping.optimal_stopping(lp, 1.1, np.ones(lp.n), pair, np.ones(4, bool), late) is None
    found = gamma_bar.bracket(lp, late)
    assert "ended before" in found.note
    assert next(asked) < 130
    backend = lm.backends.get("policy-iteration")
    solution = backend.solve(lp, lm.backends.Options(time_limit=1e-3, start=pair))
    assert solution.stop is lm.backends.Stop.TIME_LIMIT
    np.testing.assert_array_equal(solution.policy, pair)
    monkeypatch.undo()
    assert evaluation.evaluate(lp, pair) == pytest.approx(1e4)

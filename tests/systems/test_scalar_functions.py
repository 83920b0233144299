"""Functions of one sample: the same model as formulas, and what they may not do is refused."""

import itertools
import logging
import math
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import black_boxes
import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.machine import workers
from lmdsl.model.assembly import asked
from lmdsl.systems import FunctionSystem
from lmdsl.systems.black_box import scalar_map

NOISE = {"w": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}}
HELPERS = str(Path(__file__).parents[1] / "helpers")


def problem(function, data=None, **more):
    system = FunctionSystem(next=function, vectorized=False, **more)
    return made(data or steps()).replaced(system=system)


def kicked(x, y, u, K):
    kick = K * u * math.sin(2 * math.pi * x)
    return x + y + kick, y + kick


@pytest.fixture
def mapped(monkeypatch):
    """The samples that processes of their own evaluated."""
    seen, map_ = [], workers.Workers.map

    def counted(self, tasks, guard=None):
        seen.extend(len(samples) for _, samples in tasks)
        return map_(self, tasks, guard)

    monkeypatch.setattr(workers.Workers, "map", counted)
    return seen


# The same model --------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [
    black_boxes.right, lambda x, u: [x - 0.25 * u], lambda x, u: np.array([x - 0.25 * u]),
    lambda x, u: {"x": np.float64(x - 0.25 * u)}, lambda x, u: (np.array(x - 0.25 * u),),
])  # fmt: skip
def test_numbers_of_any_real_kind_are_right(function):
    assert lm.compile(problem(function)).digest == lm.compile(made(steps())).digest


def test_the_model_is_that_of_the_formula():
    data = standard_map(12)
    own = made(data).replaced(
        system=FunctionSystem(next=kicked, parameters={"K": 0.25}, vectorized=False)
    )
    assert lm.compile(own).digest == lm.compile(made(data)).digest
    mine, theirs = lm.solve(own), lm.solve(made(data))
    assert mine.verified
    assert mine.simulate(starts=50, steps=20) == theirs.simulate(starts=50, steps=20)


def test_noise_and_blocks_of_any_size(monkeypatch):
    data = steps(noise=NOISE)
    own = problem(lambda x, u, w: [x - 0.25 * u + w], data)
    plain = made({**data, "system": {"kind": "map", "next": {"x": "x - 0.25*u + w"}}})
    for pace in (1e-9, 0.25 / 10, 1e3):
        monkeypatch.setattr(asked.Asked, "pace", pace)
        assert lm.compile(own).digest == lm.compile(plain).digest


def test_no_image_leaves_the_box():
    def half(x, u):
        return [x - 0.25 * u if x < 0.5 else math.nan if x < 0.75 else math.inf]

    assert lm.compile(problem(half)).cell_status.tolist() == [0, 1, 2, 2]


def test_arguments_are_plain_floats():
    def typed(x, u):
        assert type(x) is type(u) is float
        return [x - 0.25 * u]

    assert lm.solve(problem(typed)).verified


def test_one_thread_calls():
    data = steps()
    data["state_box"]["x"]["cells"] = 3000
    function = black_boxes.Threads()
    lm.compile(problem(function, data))
    assert function.seen == {threading.get_ident()}


def test_it_may_print(capfd):
    assert lm.solve(problem(black_boxes.prints)).verified
    assert "x is" in capfd.readouterr().out


# Processes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("function", [black_boxes.right, black_boxes.prints])
def test_processes_make_the_same_model(function, mapped, capfd):
    own = problem(function, processes=2)
    assert lm.compile(own).digest == lm.compile(made(steps())).digest
    assert sum(mapped) > 16
    assert not multiprocessing.active_children()


def test_processes_of_their_own_make_the_calls(tmp_path):
    own = problem(black_boxes.Logged(tmp_path), processes=2)
    result = lm.solve(own)
    compiled = {int(path.name) for path in tmp_path.iterdir()}
    assert len(compiled - {os.getpid()}) in (1, 2)
    result.simulate(starts=40, steps=5)
    assert len({int(path.name) for path in tmp_path.iterdir()} - compiled) in (1, 2)
    assert not multiprocessing.active_children()


def test_an_answer_that_depends_on_the_process_is_named():
    data = steps()
    system = FunctionSystem(
        next=black_boxes.elsewhere, vectorized=False, processes=2, parameters={"here": os.getpid()}
    )
    with pytest.raises(lm.BadInput, match="must answer the same every time"):
        lm.compile(made(data).replaced(system=system))


def test_errors_of_other_processes_arrive():
    with pytest.raises(ArithmeticError, match="mine") as raised:
        lm.compile(problem(black_boxes.fails, processes=2))
    assert "in another process" in "".join(raised.value.__notes__)
    assert re.search(r"at x = 0\.[6-9]\d*, u = ", "".join(raised.value.__notes__))
    with pytest.raises(RuntimeError, match="Strange: this and that"):
        lm.compile(problem(black_boxes.fails_strangely, processes=2))
    assert not multiprocessing.active_children()


def test_a_process_that_ends_is_named():
    with pytest.raises(lm.LmdslError, match="ended by itself"):
        lm.compile(problem(black_boxes.ends, processes=2))
    assert not multiprocessing.active_children()


def test_the_time_limit_ends_a_call_that_does_not():
    with pytest.raises(lm.TimeLimitReached):
        lm.compile(problem(black_boxes.sleeps, processes=2), time_limit=0.3)
    assert not multiprocessing.active_children()


SCRIPT = """
import multiprocessing
import lmdsl as lm
from lmdsl.systems import FunctionSystem

def step(x, u):
    return {{"x": x - 0.25 * u}}

def run():
    problem = lm.Problem(
        system=FunctionSystem(next=step, vectorized=False, processes=2),
        state_box={{"x": {{"low": 0, "high": 1, "cells": 4}}}},
        attractor={{"cells": [[0]]}}, control_grid={{"u": {{"values": [0, 1]}}}},
        stage_cost="1", sampling={{"kind": "grid", "per_axis": 2}},
    )
    print(lm.solve(problem).status)

{guard}
"""


@pytest.mark.parametrize(("guard", "words"), [
    ("if __name__ == '__main__':\n    run()", "verified"),
    ("run()", "put what runs behind if __name__ == '__main__'"),
])  # fmt: skip
def test_scripts_are_imported_by_the_processes(tmp_path, guard, words):
    (tmp_path / "own.py").write_text(SCRIPT.format(guard=guard))
    done = subprocess.run(
        [sys.executable, "own.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert words in done.stdout + done.stderr, done.stderr
    assert done.stderr.count("Traceback") == (guard == "run()")


def test_a_session_cannot_be_imported():
    code = SCRIPT.format(guard="run()")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "interactive session" in done.stderr


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs signals")
def test_an_interrupt_ends_the_processes():
    code = f"""
import sys; sys.path.insert(0, {HELPERS!r})
import black_boxes, lmdsl as lm
from problems import made, steps
import lmdsl.machine.workers as workers
from lmdsl.systems import FunctionSystem
make = workers.Workers.__init__
def told(self, *args):
    make(self, *args)
    print(*(process.pid for process in self._processes), flush=True)
workers.Workers.__init__ = told
system = FunctionSystem(next=black_boxes.sleeps, vectorized=False, processes=2)
lm.compile(made(steps()).replaced(system=system))
"""
    child = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    others = [int(word) for word in child.stdout.readline().split()]
    child.send_signal(signal.SIGINT)
    _, errors = child.communicate(timeout=120)
    assert "KeyboardInterrupt" in errors
    assert len(others) == 2
    for other in others:
        with pytest.raises(ProcessLookupError):
            os.kill(other, 0)


# What is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("returned", "words"), [
    (None, "the function returned None for x = "),
    ({"y": 1.0}, "keys x"),
    ([], "0 images for 1 states"),
    ([1.0, 2.0], "2 images for 1 states"),
    ([None], "image of x is None for x = .*real number"),
    ([1j], "image of x is 1j"),
    ([True], "image of x is True"),
    (["0.5"], "image of x is '0.5'"),
    ([np.array([0.5])], r"image of x is an array of shape \(1,\)"),
    (np.array([[0.5]]), r"image of x is an array of shape \(1,\)"),
    ([np.array(None)], "image of x is"),
    ([np.bool_(True)], "image of x is"),
])  # fmt: skip
def test_one_real_number_a_state_is_returned(returned, words):
    with pytest.raises(lm.BadInput, match=rf"system.next: .*{words}"):
        lm.compile(problem(lambda x, u: returned))


def test_errors_of_a_function_say_for_which_sample():
    with pytest.raises(ArithmeticError, match="mine") as raised:
        lm.compile(problem(black_boxes.fails))
    assert re.search(r"system.next at x = 0\.\d+, u = .*return NaN", raised.value.__notes__[0])


def test_a_function_that_draws_is_named():
    rng = np.random.default_rng(0)
    with pytest.raises(lm.BadInput, match=r"and later .* x = .*, u = .*declare noise"):
        lm.compile(problem(lambda x, u: [x - 0.25 * u + 1e-6 * rng.normal()]))


def test_a_function_that_ages_is_named():
    calls = itertools.count()

    def ages(x, u):
        return [x - 0.25 * u * (1 if next(calls) < 60 else 2)]

    with pytest.raises(lm.BadInput, match="keep nothing between calls"):
        lm.compile(problem(ages, {**steps(), "sampling": {"kind": "grid", "per_axis": 30}}))


def test_a_function_of_one_sample_that_is_called_with_arrays_is_told_so():
    for function in (
        lambda x, u: [x if x > 0.5 else x - 0.25 * u],
        lambda x, u: [math.sin(x) - 0.25 * u],
        lambda x, u: [float(x) - 0.25 * u],
    ):
        with pytest.raises(lm.BadInput, match=r"one sample at a time .*vectorized=False"):
            lm.compile(made(steps()).replaced(system=FunctionSystem(next=function)))


@pytest.mark.parametrize(("keys", "where"), [
    ({"processes": 2}, "processes"),
    ({"vectorized": False, "processes": 0}, "processes"),
    ({"vectorized": False, "processes": True}, "processes"),
    ({"vectorized": False, "processes": 2.5}, "processes"),
    ({"vectorized": "no"}, "vectorized"),
])  # fmt: skip
def test_bad_keys(keys, where):
    with pytest.raises(lm.BadInput) as refused:
        FunctionSystem(next=black_boxes.right, **keys)
    assert where in str(refused.value)


# Time ---------------------------------------------------------------------------------------------


class Clock:
    """A clock that only calls of a function move."""

    def __init__(self, monkeypatch, seconds):
        self.now, self.seconds = 0.0, seconds
        for module in (scalar_map, asked):
            monkeypatch.setattr(module.time, "perf_counter", lambda: self.now)

    def step(self, x, u):
        self.now += self.seconds
        return [x - 0.25 * u]


def test_the_time_is_estimated_and_progress_told(monkeypatch, caplog):
    clock, told = Clock(monkeypatch, 10.0), []
    own = problem(clock.step)
    with caplog.at_level(logging.WARNING, "lmdsl"):
        lp = lm.compile(own, progress=lambda stage, done: told.append((stage, done)))
    assert lp.digest == lm.compile(made(steps())).digest
    # Three free cells, two controls, two samples.
    assert "system.next: 12 calls of the function take about 2 min" in caplog.text
    assert [done for _, done in told] == [1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6, 1]
    assert told[2][0].startswith("transitions, 12 calls, about ")
    assert told[-1][0] == "transitions, 12 calls, about 0 s left"


def test_a_short_time_is_not_spoken_of(monkeypatch, caplog):
    clock = Clock(monkeypatch, 4.9)
    with caplog.at_level(logging.WARNING, "lmdsl"):
        lm.compile(problem(clock.step))
    assert not caplog.text


def test_more_processes_take_less_time(monkeypatch, caplog):
    clock = Clock(monkeypatch, 10.0)
    monkeypatch.setattr(workers.Workers, "__init__", lambda self, f, n, where: None)
    monkeypatch.setattr(workers.Workers, "close", lambda self: None)
    monkeypatch.setattr(workers.Workers, "count", 4, raising=False)
    monkeypatch.setattr(
        workers.Workers, "map",
        lambda self, parts, guard: [
            np.array([clock.step(*sample) for sample in samples]) for _, samples in parts
        ],
    )  # fmt: skip
    data = {**steps(), "sampling": {"kind": "grid", "per_axis": 8}}
    with caplog.at_level(logging.WARNING, "lmdsl"):
        lm.compile(problem(clock.step, data, processes=4))
    assert "48 calls of the function take about 2 min" in caplog.text


@pytest.mark.parametrize(("seconds", "text"), [
    (0.4, "0 s"), (61, "61 s"), (100, "2 min"), (3 * 3600, "3 h"), (5 * 86400, "5 days"),
])  # fmt: skip
def test_times_are_said_in_the_words_of_people(seconds, text):
    assert asked.spoken(seconds) == text


def test_the_time_limit_is_looked_at_between_calls():
    calls = []

    def counted(x, u):
        calls.append(x)
        return [x - 0.25 * u]

    with pytest.raises(lm.TimeLimitReached):
        lm.compile(problem(counted), time_limit=1e-9)
    assert not calls


def test_an_interrupt_of_a_call_is_passed_on():
    def interrupted(x, u):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lm.solve(problem(interrupted))

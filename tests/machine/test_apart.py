"""Native calls in a process of their own: what comes back, and that it can be ended."""

from __future__ import annotations

import operator
import os
import signal
import threading
import time

import numpy as np
import pytest
from problems import made, standard_map

import lmdsl as lm
from lmdsl.backends import Options, Stop
from lmdsl.backends.scaled import ScaledLP
from lmdsl.machine import apart
from lmdsl.machine.deadline import Deadline, TimeLimitReached

NEVER, SOON, LONG = Deadline(), 0.01, 1e6


def call(function, *arguments, deadline=NEVER, entries=apart.LARGE):
    return apart.call(function, *arguments, deadline=deadline, doing="sleeping", entries=entries)


def test_small_calls_stay_here_and_others_go():
    here = os.getpid()
    assert call(os.getpid, entries=apart.LARGE - 1) == here
    assert call(os.getpid) != here
    assert call(os.getpid, entries=1, deadline=Deadline(LONG)) != here


def test_what_comes_back():
    many = np.random.default_rng(0).random((1000, 300))
    np.testing.assert_array_equal(call(np.negative, many), -many)
    with pytest.raises(ZeroDivisionError):
        call(operator.truediv, 1, 0)
    with pytest.raises(lm.BadInput, match="this is wrong") as raised:
        call(fails)
    assert raised.value.where == "field"


def fails():
    raise lm.BadInput("this is wrong", "field")


def test_prints_are_no_reply(capfd):
    assert call(print, "a banner") is None
    assert call(os.system, "echo another") == 0
    out, err = capfd.readouterr()
    assert out == ""
    assert "a banner" in err
    assert "another" in err


def test_the_deadline_ends_it(monkeypatch):
    monkeypatch.setattr(apart, "GRACE", 0.01)
    with pytest.raises(TimeLimitReached, match="while sleeping"):
        call(time.sleep, LONG, deadline=Deadline(SOON))


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs signals")
def test_an_interrupt_ends_it():
    children, main = [], threading.main_thread().ident
    popen = apart.subprocess.Popen

    class Noted(popen):
        def __init__(self, *arguments, **more):
            super().__init__(*arguments, **more)
            children.append(self)
            threading.Timer(0.2, signal.pthread_kill, (main, signal.SIGINT)).start()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(apart.subprocess, "Popen", Noted)
        with pytest.raises(KeyboardInterrupt):
            call(time.sleep, LONG)
    assert children[0].returncode is not None


@pytest.mark.parametrize("end", [(os.abort,), (os._exit, 3), (os.kill, 0, 9)])
def test_an_end_that_nobody_asked_for_is_said(end):
    function, *arguments = end
    if function is os.kill:
        function, arguments = killed, []
    with pytest.raises(apart.Ended, match=r"ended .(signal|status) [0-9]+.*memory"):
        call(function, *arguments)


def killed():
    os.kill(os.getpid(), 9)


# Backends ----------------------------------------------------------------------------------------


def stuck(scaled, options):
    time.sleep(LONG)


def dies(scaled, options):
    os.abort()


def test_a_solver_that_does_not_look_at_the_clock_is_ended(monkeypatch):
    monkeypatch.setattr(apart, "GRACE", 0.01)
    scaled = ScaledLP.of(lm.compile(made(standard_map(10))))
    found = scaled.solved(stuck, Options(time_limit=0.05, progress=print, start=np.zeros(3)))
    assert found.stop is Stop.TIME_LIMIT
    assert "time limit" in found.word
    assert scaled.solved(stuck, Options(time_limit=1e-9)).stop is Stop.TIME_LIMIT
    found = scaled.solved(dies, Options(time_limit=LONG))
    assert found.stop is Stop.FAILED
    assert "memory" in found.word


@pytest.mark.parametrize(
    "backend", ["highs", "highs:simplex", "clarabel", "clarabel:dual", "cvxpy"]
)
def test_the_same_answer_from_another_process(backend, monkeypatch):
    lp = lm.compile(made(standard_map(12)))
    here = lm.solve(lp, backend)
    monkeypatch.setattr(apart, "LARGE", 0)
    there = lm.solve(lp, backend)
    limited = lm.solve(lp, backend, time_limit=1e6)
    assert here.verified
    for other in (there, limited):
        assert other.status == here.status
        assert (other.solver_status, other.iterations) == (here.solver_status, here.iterations)
        np.testing.assert_array_equal(other.control_index, here.control_index)

"""Backends are foreign: what they raise, and what they do to what they are given."""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import sys
import threading
import time

import numpy as np
import pytest
from foreign_backends import PROBLEM, Unspeakable, asked, foreign, optimal
from problems import made, steps

import lmdsl as lm
from lmdsl.backends import Solution, Stop
from lmdsl.machine import surroundings

# What is raised -------------------------------------------------------------------------------


class Silent(Exception):
    def __str__(self):
        raise SystemExit(0)


class Panic(BaseException):
    pass


@pytest.mark.parametrize("error", [
    SystemExit(0), SystemExit("bye"), GeneratorExit(), Silent(), Panic(Unspeakable()),
    MemoryError(), RecursionError(), StopIteration(), ExceptionGroup("many", [ValueError()]),
    Warning("w"), AssertionError(), OSError(28, "full"),
])  # fmt: skip
def test_whatever_is_raised_is_a_failure_and_no_exit(lp, truth, error):
    def fails(lp, options):
        raise error

    result = lm.solve(lp, foreign(fails))
    assert result.status == "verified"  # polished from the first policy
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    assert type(error).__name__ in result.solver_status
    assert result.solver_status.isprintable()


def test_what_is_raised_while_the_answer_is_read_is_a_failure(lp):
    class Trap:
        def __array__(self, dtype=None, copy=None):
            raise SystemExit(0)

    found = asked(lp, lambda lp, o: optimal(lp, value=Trap()))
    assert found.stop is Stop.FAILED
    assert "SystemExit" in found.word


def test_the_refusal_of_a_stranger_is_said_on_one_line(lp):
    def refuses(lp, options):
        raise lm.BadInput("not\x1b[2J\nme", Unspeakable)

    with pytest.raises(lm.BadInput) as refused:
        lm.solve(lp, foreign(refuses))
    assert str(refused.value).isprintable()


def test_an_interrupt_goes_through(lp):
    def waits(lp, options):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            lm.solve(lp, foreign(waits))
    finally:
        signal.signal(signal.SIGINT, before)


class Alarm(Exception):
    pass


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="no alarms on this system")
@pytest.mark.parametrize("error", [Alarm("late"), SystemExit(143)])
def test_what_a_signal_handler_raises_goes_through(lp, error):
    def ring(*_):
        raise error

    def waits(lp, options):
        signal.raise_signal(signal.SIGALRM)
        return optimal(lp)

    before = signal.signal(signal.SIGALRM, ring)
    try:
        with pytest.raises(type(error)):
            lm.solve(lp, foreign(waits))
    finally:
        signal.signal(signal.SIGALRM, before)


# What is handed out ---------------------------------------------------------------------------


def unlocked(array):
    """Make an array writeable, whatever that takes."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    array.flags.writeable = True
    return array


def vandalise(lp, options):
    arrays = [lp.cost, lp.control, lp.pair_pointer, lp.cells, lp.cell_status, lp.weight,
              lp.controls, lp.rows.target, lp.rows.code, lp.rows.pointer, lp.rows.shares.value,
              lp.partition.low, lp.partition.cells, lp.cell, *lp.tree, options.start]  # fmt: skip
    for array in arrays:
        unlocked(array)[...] = 0
    if options.proof is not None:
        unlocked(options.proof)[...] = 1e300
    object.__setattr__(lp, "gamma", 0.5)
    vars(lp)["tree"] = None
    return Solution(Stop.OPTIMAL, "optimal")


@pytest.mark.parametrize("elimination", [False, True])
def test_a_backend_that_unlocks_the_model_spoils_its_own_copy(truth, elimination):
    lp = lm.compile(made(PROBLEM))
    digest = lp.digest
    del vars(lp)["digest"]
    result = lm.solve(lp, foreign(vandalise, elimination=elimination))
    assert lp.digest == digest
    assert result.status == "verified"
    assert result.cost == truth.cost
    np.testing.assert_array_equal(result.control_index, truth.control_index)


def spoil_gamma(problem):
    vars(problem)["gamma"] = 0.5


def spoil_cost(problem):
    vars(problem)["stage_cost"] = "0*x"


def spoil_parameters(problem):
    dict.__setitem__(problem.system.parameters, "K", 9.0)


def spoil_box(problem):
    vars(problem.state_box["x"])["high"] = 77.0


def spoil_axes(problem):
    dict.pop(problem.state_box, "x")


@pytest.mark.parametrize(
    "spoil", [spoil_gamma, spoil_cost, spoil_parameters, spoil_box, spoil_axes]
)
def test_a_backend_that_changes_the_problem_spoils_its_own_copy(truth, spoil, tmp_path):
    def spoils(lp, options):
        spoil(lp.problem)
        return optimal(lp, policy=lp.tree[1])

    problem = made(PROBLEM)
    lp = lm.compile(problem)
    result = lm.solve(lp, foreign(spoils))
    assert problem == made(PROBLEM)
    assert result.problem is problem
    assert result.cost == truth.cost
    result.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds


def test_the_function_of_a_problem_is_not_copied():
    class Map:
        def __call__(self, x, u):
            return [x - 0.25 * u]

        def __deepcopy__(self, memo):
            raise TypeError("cannot be copied")

    problem = made(steps()).replaced(system=lm.systems.FunctionSystem(next=Map()))
    seen = []

    def looks(lp, options):
        seen.append(lp.problem.system.next)
        return optimal(lp, policy=lp.tree[1])

    assert lm.solve(problem, foreign(looks)).solver_status == "optimal"
    assert seen == [problem.system.next]


def test_a_backend_that_goes_on_in_a_thread_does_not_matter(lp, truth):
    ended = threading.Event()
    threads = []

    def claims(lp, options):
        def scribble():
            while not ended.is_set():
                unlocked(lp.cost)[...] = 0
                unlocked(lp.rows.target)[...] = 0
                time.sleep(0.001)

        threads.append(threading.Thread(target=scribble))
        threads[0].start()
        return optimal(lp, policy=lp.tree[1])

    try:
        result = lm.solve(lp, foreign(claims))
    finally:
        ended.set()
        threads[0].join()
    assert result.cost == truth.cost


def test_numpys_settings_are_restored(lp, truth):
    def sets(lp, options):
        np.seterr(all="raise")
        return optimal(lp, value=np.full(lp.n, 1e308), occupation=np.full(lp.K, 1e-320))

    before = np.geterr()
    assert lm.solve(lp, foreign(sets)).cost == pytest.approx(truth.cost, rel=1e-9)
    assert np.geterr() == before


@pytest.mark.skipif(
    not (sys.platform == "linux" and platform.machine() == "x86_64"), reason="codes of x86-64 Linux"
)
@pytest.mark.parametrize("mode", [0x400, 0x800, 0xC00, "denormals"])
def test_rounding_is_restored(lp, truth, mode):
    libm = ctypes.CDLL("libm.so.6")

    def sets(lp, options):
        if mode == "denormals":
            state = (ctypes.c_uint32 * 8)()
            libm.fegetenv(state)
            state[7] |= 0x8040  # flush to zero, denormals are zero
            libm.fesetenv(state)
        else:
            libm.fesetround(mode)
        assert not surroundings._rounds_to_nearest()
        return optimal(lp, value=np.ones(lp.n))

    try:
        assert lm.solve(lp, foreign(sets)).cost == pytest.approx(truth.cost, rel=1e-9)
        assert surroundings._rounds_to_nearest()
        sets(lp, None)
        surroundings.restore_rounding("the test")
        assert surroundings._rounds_to_nearest()
    finally:
        libm.fesetenv(ctypes.c_void_p(-1))


def test_rounding_that_cannot_be_restored_is_said(monkeypatch):
    monkeypatch.setattr(surroundings, "_rounds_to_nearest", lambda: False)
    with pytest.raises(lm.LmdslError, match="the backend changed how this processor rounds"):
        surroundings.restore_rounding("the backend")

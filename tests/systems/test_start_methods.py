"""How processes that call a function are started, whatever was imported and asked before."""

import multiprocessing
import subprocess
import sys

import black_boxes
import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.machine import workers
from lmdsl.systems import FunctionSystem

METHODS = multiprocessing.get_all_start_methods()  # the first is the default
NAMED = r"system.next: .*cannot be sent .*def at the top"


def local(x, u):
    """Like a function within a function, no other process can import it by its name."""


local.__qualname__ = "test.<locals>.local"


@pytest.fixture(autouse=True)
def unsettled():
    """Begin with no method chosen; other tests may have imported what settles one."""
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method(None, force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


def digest(function):
    system = FunctionSystem(next=function, vectorized=False, processes=2)
    return lm.compile(made(steps()).replaced(system=system)).digest


def right():
    return lm.compile(made(steps())).digest


def test_what_a_program_chose_stays_chosen():
    for chosen in (None, *METHODS):
        multiprocessing.set_start_method(chosen, force=True)
        assert digest(black_boxes.right) == right()
        assert multiprocessing.get_start_method(allow_none=True) == chosen


@pytest.mark.parametrize(("default", "chosen", "sent", "other"), [
    ("fork", None, "spawn", None), ("fork", "fork", "spawn", "fork"),
    ("fork", "spawn", "spawn", None), ("fork", "forkserver", "forkserver", None),
    ("spawn", None, "spawn", None), ("spawn", "fork", "fork", "fork"),
    ("forkserver", "forkserver", "forkserver", None), ("forkserver", "fork", "fork", "fork"),
])  # fmt: skip
def test_the_method_is_chosen_by_what_can_be_known(monkeypatch, default, chosen, sent, other):
    monkeypatch.setattr(multiprocessing, "get_start_method", lambda allow_none: chosen)
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: [default, "others"])
    assert workers.start_method(black_boxes.right, "system.next") == sent
    if other is not None:
        assert workers.start_method(local, "system.next") == other
        return
    with pytest.raises(lm.BadInput, match=NAMED):
        workers.start_method(local, "system.next")


# What libraries do: nobody chose a method, but multiprocessing takes its default for chosen then.
SETTLING = [multiprocessing.get_start_method, multiprocessing.get_context, multiprocessing.Lock]


@pytest.mark.parametrize("settle", SETTLING)
def test_no_library_makes_a_function_that_can_be_sent_be_forked(settle):
    settle()
    assert multiprocessing.get_start_method(allow_none=True) == METHODS[0]
    assert digest(black_boxes.unforked) == right()


def test_a_function_that_cannot_be_sent_is_named():
    with pytest.raises(lm.BadInput, match=NAMED):
        digest(lambda x, u: [x - 0.25 * u])


@pytest.mark.skipif("fork" not in METHODS, reason="no fork")
@pytest.mark.parametrize("settle", SETTLING)
def test_a_function_that_cannot_be_sent_is_forked_if_that_is_settled(settle):
    settle()
    if METHODS[0] != "fork":
        with pytest.raises(lm.BadInput, match=NAMED):
            digest(lambda x, u: [x - 0.25 * u])
        multiprocessing.set_start_method("fork", force=True)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("warnings.warn", lambda *_, **__: None)  # Python 3.12 warns of threads
        assert digest(lambda x, u: [x - 0.25 * u]) == right()
        with pytest.raises(ArithmeticError, match="forked"):
            digest(lambda x, u: black_boxes.unforked(x, u))


def test_a_program_that_is_imported_by_its_process_starts_no_other(monkeypatch):
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    for chosen in (None, *METHODS):
        multiprocessing.set_start_method(chosen, force=True)
        with pytest.raises(lm.BadInput, match="behind if __name__ == '__main__'"):
            digest(black_boxes.right)


TWICE = """
import numba
import lmdsl as lm
from lmdsl.systems import FunctionSystem

@numba.njit(parallel=True)
def total(count):
    found = 0.0
    for _ in numba.prange(count):
        found += 0.25
    return found

def step(x, u):
    return {"x": x - u * total(1)}

if __name__ == "__main__":
    for _ in range(2):
        problem = lm.Problem(
            system=FunctionSystem(next=step, vectorized=False, processes=2),
            state_box={"x": {"low": 0, "high": 1, "cells": 4}},
            attractor={"cells": [[0]]}, control_grid={"u": {"values": [0, 1]}},
            stage_cost="1", sampling={"kind": "grid", "per_axis": 2},
        )
        print(lm.solve(problem).status)
"""


@pytest.mark.long
def test_threads_that_do_not_survive_a_fork_may_run_before(tmp_path):
    """Numba asks for the method when it starts its threads, here while the first run is timed."""
    (tmp_path / "own.py").write_text(TWICE)
    done = subprocess.run(
        [sys.executable, "own.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["verified", "verified"], done.stderr

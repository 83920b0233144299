"""A forked child never waits for threads that are gone, nor for a lock that one of them held."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

CHILD = """
import os, signal, threading
import lmdsl as lm
from lmdsl.machine import forking, kernels

GUARD = 120  # seconds after which a child counts as waiting for ever

def fork(work):
    pid = os.fork()
    if not pid:
        signal.alarm(GUARD)
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return pid

def ended(pid):
    status = os.waitpid(pid, 0)[1]
    assert status == 0, f"a child ended with {status}"

def problem(cells):
    data = lm.systems.NAMED["standard_map"].problem
    axes = {name: {**axis, "cells": cells} for name, axis in data["state_box"].items()}
    return lm.Problem.model_validate({**data, "state_box": axes})
"""


def run(script):
    """Run a script, apart: this process has threads (Python 3.12 warns of that)."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", CHILD + textwrap.dedent(script)],
        capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.parametrize("backend", ["clarabel", "clarabel:dual", "cvxpy:clarabel", "highs:ipx"])
def test_what_was_solved_before_a_fork_is_solved_after_it(backend):
    run(f"""
    p = problem(30)
    cost = lm.solve(p, {backend!r}).cost

    def again():
        found = lm.solve(p, {backend!r})
        assert found.status == "verified" and abs(found.cost - cost) < 1e-6 * cost

    ended(fork(again))
    """)


def test_a_fork_is_noticed():
    run("""
    import multiprocessing
    assert not forking.forked()

    def check():
        assert forking.forked()
        ended(fork(check_deeper))

    def check_deeper():
        assert forking.forked()

    ended(fork(check))
    assert not forking.forked()
    """)


@pytest.mark.parametrize(("method", "expected"), [("fork", True), ("spawn", False)])
def test_a_child_of_multiprocessing_that_imports_late_is_noticed(tmp_path, method, expected):
    script = tmp_path / "pool.py"
    script.write_text(
        textwrap.dedent(f"""
    import multiprocessing

    def ask(_):
        from lmdsl.machine import forking  # not imported before the fork
        return forking.forked()

    if __name__ == "__main__":
        with multiprocessing.get_context({method!r}).Pool(1) as pool:
            assert pool.map(ask, [0]) == [{expected}]
        from lmdsl.machine import forking
        assert not forking.forked()
    """)
    )
    command = [sys.executable, "-W", "ignore::DeprecationWarning", str(script)]
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": root}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr


def test_a_property_that_another_thread_is_computing_is_no_lock():
    run("""
    begun, end = threading.Event(), threading.Event()

    class Slow:
        @forking.cached_property
        def value(self):
            if self.waits:
                begun.set()
                end.wait()
            return 7

    def make(waits):
        slow = Slow()
        slow.waits = waits
        return slow

    threading.Thread(target=lambda: make(True).value, daemon=True).start()
    begun.wait()

    def read():
        slow = make(False)
        assert slow.value == 7 and slow.__dict__["value"] == 7

    ended(fork(read))
    end.set()
    assert Slow.value is not None
    """)


@pytest.mark.parametrize(
    "lock", ["kernels.numba.core.compiler_lock.global_compiler_lock", "forking.whole"]
)
def test_a_fork_waits_for_who_compiles_or_imports(lock):
    run(f"""
    import time
    lock, begun = {lock}, threading.Event()

    def hold():
        lock.acquire()
        begun.set()
        time.sleep(0.3)
        lock.release()

    threading.Thread(target=hold).start()
    begun.wait()

    def take():
        lock.acquire()
        lock.release()

    for _ in range(2):
        ended(fork(take))
        take()
    """)


@pytest.mark.long
@pytest.mark.parametrize("backend", ["policy-iteration", "highs"])
def test_forks_while_other_threads_solve(backend):
    run(f"""
    import time
    p, stop = problem(16), threading.Event()
    cost = lm.solve(p, {backend!r}).cost

    def work():
        while not stop.is_set():
            lm.solve(p, {backend!r})

    def once():
        assert lm.solve(p, {backend!r}).cost == cost

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    children = []
    for k in range(12):
        time.sleep(0.02 + 0.003 * k)
        children.append(fork(once))
    stop.set()
    for child in children:
        ended(child)
    for thread in threads:
        thread.join()
    """)


def test_a_fork_while_another_thread_puts_the_streams_back():
    run("""
    import time
    from lmdsl.machine import quiet
    close, begun = os.close, threading.Event()

    def slow(number):
        close(number)
        begun.set()
        time.sleep(0.3)

    def work():
        with quiet.foreign():
            os.close = slow

    thread = threading.Thread(target=work)
    thread.start()
    begun.wait()
    os.close = close

    def again():
        with quiet.foreign() as printed:
            print("NOISE")
        assert printed() == "NOISE\\n"

    ended(fork(again))
    thread.join()
    again()
    """)


def test_a_thread_that_outlives_the_main_one_solves():
    said = run("""
    p = problem(30)
    cost = lm.solve(p).cost

    def work():
        threading.main_thread().join()
        assert lm.solve(p).cost == cost
        os.write(2, b"solved")

    threading.Thread(target=work).start()
    """)
    assert said == "solved"

"""Streams that a backend spoils, and what other threads print meanwhile: nothing is lost."""

from __future__ import annotations

import functools
import json
import os
import sys
import threading

import pytest
from noisy_backend import Notebook, posix, python, shouting
from problems import made, steps

import lmdsl as lm
from lmdsl import backends
from lmdsl.cli import main
from lmdsl.errors import printable
from lmdsl.machine import quiet

SPOILT = {
    "closed": "sys.stdout.close(); sys.stderr.close()",
    "none": "sys.stdout = sys.stderr = None",
    "own": "sys.stdout = sys.stderr = open(os.dup(1), 'w')",
    "rewrapped": "sys.stdout = io.TextIOWrapper(sys.stdout.buffer); sys.stdout = sys.__stdout__",
    "wrapped": "sys.stdout = io.TextIOWrapper(sys.stdout.buffer)",
    "detached": "sys.stdout.detach()",
    "descriptor": "os.close(1)",
    "elsewhere": "os.chdir('/')",
    "fork returns": "os.fork() or print('child')",
    "fork raises": "os.fork() or sys.exit(0)",
}
SPOILING = """
import io, os, sys
from lmdsl import backends

def solve(lp, options):
    print("NOISE")
    {}
    print("NOISE", flush=True) if sys.stdout else None
    return backends.get("policy-iteration").solve(lp, options)

BACKEND = backends.Backend("noisy", solve)
"""


@pytest.mark.long
@posix
@pytest.mark.parametrize("how", SPOILT)
def test_streams_that_a_backend_spoils(tmp_path, noisy, how):
    (tmp_path / "noisy.py").write_text(SPOILING.format(SPOILT[how]))
    call = ("-m", "lmdsl", "solve", "problem.json", "--backend", "noisy", "--out", "out", "--json")
    done = python(tmp_path, noisy, *call)
    assert json.loads(done.stdout)["status"] == "verified", done.stderr
    assert done.returncode == 0
    assert (tmp_path / "out" / "certificate.json").exists()
    (tmp_path / "spoilt.py").write_text(
        "import sys, lmdsl as lm\nproblem = lm.load('problem.json')\nprint('before')\n"
        "for _ in range(2): assert lm.solve(problem, 'noisy').verified\n"
        "print('after')\nprint('error', file=sys.stderr)\n"
    )
    done = python(tmp_path, noisy, "spoilt.py")
    assert (done.stdout, done.stderr, done.returncode) == ("before\nafter\n", "error\n", 0)


def test_a_handler_made_in_one_solve_is_quiet_in_the_next(monkeypatch):
    stream, kept = Notebook(), []
    monkeypatch.setattr(sys, "stdout", stream)

    def solve(lp, options):
        kept.append(sys.stdout)
        print("NOISE", file=kept[0])
        return backends.get("policy-iteration").solve(lp, options)

    for _ in range(2):
        assert lm.solve(made(steps()), backends.Backend("keeping", solve)).log == "NOISE\n"
    assert stream.getvalue() == ""
    print("mine", file=kept[0])
    assert stream.getvalue() == "mine\n"


def test_the_contract_suite_prints_nothing_of_a_backend(capfd):
    assert lm.testing.check_backend(shouting(), raise_on_failure=False).checks
    assert capfd.readouterr().out == ""


@posix
def test_what_other_threads_print_is_not_lost(capfd):
    ready, go = threading.Event(), threading.Event()

    def solve(lp, options):
        print("NOISE")
        ready.set()
        assert go.wait(60)
        return backends.get("policy-iteration").solve(lp, options)

    found = []
    solves = [
        threading.Thread(target=lambda: found.append(
            lm.solve(made(steps()), backends.Backend("waiting", solve)).log))
        for _ in range(3)
    ]  # fmt: skip
    before = sys.stdout
    for thread in solves:
        thread.start()
    assert ready.wait(60)
    for k in range(100):
        print("mine", k)
    held = sys.stdout
    go.set()
    for thread in solves:
        thread.join(60)
    assert sys.stdout is before
    print("later", file=held)
    out = capfd.readouterr().out
    assert out == "".join(f"mine {k}\n" for k in range(100)) + "later\n"
    assert len(found) == 3
    assert all("NOISE\n" in log for log in found)


@posix
def test_descriptors_are_not_leaked(capfd):
    problem = made(steps())
    lm.solve(problem, shouting())
    before = sorted(os.listdir("/dev/fd"))
    for _ in range(5):
        lm.solve(problem, shouting())
        main(["systems"])
    assert sorted(os.listdir("/dev/fd")) == before
    assert "NOISE" not in capfd.readouterr().out


@posix
def test_a_fork_during_a_solve_prints(tmp_path, noisy):
    (tmp_path / "fork.py").write_text("""
import os, sys, threading
from lmdsl.machine import quiet
inside, go = threading.Event(), threading.Event()
def work():
    with quiet.foreign():
        inside.set(); go.wait(); print("NOISE")
thread = threading.Thread(target=work); thread.start(); inside.wait()
child = os.fork()
if not child:
    os.write(1, b"raw "); print("child", flush=True); os._exit(0)
os.waitpid(child, 0); go.set(); thread.join()
print("parent")
""")
    done = python(tmp_path, noisy, "fork.py")
    assert done.stdout == "raw child\nparent\n"


def test_a_long_log_is_cut():
    with quiet.foreign() as printed:
        print("x" * 100_000 + "end")
    assert printed().endswith("end\n")
    assert len(printed()) == quiet.KEPT
    with quiet.foreign() as printed:
        pass
    assert printed() == ""


@posix
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no full disk")
def test_a_full_disk_does_not_matter(monkeypatch, capfd):
    full = functools.partial(open, "/dev/full", "w+b", buffering=0)
    monkeypatch.setattr(quiet, "_file", full)
    result = lm.solve(made(steps()), shouting("NOISE\n" * 10_000))
    assert result.verified
    assert result.log == ""
    assert capfd.readouterr() == ("", "")


def test_escapes():
    assert printable("a\x1b[31m\n\u202e\x00\udc80é") == r"a\x1b[31m\n\u202e\x00\udc80é"
    assert printable("plain 'é' \\n") == "plain 'é' \\n"

"""What is printed where: answers on standard output, whatever a solver prints never among them."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from noisy_backend import Notebook, posix, python, shouting
from problems import made, steps

import lmdsl as lm
from lmdsl import backends


@posix
@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        ("solve problem.json --backend noisy", 0),
        ("solve problem.json --backend noisy:late", 0),
        ("solve problem.json --backend noisy:refused", 2),
        ("solve problem.json --backend noisy:fails", 0),  # polished from the first policy
        ("solve problem.json --backend noisy:unknown", 2),
        ("compare problem.json --backends noisy,policy-iteration,noisy:works", 0),
        ("compare problem.json --backends noisy:refused", 2),
        ("backends", 0),
    ],
)
def test_only_our_object_is_on_standard_output(tmp_path, noisy, arguments, status):
    done = python(tmp_path, noisy, "-m", "lmdsl", *arguments.split(), "--json")
    assert done.returncode == status, done.stderr
    assert "NOISE" not in done.stdout
    assert isinstance(json.loads(done.stdout), dict)
    assert "\x1b" not in done.stdout + done.stderr
    if status == 0 and arguments != "backends":
        assert done.stderr.count("NOISE puts solve") == arguments.count("noisy")


@pytest.mark.long
@posix
def test_text_is_not_disturbed_and_control_characters_are_escaped(tmp_path, noisy):
    done = python(tmp_path, noisy, "-m", "lmdsl", "solve", "problem.json", "--backend", "noisy")
    assert done.returncode == 0
    assert "NOISE" not in done.stdout
    assert r"noisy (ok\x1b[2J {})" in done.stdout
    done = python(tmp_path, noisy, "-m", "lmdsl", "compare", "problem.json", "--backends", "noisy")
    assert "NOISE" not in done.stdout
    assert "\x1b" not in done.stdout


@posix
@pytest.mark.parametrize("backend", [*backends.installed(), "highs:hipo", "cvxpy:nobody"])
def test_our_backends_print_nothing(tmp_path, noisy, backend):
    code = f"import lmdsl as lm; lm.solve(lm.load('problem.json'), {backend!r})"
    done = python(tmp_path, noisy, "-c", f"try:\n {code}\nexcept ValueError: pass")
    assert (done.stdout, done.stderr) == ("", "")
    done = python(tmp_path, noisy, "-m", "lmdsl", "solve", "problem.json", "--backend", backend,
                  "--json")  # fmt: skip
    assert json.loads(done.stdout)["status"] in ("verified", "bad_input")
    assert done.stderr.count("\n") == (done.returncode == 2)


QUIET = """
import sys
import lmdsl as lm
import noisy
problem = lm.load("problem.json")
print("before", end=" ", flush=False)
result = lm.solve(problem, "noisy", progress=lambda stage, _: print(f"<{stage}>", end=" "))
assert result.verified, result.message
for way in noisy.WAYS:
    assert f"NOISE {way}" in result.log, (way, result.log)
assert "<" not in result.log
lm.compare(problem, ["noisy", noisy.BACKEND, "highs"])
lm.backends.get("noisy")
try:
    lm.solve(problem, "noisy:refused")
except lm.BadInput:
    print("refused", end=" ")
print("after")
"""


@posix
def test_python_prints_nothing_of_a_solver(tmp_path, noisy):
    (tmp_path / "quiet.py").write_text(QUIET.replace("import noisy\n", "", 1).replace(
        "problem =", "with lmdsl.machine.quiet.foreign():\n    import noisy\nproblem =", 1
    ).replace("import lmdsl as lm", "import lmdsl as lm\nimport lmdsl.machine.quiet"))  # fmt: skip
    done = python(tmp_path, noisy, "quiet.py")
    assert done.returncode == 0, done.stderr
    words = done.stdout.split(" ")
    assert words[0] == "before"
    assert "<of" in words
    assert words[-2:] == ["refused", "after\n"]
    assert "NOISE" not in done.stdout
    assert done.stderr == ""


CLOSED = """
import os, sys
{}
import lmdsl as lm
result = lm.solve(lm.load("problem.json"), lm.backends.Backend("loud", lambda lp, options: (
    os.write(1, b"NOISE") if {} else None, print("NOISE"),
    lm.backends.get("policy-iteration").solve(lp, options))[-1]))
sys.exit(not result.verified)
"""


@pytest.mark.long
@posix
@pytest.mark.parametrize(
    ("how", "raw"),
    [("sys.stdout = None", 1), ("os.close(1)", 0), ("sys.stdout = sys.__stdout__ = None", 0),
     ("sys.stdout.close()", 0), ("import tempfile; tempfile.tempdir = '/nowhere'", 1)],
)  # fmt: skip
def test_a_process_without_standard_output(tmp_path, noisy, how, raw):
    (tmp_path / "closed.py").write_text(CLOSED.format(how, raw))
    done = subprocess.run([sys.executable, "closed.py"], cwd=tmp_path, env=noisy,
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    if "close" not in how:
        assert done.returncode == 0, done.stderr


def test_a_notebook(monkeypatch):
    stream = Notebook()
    monkeypatch.setattr(sys, "stdout", stream)
    result = lm.solve(made(steps()), shouting(), progress=lambda *_: print("progress"))
    assert sys.stdout is stream
    assert result.log == "NOISE\n"
    assert set(stream.getvalue().split()) == {"progress"}

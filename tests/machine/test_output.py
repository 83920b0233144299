"""What is printed where: answers on standard output, whatever a solver prints never among them."""

from __future__ import annotations

import functools
import io
import json
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl import backends
from lmdsl.cli import main
from lmdsl.common import files
from lmdsl.errors import printable
from lmdsl.machine import quiet

posix = pytest.mark.skipif(os.name != "posix", reason="descriptors of POSIX")
ROOT = Path(lm.__file__).parents[1]

NOISY = '''
import atexit, ctypes, os, subprocess, sys, threading
from lmdsl import backends
from lmdsl.errors import BadInput

def shout(when):
    """Print in all ways there are; C and the old stream hold back what ends no line."""
    libc = ctypes.CDLL(None)
    print("NOISE print", when)
    sys.stdout.write("NOISE write " + when)
    sys.__stdout__.write("NOISE old stream " + when)
    os.write(1, b"NOISE descriptor " + when.encode())
    libc.puts(b"NOISE puts " + when.encode())
    libc.printf(b"NOISE printf " + when.encode())
    subprocess.run([sys.executable, "-c", "print('NOISE child')"])
    os.system("echo NOISE shell")
    print("NOISE stderr", when, file=sys.stderr)

WAYS = ("print", "write", "old stream", "descriptor", "puts", "printf", "child", "shell", "stderr")

if __name__ != "__main__":
    shout("import")

def solve(lp, options):
    shout("solve")
    if options.progress:
        options.progress("of the backend", 0.5)
    if options.algorithm == "refused":
        raise BadInput("not this one", "backend")
    if options.algorithm == "fails":
        raise RuntimeError("no\\x1b[31m")
    if options.algorithm == "late":
        atexit.register(shout, "end")
    own = backends.get("policy-iteration").solve(lp, options)
    return backends.Solution(own.stop, "ok\\x1b[2J\\n{}", own.value, None, own.policy)

BACKEND = backends.Backend(
    "noisy", solve, backends.Capabilities(algorithms=("works", "refused", "fails", "late"))
)
'''


@pytest.fixture
def noisy(tmp_path):
    """The environment of a process in which a noisy backend is installed."""
    (tmp_path / "noisy.py").write_text(NOISY)
    info = tmp_path / "noisy-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: noisy\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lmdsl.backends]\nnoisy = noisy:BACKEND\n")
    (tmp_path / "problem.json").write_text(json.dumps(steps()))
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    return {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": ""}


def python(tmp_path, environment, *arguments):
    done = subprocess.run(
        [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True,
        text=True, check=False, timeout=600,
    )  # fmt: skip
    assert "Traceback" not in done.stderr, done.stderr
    return done


# Foreign output -----------------------------------------------------------------------------


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


def shouting(text="NOISE"):
    own = backends.get("policy-iteration").solve

    def solve(lp, options):
        print(text)
        return own(lp, options)

    return backends.Backend("shouting", solve)


class Notebook(io.StringIO):
    """A stream like a notebook's: without a descriptor."""

    def fileno(self):
        raise io.UnsupportedOperation("fileno")


def test_a_notebook(monkeypatch):
    stream = Notebook()
    monkeypatch.setattr(sys, "stdout", stream)
    result = lm.solve(made(steps()), shouting(), progress=lambda *_: print("progress"))
    assert sys.stdout is stream
    assert result.log == "NOISE\n"
    assert set(stream.getvalue().split()) == {"progress"}


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


# Pipes --------------------------------------------------------------------------------------

COMMANDS = {
    "--version": 0,
    "--help": 0,
    "solve --help": 0,
    "systems": 0,
    "systems --json": 0,
    "schema": 0,
    "backends": 0,
    "solve problem.json": 0,
    "solve problem.json --json --out new": 0,
    "solve missing.json --json": 2,
    "solve": 2,
    "compare problem.json --backends policy-iteration": 0,
    "compare problem.json --backends policy-iteration --json": 0,
    "verify out": 0,
    "verify out --json": 0,
    "verify missing --json": 2,
    "simulate out --starts 5": 0,
    "simulate out --starts 5 --json": 0,
    "plot out --out new.png": 0,
    "export out --format drn --out new.drn": 0,
    "gamma-max problem.json": 0,
    "gamma-max problem.json --json": 0,
    "explain problem.json": 0,
    "explain problem.json --json": 0,
    "init logistic_map --out new.json": 0,
}
QUICK = ("--version", "schema", "solve problem.json", "solve missing.json --json")
FULL = "/dev/full"
PLACES = [">&-", "| head -0", "2>&-", ">&- 2>&-", "<&- >&- 2>&-", "</dev/null >/dev/null 2>&1"]
if os.path.exists(FULL):
    PLACES += [f">{FULL}", f"2>{FULL}", f">{FULL} 2>{FULL}"]


@posix
@pytest.mark.parametrize(
    "command", [c if c in QUICK else pytest.param(c, marks=pytest.mark.long) for c in COMMANDS]
)
def test_lost_streams(tmp_path, command):
    (tmp_path / "problem.json").write_text(json.dumps(steps()))
    lm.solve(made(steps())).save(tmp_path / "out")
    before = set(os.listdir(tmp_path))
    for place in PLACES if command in QUICK else PLACES[::3]:
        call = f'"{sys.executable}" -m lmdsl {command}'
        pipe = place if place.startswith("|") else ""
        line = f"{{ {call} {'' if pipe else place}; echo $? >&9; }} 9>status {pipe}"
        done = subprocess.run(
            ["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": ""}, timeout=600,
        )  # fmt: skip
        status = int((tmp_path / "status").read_text())
        said = done.stdout + done.stderr
        assert status == COMMANDS[command], (place, said)
        assert "internal error" not in said, place
        assert "Traceback" not in said, place
        assert "Exception ignored" not in said, place
        if status == 0 and "2>" not in place:
            noted = command.startswith("simulate") and "--json" in command  # "as stored ..."
            assert done.stderr.count("\n") == (FULL in place) + noted, (place, done.stderr)
        if status == 0 and place.startswith("2>"):
            assert done.stdout, place
        for name in set(os.listdir(tmp_path)) - before - {"status"}:
            path = tmp_path / name
            for child in path.iterdir() if path.is_dir() else ():
                assert child.stat().st_size > 0
            subprocess.run(["rm", "-r", str(path)], check=True)


# The rest of the environment ----------------------------------------------------------------


@pytest.mark.parametrize("name", ["module://matplotlib_inline.backend_inline", "nonsense"])
def test_a_notebook_s_matplotlib_backend_does_not_matter(tmp_path, noisy, name):
    lm.solve(made(steps())).save(tmp_path / "out")
    done = python(tmp_path, {**noisy, "MPLBACKEND": name}, "-m", "lmdsl", "plot", "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "out" / "figures.png").stat().st_size > 0


def test_an_unknown_matplotlib_backend_is_named_in_python(tmp_path, noisy):
    lm.solve(made(steps())).save(tmp_path / "out")
    code = "import lmdsl as lm\ntry: lm.plotting.figure(lm.Result.load('out'), 'a.png')\n" \
           "except lm.BadInput as error: print(error)"  # fmt: skip
    done = python(tmp_path, {**noisy, "MPLBACKEND": "nonsense"}, "-c", code)
    assert done.returncode == 0, done.stderr
    assert "MPLBACKEND" in done.stdout or done.stdout == ""  # some versions take any name
    assert done.stdout.count("\n") <= 1


@posix
def test_umask_is_obeyed_and_never_changed(tmp_path, monkeypatch):
    mask = os.umask(0o027)
    try:
        monkeypatch.setattr(os, "umask", lambda _: pytest.fail("umask was changed"))
        files.write_whole(tmp_path / "file", b"x")
        lm.solve(made(steps())).save(tmp_path / "out")
    finally:
        monkeypatch.undo()
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
    for path in (tmp_path / "out").iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == 0o750

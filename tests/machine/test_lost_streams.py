"""Lost streams and odd environments: the documented status, at most one message."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys

import pytest
from noisy_backend import ROOT, posix, python
from problems import made, steps

import lmdsl as lm
from lmdsl.common import files

# Pipes ----------------------------------------------------------------------------------------

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


# The rest of the environment ------------------------------------------------------------------


@pytest.mark.long
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

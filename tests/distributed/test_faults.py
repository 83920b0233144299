"""Faults of ranks: all end soon, one message says why, and nothing half-written appears."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from launching import LAUNCHER, needs_mpi
from problems import standard_map

import lmdsl as lm

pytestmark = pytest.mark.long  # in other versions it would find nothing else

SCRIPT = Path(__file__).parents[1] / "helpers/faulty_ranks.py"
LONG = 50  # seconds after which something is taken to hang; all takes three, most to start


def started(folder, fault, *options, count=2):
    """Start a solve over ranks that meets a fault."""
    file = folder / "problem.json"
    file.write_text(json.dumps(standard_map(16)))
    command = [LAUNCHER, "-n", str(count), sys.executable, SCRIPT, fault, folder, "solve", file,
               "--no-simulate", *options]  # fmt: skip
    path = os.pathsep.join((str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")))
    env = {**os.environ, "NUMBA_NUM_THREADS": "1", "PYTHONPATH": path}
    return subprocess.Popen(
        list(map(str, command)), env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process):
    """Return exit status, what was said, and the answer; all that is left is ended."""
    try:
        out, error = process.communicate(timeout=LONG)
    finally:
        process.kill()
    said = [line for line in error.splitlines() if line.startswith("lmdsl:")]
    assert "Traceback" not in error
    return process.returncode, said, out  # launchers have more to say


FAULTS = [  # a fault, the exit status, and what is said
    ("compiling:odd", 4, "internal error: ValueError: 'odd'; please report it"),
    ("compiling:memory", 2, "lmdsl: out of memory; use fewer cells, controls or sample points"),
    ("compiling:bad", 2, "lmdsl: gamma: spoilt"),
    ("levels:odd", 4, "lmdsl: rank 1 of 2: internal error: ValueError: odd; please report it"),
    ("levels:memory", 2, "lmdsl: rank 1 of 2: out of memory; use fewer cells"),
    ("saving:full", 2, "no space left on device (rank 1)"),
    ("saving:memory:0", 2, "out of memory"),
    ("saved:odd:0", 4, "internal error"),
]
OFTEN = {"levels:odd", "saving:full"}  # the others on request
SELDOM = pytest.mark.long, pytest.mark.full


@needs_mpi
@pytest.mark.parametrize(
    ("fault", "status", "words"),
    [pytest.param(*f, marks=() if f[0] in OFTEN else SELDOM) for f in FAULTS],
)
def test_an_error_of_one_rank_is_said_once_and_leaves_nothing(tmp_path, fault, status, words):
    code, said, _ = ended(started(tmp_path, fault, "--out", tmp_path / "out"))
    assert code == status
    assert len(said) == 1, said
    assert words in said[0]
    assert os.listdir(tmp_path) == ["problem.json"]


@needs_mpi
@pytest.mark.long
def test_what_was_found_is_told_where_it_cannot_be_saved(tmp_path):
    """As one process does: one object, with what is known."""
    code, said, out = ended(
        started(tmp_path, "saving:full", "--out", tmp_path / "out", "--json")
    )  # fmt: skip
    assert code == 2
    assert said == [each for each in said if each.endswith("; nothing was saved")]
    assert json.loads(out)["status"] == "verified"


@needs_mpi
@pytest.mark.parametrize("place", ["solving", pytest.param("saving", marks=pytest.mark.long)])
def test_a_killed_rank_ends_all(tmp_path, place):
    """What it leaves beside the directory is removed by the next save."""
    code, said, _ = ended(started(tmp_path, f"{place}:killed", "--out", tmp_path / "out"))
    assert code not in (0, 1, 2, 3)
    assert said == []  # the launcher tells it
    left = set(os.listdir(tmp_path)) - {"problem.json"}
    assert all(name.startswith(".out.") for name in left)
    assert bool(left) == (place == "saving")
    lm.solve(tmp_path / "problem.json").save(tmp_path / "out")
    assert sorted(os.listdir(tmp_path)) == ["out", "problem.json"]


def told(process, folder, whom, number):
    """Send a signal, once all ranks wait for it; return how all ended, and after how long."""
    ready = [folder / f"ready{rank}" for rank in range(2)]
    until = time.monotonic() + LONG
    while not all(each.exists() for each in ready) and process.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.02)
    os.kill(process.pid if whom == "launcher" else int(ready[whom].read_text()), number)
    return ended(process)


@needs_mpi
@pytest.mark.skipif(sys.platform != "linux", reason="waits for a thread of the system")
@pytest.mark.parametrize(
    ("kind", "whom", "number"),
    [
        ("blocks", "launcher", signal.SIGINT),
        ("blocks", 1, signal.SIGTERM),
        *(
            pytest.param(*each, marks=SELDOM)
            for each in [
                ("waits", "launcher", signal.SIGINT),
                ("waits", "launcher", signal.SIGTERM),
                ("waits", 0, signal.SIGTERM),
                ("waits", 1, signal.SIGINT),
                ("blocks", 1, signal.SIGINT),
            ]
        ),
    ],
)
def test_signals_end_all_also_in_a_compiled_loop(tmp_path, kind, whom, number):
    process = started(tmp_path, f"solving:{kind}", "--out", tmp_path / "out")
    code, said, _ = told(process, tmp_path, whom, number)
    assert code == 128 + number or (whom == "launcher" and code)  # Open MPI's says 1
    words = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}[number]
    if said or code == 128 + number:  # else the launcher, Open MPI's, was faster
        assert said == [f"lmdsl: rank {1 if whom == 1 else 0} of 2: {words}"]
    assert sorted(os.listdir(tmp_path)) == ["problem.json", "ready0", "ready1"]


@needs_mpi
@pytest.mark.parametrize(
    "count", [1, pytest.param(2, marks=pytest.mark.long), pytest.param(3, marks=SELDOM)]
)
def test_a_killed_solve_is_resumed_by_any_number(tmp_path, count):
    """Every policy is kept; the last rank is killed once the first one was."""
    kept = tmp_path / "kept"
    code, _, _ = ended(started(tmp_path, "kept:killed", "--checkpoint", kept))
    assert code not in (0, 1, 2, 3)
    assert (kept / "checkpoint.json").exists()
    options = "--resume", kept, "--out", tmp_path / "out", "--json"
    code, said, out = ended(started(tmp_path, "kept:nothing", *options, count=count))
    assert (code, said) == (0, [])
    assert json.loads(out)["status"] == "verified"
    found, whole = lm.Result.load(tmp_path / "out"), lm.solve(tmp_path / "problem.json")
    np.testing.assert_array_equal(found.control_index, whole.control_index)

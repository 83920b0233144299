"""The command line under a launcher: the same answers as of one process, said once."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run
from launching import LAUNCHER, needs_mpi
from problems import made, standard_map

import lmdsl as lm

SHORT = {"NUMBA_NUM_THREADS": "1"}


def apart(count, *arguments, **variables):
    """Processes that a launcher started as some of many, each without the others."""
    every = []
    for rank in range(count):
        env = {**os.environ, "PMI_SIZE": str(count), "PMI_RANK": str(rank), **variables}
        command = [sys.executable, "-m", "lmdsl", *map(str, arguments)]
        every.append(subprocess.run(command, capture_output=True, text=True, env=env))
    return every


def command(*arguments):
    return [sys.executable, "-m", "lmdsl", *map(str, arguments)]


def over(count, *arguments, cwd=None, parts=None):
    """How a command of so many ranks ended; ``parts`` are commands of one rank each."""
    launched = [LAUNCHER, "-n", str(count), *command(*arguments)]
    if parts:
        launched = [LAUNCHER]
        for k, part in enumerate(parts):
            launched += [":"] * (k > 0) + ["-n", "1", *part]
    path = os.pathsep.join((str(Path(lm.__file__).parents[1]), os.environ.get("PYTHONPATH", "")))
    env = {**os.environ, **SHORT, "PYTHONPATH": path}
    return subprocess.run(launched, capture_output=True, text=True, timeout=100, env=env, cwd=cwd)


@pytest.fixture
def file(tmp_path):
    made(standard_map(12)).save(tmp_path / "map.json")
    return tmp_path / "map.json"


@pytest.mark.parametrize("without", [None, "mpi4py"])
def test_a_launcher_that_mpi_does_not_see_is_refused_once(tmp_path, file, without):
    """With an mpi4py of another MPI, and without any."""
    place = tmp_path / "hidden"
    place.mkdir()
    if without:
        (place / "mpi4py.py").write_text("raise ImportError('none here')")
    path = os.pathsep.join((str(place), os.environ.get("PYTHONPATH", "")))
    env = {"PYTHONPATH": path, "OMPI_COMM_WORLD_SIZE": "2"} if without else {}
    first, second = apart(2, "solve", file, "--out", tmp_path / "out", **env)
    if not without and "cannot be imported" not in first.stderr:
        pytest.skip("MPI itself refuses") if first.returncode != 2 else None
    assert first.returncode == second.returncode == 2
    assert re.fullmatch(r"lmdsl: .*started 2 ranks, and .*\n", first.stderr)
    assert second.stderr == first.stdout == second.stdout == ""
    assert not (tmp_path / "out").exists()


def numbers_out(text):
    """A summary without ranks, the seconds that it took, and the last digits of gaps."""
    text = re.sub(r"ranks  +2, .*\n", "", re.sub(r"seconds .*", "seconds", text))
    return re.sub(r"(gap|within|contraction) +\S+", r"\1", text)


@needs_mpi
def test_solve_says_what_one_process_says(tmp_path, file, capsys):
    status, out, _ = run(capsys, "solve", file, "--out", tmp_path / "one")
    done = over(2, "solve", file, "--out", tmp_path / "two")
    assert (done.returncode, done.stderr) == (status, "")
    expected = numbers_out(out).replace(str(tmp_path / "one"), str(tmp_path / "two"))
    assert numbers_out(done.stdout) == expected
    assert re.search(r"^ranks +2, which keep values of 0\.\d+ cells of others", done.stdout, re.M)
    assert lm.verify(tmp_path / "two").holds
    status, out, _ = run(capsys, "verify", tmp_path / "two")
    done = over(2, "verify", tmp_path / "two")
    assert (done.returncode, done.stderr) == (status, "")
    assert numbers_out(done.stdout) == numbers_out(out)
    for more in (["--starts", "50"], ["--from", "0.1,0.2", "--json"]):
        _, out, _ = run(capsys, "simulate", tmp_path / "two", *more)
        done = over(2, "simulate", tmp_path / "two", *more)
        assert (done.returncode, done.stdout) == (0, out)
    done = over(2, "simulate", tmp_path / "two", "--starts", "0")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


@needs_mpi
def test_json_is_one_object_with_all_keys(tmp_path, file, capsys):
    status, out, _ = run(capsys, "solve", file, "--json", "--gamma", "1.01")
    done = over(2, "solve", file, "--json", "--gamma", "1.01")
    assert (done.returncode, done.stderr) == (status, "")
    ours, theirs = json.loads(done.stdout), json.loads(out)
    assert list(ours) == list(theirs)
    apart = ("seconds", "cost", "lower_bound", "gap", "contraction", "message")
    assert {k: v for k, v in ours.items() if k not in apart} == {
        k: v for k, v in theirs.items() if k not in apart
    }
    assert ours["cost"] == pytest.approx(theirs["cost"], rel=1e-12)


REFUSED = {
    "another backend": (["solve", "FILE", "--backend", "highs"], "--backend: does not run over"),
    "a proof": (["solve", "FILE", "--proved", "0.9"], "--proved: does not run over"),
    "no file": (["solve", "none.json"], "cannot read 'none.json': no such file"),
    "an option": (["solve", "FILE", "--tolerance", "-1"], "tolerance: -1.0 must be"),
    "gamma": (["solve", "FILE", "--gamma", "0"], "gamma: "),
    "a place": (["solve", "FILE", "--out", "FILE"], "out: .* is no directory"),
    "compare": (["compare", "FILE"], "lmdsl compare does not run over several ranks"),
    "check": (["check", "FILE"], "lmdsl check does not run over several ranks"),
    "usage": (["solve"], "usage: lmdsl solve"),
}


FEW = ("another backend", "no file", "compare", "usage")


@needs_mpi
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.full] * (case not in FEW)) for case in REFUSED]
)
def test_what_is_refused_is_said_once(file, case):
    arguments, message = REFUSED[case]
    done = over(2, *(file if text == "FILE" else text for text in arguments))
    assert (done.returncode, done.stdout) == (2, "")
    assert len(re.findall(message, done.stderr)) == 1
    assert case == "usage" or done.stderr.count("\n") == 1


@needs_mpi
def test_a_refusal_as_json(file):
    done = over(2, "solve", file, "--json", "--gamma", "-1")
    assert done.returncode == 2
    assert json.loads(done.stdout)["status"] == "bad_input"


@needs_mpi
def test_not_stabilizable_is_3(file, tmp_path):
    done = over(2, "solve", file, "--gamma", "9", "--out", tmp_path / "out")
    assert (done.returncode, done.stderr) == (3, "")
    assert done.stdout.count("\nstatus     not_stabilizable\n") == 1
    assert lm.verify(tmp_path / "out").holds


@needs_mpi
def test_what_takes_a_moment_is_done_by_the_first():
    done = over(2, "backends", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert "policy-iteration" in json.loads(done.stdout)


@needs_mpi
def test_ranks_that_see_different_things_are_refused(file, tmp_path):
    """Commands, files of one name, and folders."""
    done = over(2, parts=[command("solve", file), command("solve", file, "--json")])
    assert done.returncode == 2
    assert done.stderr.count("ranks see different commands: rank 1 has") == 1
    other = tmp_path / "other"
    other.mkdir()
    made(standard_map(12, 1.01)).save(other / "map.json")
    place = "import os, sys; os.chdir(sys.argv[1]); from lmdsl.cli import main; " \
            "sys.exit(main(['solve', 'map.json']))"  # fmt: skip
    parts = [[sys.executable, "-c", place, str(folder)] for folder in (tmp_path, other)]
    done = over(2, parts=parts)
    assert done.returncode == 2
    assert done.stderr.count("ranks see different folders") == 1
    seen = place.replace("from", "os.getcwd = lambda: '/'; from", 1)
    parts = [[sys.executable, "-c", seen, str(folder)] for folder in (tmp_path, other)]
    done = over(2, parts=parts)
    assert done.returncode == 2
    assert done.stderr.count("ranks see different problems") == 1

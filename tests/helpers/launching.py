"""Programs of several processes, where mpi4py and a launcher are installed."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

LAUNCHER = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or shutil.which("mpiexec")

absent = LAUNCHER is None or importlib.util.find_spec("mpi4py") is None


def needs_mpi(test):
    """Mark a test that starts processes of MPI."""
    return pytest.mark.mpi(pytest.mark.skipif(absent, reason="needs mpi4py and an MPI")(test))


def launch(count, program, *arguments, script="rank_programs.py", limit=60):
    """Run a program of a script on so many processes, for seconds at most; return how it ended."""
    script = Path(__file__).with_name(script)
    command = [LAUNCHER, "-n", str(count), sys.executable, str(script), program, *arguments]
    path = os.pathsep.join((str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")))
    env = {**os.environ, "NUMBA_NUM_THREADS": "1", "PYTHONPATH": path}
    return subprocess.run(command, capture_output=True, text=True, timeout=limit, env=env)


def returned(count, program, *arguments, script="rank_programs.py"):
    """Return what every rank of a program returned."""
    done = launch(count, program, *arguments, script=script)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)

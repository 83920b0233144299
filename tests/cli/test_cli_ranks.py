"""The command line under a launcher: the same answers as of one process, said once."""

import os
import subprocess
import sys

import pytest


def alone_of(count, *arguments):
    """A process that a launcher started as one of several, without the others."""
    env = {**os.environ, "PMI_SIZE": str(count), "PMI_RANK": "1"}
    every = []
    for rank in range(count):
        command = [sys.executable, "-m", "lmdsl", *arguments]
        env["PMI_RANK"] = str(rank)
        every.append(subprocess.run(command, capture_output=True, text=True, env=env))
    return every


@pytest.mark.parametrize("command", [["compare", "none.json"], ["check", "none.json"]])
def test_commands_that_do_not_run_over_ranks_refuse_once(command):
    first, second = alone_of(2, *command)
    assert first.returncode == second.returncode == 2
    assert first.stderr.count("\n") == 1
    assert second.stderr == first.stdout == second.stdout == ""

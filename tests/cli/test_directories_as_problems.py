"""Where a problem file is taken, a result directory is: its problem, a finite model's whole."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import run
from problems import made, steps

import lmdsl as lm

COMMANDS = ("check", "explain", "gamma-max", "solve", "compare")


def finite():
    P = np.array([[[0, 0.5, 0.5, 0], [0, 0.9, 0.1, 0], [0, 0, 1, 0], [0, 0, 0, 1]]] * 2)
    return lm.from_matrices(P, np.ones((4, 2)), [2])


def saved(problem, out):
    result = lm.solve(problem)
    result.save(out)
    return result


@pytest.mark.parametrize("command", COMMANDS)
def test_a_directory_says_what_its_file_says(command, capsys, tmp_path):
    out = tmp_path / "out"
    saved(made(steps()), out)
    of_directory = run(capsys, command, out, "--json")
    of_file = run(capsys, command, out / "problem.json", "--json")
    status = of_directory[0]
    assert status == of_file[0]
    first, second = json.loads(of_directory[1]), json.loads(of_file[1])
    for one in (first, second):
        for report in one.get("results", [one]):
            report.pop("seconds", None)
            report.pop("simulation", None)
        for key in ("seconds", "memory", "available"):
            one.get("expected", {}).pop(key, None)
    assert first == second


@pytest.mark.parametrize("command", COMMANDS)
def test_finite_models_have_the_directory_alone(command, capsys, tmp_path):
    out = tmp_path / "out"
    result = saved(finite(), out)
    status, text, _ = run(capsys, command, out, *(["--json"] if command != "explain" else []))
    assert status in (0, 1)
    if command == "explain":
        assert "state" in text
    if command == "solve":
        assert json.loads(text)["cost"] == result.cost
    status, _, error = run(capsys, command, out / "problem.json")
    assert status == 2
    assert "from_matrices" in error


def test_a_finite_model_is_solved_again_into_its_own_directory(capsys, tmp_path):
    out = tmp_path / "out"
    saved(finite(), out)
    assert run(capsys, "solve", out, "--gamma", "1.01", "--out", out)[0] == 0
    assert lm.Result.load(out).gamma == 1.01
    assert lm.verify(out).holds


def test_what_is_neither(capsys, tmp_path):
    status, _, error = run(capsys, "explain", tmp_path)
    assert status == 2
    assert "cannot read" in error
    file = tmp_path / "problem.json"
    file.write_text(json.dumps(steps()))
    for command in ("verify", "simulate", "plot"):
        status, _, error = run(capsys, command, file)
        assert status == 2
        assert "is not a result directory; `lmdsl solve FILE --out DIR` makes one" in error


def test_functions_are_not_in_a_directory(capsys, tmp_path):
    own = lm.systems.FunctionSystem(next=lambda x, u: {"x": x - 0.25 * u})
    out = tmp_path / "out"
    saved(lm.Problem(**{**steps(), "system": own}), out)
    status, _, error = run(capsys, "explain", out)
    assert status == 2
    assert "came from a Python function, which a directory does not hold" in error

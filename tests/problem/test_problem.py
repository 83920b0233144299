"""The problem file: what is accepted, what is refused, and with which words."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest
from bad_files import BAD, NOISE, RAW
from problems import made, standard_map, steps
from random_problems import CORNER_CASES, random_problem

import lmdsl as lm


@pytest.mark.parametrize(("data", "path", "word"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_bad_problems_are_refused_by_name(tmp_path, data, path, word):
    file = tmp_path / "bad.json"
    file.write_text(json.dumps(data))
    with pytest.raises(lm.BadInput) as caught:
        lm.compile(lm.load(file))
    message = str(caught.value)
    assert path in message
    assert word in message
    assert "\n" not in message
    assert len(message) < 600


@pytest.mark.parametrize(("content", "word"), [r[1:] for r in RAW], ids=[r[0] for r in RAW])
def test_hostile_files_are_refused(tmp_path, content, word):
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    with pytest.raises(lm.BadInput, match=word or ".") as caught:
        lm.load(file)
    assert "\n" not in str(caught.value)


def test_a_file_too_large(tmp_path):
    file = tmp_path / "large.json"
    file.write_bytes(b" " * (16 * 2**20 + 1))
    with pytest.raises(lm.BadInput, match="larger than"):
        lm.load(file)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_does_not_hang(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(lm.BadInput, match="regular file"):
        lm.load(tmp_path / "pipe")


def test_missing_file_directory_and_odd_paths(tmp_path):
    for path in (tmp_path / "none.json", tmp_path, "a\0b"):
        with pytest.raises(lm.BadInput):
            lm.load(path)


@pytest.mark.parametrize("seed", range(40))
def test_load_save_load_is_the_identity(tmp_path, seed):
    data = random_problem(np.random.default_rng(seed))
    _round_trip(tmp_path, data)


def test_corner_cases_round_trip(tmp_path):
    for data in (*CORNER_CASES, standard_map(), steps(noise=NOISE)):
        _round_trip(tmp_path, data)


def _round_trip(tmp_path, data):
    first, second = tmp_path / "first.json", tmp_path / "second.json"
    first.write_text(json.dumps(data))
    problem = lm.load(first)
    problem.save(second)
    again = lm.load(second)
    assert again == problem
    assert list(again.state_box) == list(data["state_box"])
    assert list(again.control_grid) == list(data["control_grid"])
    again.save(first)
    assert first.read_bytes() == second.read_bytes()


def test_problems_are_frozen():
    problem = made(steps())
    with pytest.raises(Exception, match="frozen"):
        problem.gamma = 2.0
    with pytest.raises(TypeError, match="frozen"):
        problem.state_box["x"] = 1
    with pytest.raises(TypeError, match="frozen"):
        problem.system.next["x"] = "0"


def test_python_declaration_equals_the_file():
    from lmdsl.problem import Attractor, Axis, ControlRange, Problem, Random
    from lmdsl.systems import StandardMap

    problem = Problem(
        name="standard map, period-two orbit",
        system=StandardMap(parameters={"K": 0.25}),
        state_box={
            "x": Axis(low=0, high=1, cells=np.int64(50), periodic=True),
            "y": Axis(low=0.0, high=np.float64(1), cells=50, periodic=True),
        },
        attractor=Attractor(points=[(0.25, 0.5), np.array([0.75, 0.5])]),
        control_grid={"u": ControlRange(low=-0.5, high=0.5, points=21)},
        stage_cost="x**2 + y**2 + u**2",
        sampling=Random(points=10),
        gamma=1.02,
    )
    a, b = lm.compile(problem), lm.compile(made(standard_map()))
    assert a.digest == b.digest


def test_python_errors_are_bad_input_too():
    from lmdsl.problem import Axis

    with pytest.raises(lm.BadInput, match="less than"):
        Axis(low=1, high=0, cells=3)
    with pytest.raises(lm.BadInput, match="cells"):
        Axis(low=0, high=1, cells=0)
    assert issubclass(lm.BadInput, ValueError)


def test_function_system_equals_formulas():
    from lmdsl.systems import FunctionSystem

    data = standard_map(20)

    def kick(x, y, u, K):
        p = y + K * u * np.sin(2 * np.pi * x)
        return {"x": x + y + K * u * np.sin(2 * np.pi * x), "y": p}

    problem = made(data)
    own = problem.replaced(system=FunctionSystem(next=kick, parameters={"K": 0.25}))
    np.testing.assert_array_equal(lm.solve(own).control_index, lm.solve(problem).control_index)
    with pytest.raises(lm.BadInput, match="FunctionSystem"):
        own.to_dict()


def test_function_system_that_returns_nonsense():
    from lmdsl.systems import FunctionSystem

    problem = made(steps())
    for function, word in (
        (lambda x, u: {"y": x}, "returned"),
        (lambda x, u: (x, x), "2 images"),
    ):
        with pytest.raises(lm.BadInput, match=word):
            lm.solve(problem.replaced(system=FunctionSystem(next=function)))


def test_named_systems_name_what_they_need():
    henon = dict(lm.systems.NAMED["henon_map"].problem)
    with pytest.raises(lm.BadInput, match=r"control_grid: henon_map has the control u"):
        made({**henon, "control_grid": {}})
    box = {"x": henon["state_box"]["x"]}
    with pytest.raises(lm.BadInput, match=r"state_box: henon_map has the states x, y"):
        made({**henon, "state_box": box, "attractor": {"points": [[0.6]]}})


def test_kind_comes_first_in_a_saved_file():
    saved = made(standard_map()).to_dict()
    assert all(next(iter(saved[key])) == "kind" for key in ("system", "sampling"))


def test_keys_in_paths_are_printable():
    """A key of a file may hold anything; a message is one line that a terminal shows as it is."""
    data = standard_map(4)
    data["system"] = {"kind": "map", "next": {"\x1b[2J": "open(x)", "x": "q", "y": "y"}}
    with pytest.raises(lm.BadInput) as caught:
        made(data)
    assert str(caught.value).isprintable()

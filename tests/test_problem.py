"""The problem file: what is accepted, what is refused, and with which words."""

from __future__ import annotations

import copy
import json
import os

import numpy as np
import pytest
from problems import doubling, made, standard_map, steps
from random_problems import CORNER_CASES, random_problem

import lmdsl as lm


def changed(*path, value, base=None):
    data = copy.deepcopy(base or steps())
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return data


def without(*path):
    data = steps()
    place = data
    for key in path[:-1]:
        place = place[key]
    del place[path[-1]]
    return data


NOISE = {"w": {"values": [0, 1], "weights": [0.5, 0.5]}}

# (what is wrong, the data, a word of the path, a word of the message)
BAD = [
    ("unknown key", changed("gama", value=1.1), "gama", "unknown key"),
    ("unknown nested key", changed("state_box", "x", "cell", value=1), "state_box.x.cell", ""),
    ("missing format", without("format"), "format", "missing"),
    ("missing system", without("system"), "system", "missing"),
    ("missing cost", without("stage_cost"), "stage_cost", "missing"),
    ("missing sampling", without("sampling"), "sampling", "missing"),
    ("missing box", without("state_box"), "state_box", "missing"),
    ("missing attractor", without("attractor"), "attractor", "missing"),
    ("missing grid", without("control_grid"), "control_grid", "missing"),
    ("format of the future", changed("format", value="lmdsl/2"), "format", "lmdsl/1"),
    ("gamma zero", changed("gamma", value=0), "gamma", "greater than 0"),
    ("gamma negative", changed("gamma", value=-1), "gamma", "-1"),
    ("gamma string", changed("gamma", value="1"), "gamma", "'1'"),
    ("gamma true", changed("gamma", value=True), "gamma", "True"),
    ("gamma null", changed("gamma", value=None), "gamma", "null"),
    ("gamma list", changed("gamma", value=[1]), "gamma", ""),
    ("cells zero", changed("state_box", "x", "cells", value=0), "state_box.x.cells", "0"),
    ("cells float", changed("state_box", "x", "cells", value=4.0), "state_box.x.cells", "4.0"),
    ("cells string", changed("state_box", "x", "cells", value="4"), "state_box.x.cells", ""),
    ("cells huge", changed("state_box", "x", "cells", value=10**12), "state_box", "memory"),
    ("cells 300 digits", changed("state_box", "x", "cells", value=10**300), "state_box", ""),
    ("low above high", changed("state_box", "x", "low", value=2), "state_box.x", "less than"),
    ("low equals high", changed("state_box", "x", "low", value=1), "state_box.x", "less than"),
    ("periodic number", changed("state_box", "x", "periodic", value=1), "periodic", "1"),
    ("no axis", changed("state_box", value={}), "state_box", ""),
    ("box list", changed("state_box", value=[]), "state_box", ""),
    ("17 axes", changed("state_box", value={f"x{i}": {"low": 0, "high": 1, "cells": 1}
                                            for i in range(17)}), "state_box", "16"),
    ("bad axis name", changed("state_box", value={"x y": {"low": 0, "high": 1, "cells": 1}}),
     "state_box", "x y"),
    ("keyword axis", changed("state_box", value={"lambda": {"low": 0, "high": 1, "cells": 1}}),
     "state_box", "lambda"),
    ("function as axis", changed("state_box", value={"sin": {"low": 0, "high": 1, "cells": 1}}),
     "state_box", "sin"),
    ("constant as axis", changed("state_box", value={"pi": {"low": 0, "high": 1, "cells": 1}}),
     "state_box", "pi"),
    ("unicode axis", changed("state_box", value={"é": {"low": 0, "high": 1, "cells": 1}}),
     "state_box", ""),
    ("long name", changed("state_box", value={"x" * 65: {"low": 0, "high": 1, "cells": 1}}),
     "state_box", "64"),
    ("state is control", changed("control_grid", value={"x": {"values": [0]}}), "control_grid",
     "'x'"),
    ("parameter is state", changed("system", "parameters", value={"x": 1}), "system.parameters",
     "'x'"),
    ("parameter string", changed("system", "parameters", value={"k": "1"}), "system.parameters.k",
     "'1'"),
    ("unknown kind", changed("system", "kind", value="maps"), "system", "map"),
    ("no kind", without("system", "kind"), "system", "kind"),
    ("kind number", changed("system", "kind", value=3), "system", "kind"),
    ("kind function", changed("system", value={"kind": "function"}), "system", "Python"),
    ("no formula", changed("system", "next", value={}), "system.next", "'x'"),
    ("formula too many", changed("system", "next", value={"x": "x", "z": "x"}), "system.next",
     "'z'"),
    ("formula number", changed("system", "next", value={"x": 1}), "system.next.x", "1"),
    ("formula fault", changed("system", "next", "x", value="x +"), "system.next.x", "character"),
    ("formula name", changed("system", "next", "x", value="x + y"), "system.next.x", "'y'"),
    ("formula code", changed("system", "next", "x", value="__import__('os').system('true')"),
     "system.next.x", "character"),
    ("ode step", changed("system", value={"kind": "ode", "derivative": {"x": "u"}, "step": 0}),
     "system.step", "greater than 0"),
    ("ode substeps", changed("system", value={"kind": "ode", "derivative": {"x": "u"}, "step": 1,
                                              "substeps": 1001}), "system.substeps", "1000"),
    ("named parameter", changed("system", value={"kind": "standard_map",
                                                 "parameters": {"k": 1}}), "system.parameters",
     "K"),
    ("empty attractor", changed("attractor", value={}), "attractor", "no attractor cell"),
    ("attractor cell outside", changed("attractor", "cells", value=[[4]]), "attractor.cells[0]",
     "0..3"),
    ("attractor cell negative", changed("attractor", "cells", value=[[-1]]),
     "attractor.cells[0][0]", "-1"),
    ("attractor cell 2-D", changed("attractor", "cells", value=[[1, 1]]), "attractor.cells[0]",
     "2 indices"),
    ("attractor point outside", changed("attractor", value={"points": [[1.1]]}),
     "attractor.points[0].x", "1.1"),
    ("attractor point name", changed("attractor", value={"points": [{"y": 0}]}),
     "attractor.points[0]", "x"),
    ("attractor point short", changed("attractor", value={"points": [[]]}),
     "attractor.points[0]", "0 coordinates"),
    ("attractor box empty", changed("attractor", value={"boxes": [{"x": [0.5, 0.5]}]}),
     "attractor.boxes[0].x", "a < b"),
    ("attractor box name", changed("attractor", value={"boxes": [{"y": [0, 1]}]}),
     "attractor.boxes[0]", "'y'"),
    ("attractor box of no cell", changed("attractor", value={"boxes": [{"x": [0.3, 0.4]}]}),
     "attractor", "no cell"),
    ("attractor box triple", changed("attractor", value={"boxes": [{"x": [0, 1, 2]}]}),
     "attractor.boxes[0].x", ""),
    ("attractor and avoid", changed("avoid", value={"boxes": [{"x": [0, 0.1]}]}), "avoid", "both"),
    ("periodic box over the seam", changed("attractor", value={"boxes": [{"x": [0.5, 1.5]}]},
                                           base=doubling()), "attractor.boxes[0].x", "seam"),
    ("avoid without boxes", changed("avoid", value={"boxes": []}), "avoid.boxes", ""),
    ("control twice", changed("control_grid", "u", value={"values": [0, 0.0]}),
     "control_grid.u.values", "twice"),
    ("control empty", changed("control_grid", "u", value={"values": []}), "control_grid.u.values",
     ""),
    ("control one point", changed("control_grid", "u", value={"low": 0, "high": 1, "points": 1}),
     "control_grid.u", "low == high"),
    ("control reversed", changed("control_grid", "u", value={"low": 1, "high": 0, "points": 3}),
     "control_grid.u", "less than"),
    ("control both forms", changed("control_grid", "u", value={"values": [0], "low": 1}),
     "control_grid.u.low", "unknown key"),
    ("control many", changed("control_grid", "u", value={"low": 0, "high": 1, "points": 10**13}),
     "", "memory"),
    ("cost negative", changed("stage_cost", value="x - 0.5"), "stage_cost", ">= 0"),
    ("cost infinite", changed("stage_cost", value="1/(x - x)"), "stage_cost", "finite"),
    ("cost not a number", changed("stage_cost", value="sqrt(x - 0.5)"), "stage_cost", "finite"),
    ("cost list", changed("stage_cost", value=["1"]), "stage_cost", ""),
    ("cost name", changed("stage_cost", value="v"), "stage_cost", "'v'"),
    ("noise sum", changed("noise", value={"w": {"values": [0, 1], "weights": [0.5, 0.6]}}),
     "noise.w.weights", "1.1"),
    ("noise negative", changed("noise", value={"w": {"values": [0, 1], "weights": [1.5, -0.5]}}),
     "noise.w.weights[1]", "-0.5"),
    ("noise huge", changed("noise", value={"w": {"values": [0, 1], "weights": [1e308, 1e308]}}),
     "noise.w.weights[0]", "1e+308"),
    ("noise lengths", changed("noise", value={"w": {"values": [0], "weights": [0.5, 0.5]}}),
     "noise.w.weights", "2 weights"),
    ("noise std", changed("noise", value={"w": {"normal": {"std": -1, "points": 3}}}),
     "noise.w.normal.std", "-1"),
    ("noise points", changed("noise", value={"w": {"normal": {"std": 1, "points": 65}}}),
     "noise.w.normal.points", "64"),
    ("noise is control", changed("noise", value={"u": NOISE["w"]}), "noise", "'u'"),
    ("sampling kind", changed("sampling", value={"kind": "halton", "points": 3}), "sampling",
     "grid"),
    ("sampling zero", changed("sampling", value={"kind": "random", "points": 0}),
     "sampling.points", "0"),
    ("sampling seed", changed("sampling", value={"kind": "random", "points": 1, "seed": -1}),
     "sampling.seed", "-1"),
    ("sampling huge", changed("sampling", value={"kind": "grid", "per_axis": 10**14}), "",
     "memory"),
    ("sampling random huge", changed("sampling", value={"kind": "random", "points": 10**14}), "",
     "memory"),
    ("on_exit", changed("on_exit", value="wrap"), "on_exit", "clip"),
    ("measure of no cell", changed("measure", value={"boxes": [{"x": [0.1, 0.2]}]}),
     "measure.boxes", "no cell"),
    ("cost mean overflows", changed("stage_cost", value="1e308"), "stage_cost", "overflows"),
    ("cells 310 digits", changed("state_box", "x", "cells", value=10**310), "state_box.x.cells",
     ""),
    ("points 310 digits", changed("control_grid", "u", value={"low": 0, "high": 1,
                                                              "points": 10**310}), "points", ""),
    ("per_axis 310 digits", changed("sampling", value={"kind": "grid", "per_axis": 10**310}),
     "sampling.per_axis", ""),
    ("many booleans", changed("control_grid", "u", value={"values": [True] * 50_000}),
     "control_grid.u.values[0]", "True"),
    ("many boxes", changed("avoid", value={"boxes": [{}] * 10_001}), "avoid.boxes", "10000"),
    ("name number", changed("name", value=3), "name", "3"),
]  # fmt: skip


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


RAW = [
    ("not JSON", b"{", "not JSON"),
    ("empty", b"", "not JSON"),
    ("a list", b"[]", "one JSON object"),
    ("a number", b"3", "one JSON object"),
    ("not UTF-8", b'{"format": "\xff"}', "UTF-8"),
    ("UTF-16", '{"a": 1}'.encode("utf-16"), ""),
    ("duplicate key", b'{"format": "lmdsl/1", "format": "lmdsl/1"}', "twice"),
    ("duplicate nested key", b'{"state_box": {"x": 1, "x": 2}}', "state_box"),
    ("NaN", json.dumps(steps(float("nan"))).encode(), "gamma"),
    ("infinity", json.dumps(steps(float("inf"))).encode(), "gamma"),
    ("overflow", json.dumps(steps()).replace('"gamma": 1.0', '"gamma": 1e999').encode(), "gamma"),
    ("5,000 digits", json.dumps(steps()).replace('"gamma": 1.0', f'"gamma": {"9" * 5000}').encode(),
     "5000 digits"),
    ("400 digits", json.dumps(steps()).replace('"cells": 4', f'"cells": {"9" * 400}').encode(),
     "cells"),
    ("310 digits", json.dumps(steps()).replace('"gamma": 1.0', f'"gamma": {"9" * 310}').encode(),
     "gamma"),
    ("lone surrogate", json.dumps({**steps(), "name": "\ud800"}).encode(), "surrogate"),
    ("surrogate key", json.dumps({**steps(), "\udfff": 1}).encode(), "surrogate"),
    ("nested arrays", b"[" * 100_000, "nested"),
    ("closed nested arrays", b"[" * 100_000 + b"]" * 100_000, "nested"),
    ("nested objects", b'{"a":' * 100_000 + b"1" + b"}" * 100_000, "nested"),
    ("nested in a field", json.dumps(steps()).replace('"1"', "[" * 900 + "]" * 900).encode(), ""),
    ("trailing text", json.dumps(steps()).encode() + b"x", "not JSON"),
    ("comment", b"// hello\n{}", "not JSON"),
    ("NUL", b"\x00", "not JSON"),
]  # fmt: skip


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
    from lmdsl.problem.problem import Attractor, Axis, ControlRange, Problem, Random
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
    from lmdsl.problem.problem import Axis

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

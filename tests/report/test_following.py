"""What the page runs by itself is what was compiled: the same operations, cells and steps."""

from __future__ import annotations

import json

import numpy as np
import pytest
from formula_texts import UFUNCS
from problems import made, standard_map, steps
from reports import SCRIPTS, followed, node, told

import lmdsl as lm
from lmdsl.formulas.language import parse, parse_condition
from lmdsl.formulas.operations import OPERATIONS
from lmdsl.formulas.program import Program
from lmdsl.report.browser import packed, program_of, samples_of, unpacked
from lmdsl.systems import FunctionSystem

RUN = "return data.starts.map((x) => F.run(x, 60, 1));"


@pytest.mark.parametrize("kind", ["u1", "<u2", "<i4", "<f4", "<f8"])
def test_arrays_survive(kind):
    array = np.arange(24).astype(kind).reshape(2, 3, 4)
    assert np.array_equal(unpacked(packed(array)), array)
    assert unpacked(packed(array)).dtype == array.dtype


@node
def test_every_operation_is_known():
    """Of each operation of the language the same values, at states with both signs and zero."""
    texts = [
        f"{name}({', '.join('xyz'[: f.nin])})" for name, f in UFUNCS.items() if name != "where"
    ]
    texts += [f"x {sign} y" for sign in ("+", "-", "*", "/", "**")]
    texts += ["-x", "x**2", "where(x < y, x, z)", "where(not (x < y and y >= z) or x == z, 1, 2)",
              "where(x != y, 1, 2)", "where(x <= y, 1, 2)", "where(x > y, 1, 2)"]  # fmt: skip
    program = Program([parse(text, "xyz") for text in texts])
    assert {*OPERATIONS} <= {*program.operations}
    states = [
        (0.3, 0.8, -0.4),
        (-0.3, 0.8, 0.3),
        (0.0, -0.5, 0.0),
        (2.0, 2.0, -3.0),
        (-2.5, 1.5, 1),
    ]
    code = f"""const run = f.compiled(data.program);
    return {json.dumps(states)}.map(([x, y, z]) => run({{ x, y, z }}).map(String));"""
    found = followed({"program": program_of(program)}, code)
    for state, row in zip(states, found, strict=True):
        with np.errstate(all="ignore"):
            wanted = program(dict(zip("xyz", state, strict=True)))
        for text, a, b in zip(texts, wanted, row, strict=True):
            word = float(b.replace("Infinity", "inf"))
            assert np.isclose(a, word, rtol=1e-14, atol=1e-300, equal_nan=True), (text, state)


@node
@pytest.mark.parametrize("name", ["maze", "lorenz", "logistic", "standard"])
def test_runs_are_those_of_the_compiled_steps(solved, name):
    result = solved(name)
    data = told(result)
    for start, run in zip(data["starts"], followed(data, RUN), strict=True):
        path = result.closed_loop.path(start, 60, as_compiled=True)
        states = np.array(run["states"])
        assert states.shape == path.shape
        assert np.allclose(states, path, rtol=0, atol=1e-9 if name != "logistic" else 1e-3)
        (end,) = result.partition.locate(list(path[-1:].T))
        assert (run["outcome"] == "reached A") == (end >= 0 and result.cell_status[end] == 0)


@node
def test_costs_of_runs_are_those_of_the_model():
    """x+ = x - 0.25 u: from cell k the run takes k steps, of cost 1 each, weighed by 1.5^n."""
    result = lm.solve(made(steps(1.5, terminal_cost="2 + x")))
    data = told(result)
    code = "return [1, 2, 3].map((k) => F.run([(k + 0.5) / 4], 60, 1));"
    for k, run in enumerate(followed(data, code), 1):
        want = sum(1.5**n for n in range(k)) + 1.5**k * (2 + 0.125)
        assert run["cost"] == pytest.approx(want, rel=1e-12)
        assert len(run["controls"]) == k


@node
@pytest.mark.parametrize("kind", ["map", "ode"])
def test_names_that_objects_have_are_names_of_states(kind):
    """JavaScript knows __proto__ and constructor of every object."""
    names = ("__proto__", "constructor", "u")
    image = {"__proto__": "__proto__ - 0.25*u", "constructor": "constructor"}
    rate = {"__proto__": "-0.25*u", "constructor": "0*constructor"}
    system = {"map": {"kind": "map", "next": image},
              "ode": {"kind": "ode", "derivative": rate, "step": 1.0}}[kind]  # fmt: skip
    box = {name: {"low": 0, "high": 1, "cells": 4} for name in names[:2]}
    result = lm.solve(made(steps(system=system, state_box=box,
                                 attractor={"boxes": [{"__proto__": [0, 0.25]}]})))  # fmt: skip
    data = told(result)
    for start, run in zip(data["starts"], followed(data, RUN), strict=True):
        path = result.closed_loop.path(start, 60, as_compiled=True)
        assert np.allclose(run["states"], path)
        assert run["outcome"] == "reached A"


@node
def test_samples_go_where_the_rows_say(solved):
    result = solved("maze")
    data, lp = told(result), result.lp
    code = f"""const o = await f.unpacked(data.samples.offsets);
    const w = await f.unpacked(data.samples.nodes);
    return {json.dumps(lp.cells.tolist())}.map((cell) => F.samples(cell, o, w));"""
    columns = np.array([lp.column(int(c), int(result.control_index[c])) for c in lp.cells])
    P = lp.rows.take(columns).matrix().toarray()
    for row, found in zip(P, followed(data, code), strict=True):
        share = np.zeros(result.partition.size)
        for sample in found:
            share[sample["cell"]] += sample["share"]
        assert np.allclose(share[lp.cells], row, atol=1e-12)


@node
def test_noise_is_drawn_from_what_was_declared():
    noise = {
        "a": {"values": [-1, 2], "weights": [0.25, 0.75]},
        "b": {"uniform": {"low": 1, "high": 3, "points": 2}},
        "c": {"normal": {"std": 0.5, "points": 3}},
    }
    data = steps(system={"kind": "map", "next": {"x": "x - 0.25*u + 0*(a + b + c)"}}, noise=noise)
    code = """const random = f.dice(3), all = [];
    for (let n = 0; n < 20000; n++) all.push(F.draw(random));
    return all;"""
    a, b, c = np.array(followed(told(lm.solve(made(data))), code)).T
    assert set(a) == {-1.0, 2.0}
    assert np.mean(a == 2) == pytest.approx(0.75, abs=0.02)
    assert (b.min() >= 1, b.max() <= 3) == (True, True)
    assert b.mean() == pytest.approx(2, abs=0.02)
    assert (c.mean(), c.std()) == (pytest.approx(0, abs=0.02), pytest.approx(0.5, abs=0.02))


@node
def test_a_function_is_followed_by_the_rows_of_the_model():
    held = steps()
    held["system"] = FunctionSystem(next=lambda x, u: {"x": x - 0.25 * u})
    result = lm.solve(lm.Problem(**held))
    data = told(result)
    assert data["map"] is None
    assert data["rows"] is not None
    for start, run in zip(data["starts"], followed(data, RUN), strict=True):
        assert run["outcome"] == "reached A"
        assert len(run["controls"]) == int(4 * start[0]) == run["cost"]


@node
def test_a_page_does_not_hang(solved):
    """Runs and samples end when their time is up, whatever a file asks for."""
    code = """let now = 0;
    Date.now = () => (now += 200);
    const o = await f.unpacked(data.samples.offsets), w = await f.unpacked(data.samples.nodes);
    F.ending = () => null;
    F.control = () => [0];
    return [F.run(data.starts[0], 1e9, 1), F.samples(0, o, w).length];"""
    run, samples = followed(told(solved("standard")), code)
    assert run["outcome"] is None
    assert (len(run["controls"]), samples) == (2, 2)


def test_many_samples_are_thinned():
    problem = made(standard_map(4, sampling={"kind": "grid", "per_axis": 30}))
    found = samples_of(problem)
    assert not found["all"]
    assert found["points"] == 900
    assert found["offsets"]["shape"] == [400, 2]


def test_conditions_are_values_too():
    """A condition of the language is 1 where it holds: the page treats it likewise."""
    program = Program([parse_condition("x < 1 and not x < 0", "x")])
    assert program_of(program)["code"][-1][0] == "and"


# What is drawn of runs -----------------------------------------------------------------------


@node
def test_runs_of_equations_are_drawn_along_their_arcs():
    """x' = y, y' = -x, three Runge-Kutta steps a sampling time: on a circle, not on a polygon."""
    box = {"low": -2, "high": 2, "cells": 16}
    data = steps(system={"kind": "ode", "derivative": {"x": "y", "y": "-x + 0*u"}, "step": 1.2,
                         "substeps": 3, "judged": "endpoint"},
                 state_box={"x": box, "y": box}, attractor={"points": [[0.05, 0.05]]},
                 control_grid={"u": {"values": [0]}})  # fmt: skip
    code = """F.control = () => [0];
    F.ending = () => null;
    return F.run([1, 0], 4, 1);"""
    run = followed(told(lm.solve(made(data))), code)
    times, drawn = np.array(run["times"]), np.array(run["drawn"])
    assert len(times) == len(drawn) > 4 * 3 * 2
    assert (np.diff(times) > 0).all()
    angle = 1.2 * times
    assert np.allclose(drawn, np.stack([np.cos(angle), -np.sin(angle)], axis=-1), atol=3e-3)
    middle = (drawn[1:] + drawn[:-1]) / 2
    assert np.abs(np.hypot(*middle.T) - 1).max() < 5e-3
    at = np.searchsorted(times, np.arange(5) - 1e-9)
    assert np.allclose(drawn[at], run["states"], atol=0)


@node
def test_what_is_drawn_ends_where_a_run_is_stopped_on_its_way(solved):
    for run in followed(told(solved("lorenz")), RUN):
        assert len(run["times"]) == len(run["drawn"])
        assert run["drawn"][-1] == run["states"][-1]
        n = len(run["controls"])
        assert max(n - 1, 0) <= run["times"][-1] <= n


def lines(points, axes):
    """The lines between points, as pieces."""
    code = f"""const {{ lineOf }} = require({json.dumps(str(SCRIPTS / "curves.js"))});
    return lineOf({json.dumps(points)}, {json.dumps(axes)});"""
    x, y = followed({}, code)
    pieces = [[]]
    for point in zip(x, y, strict=True):
        if point == (None, None):
            pieces.append([])
        else:
            pieces[-1].append([pytest.approx(v, abs=1e-12) for v in point])
    return pieces


CIRCLE = {"low": -3, "high": 3, "periodic": True}
FREE = {"low": -3, "high": 3, "periodic": False}


@node
def test_lines_are_broken_at_the_seam():
    """They go to one edge and begin at the other: of a run over time, and in the plane."""
    assert lines([[0, 2.5], [1, -2.5]], [None, CIRCLE]) == [
        [[0, 2.5], [0.5, 3]], [[0.5, -3], [1, -2.5]]]  # fmt: skip
    assert lines([[-2.5, 0], [2.75, 1]], [CIRCLE, FREE]) == [
        [[-2.5, 0], [-3, 2 / 3]], [[3, 2 / 3], [2.75, 1]]]  # fmt: skip
    assert lines([[2.75, 2.5], [-2.5, -2.5]], [CIRCLE, CIRCLE]) == [
        [[2.75, 2.5], [3, 2.5 + 1 / 3]], [[-3, 2.5 + 1 / 3], [-2.875, 3]],
        [[-2.875, -3], [-2.5, -2.5]]]  # fmt: skip
    assert lines([[-3, 0], [3, 1]], [CIRCLE, FREE]) == [[[-3, 0], [-3, 0]], [[3, 0], [3, 1]]]
    assert lines([[-2.5, 0], [2.5, 1]], [FREE, FREE]) == [[[-2.5, 0], [2.5, 1]]]

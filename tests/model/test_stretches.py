"""Compiled loops against jets: the cells that whole cells can meet are the same, edges included.

Which pairs survive is part of a model: two enclosers that differ on an edge make two models.
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from test_successor_paths import WALLS
from test_successors import PROBLEMS, declared, line
from test_successors_random import problems

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.compiled.stretches import CompiledEncloser
from lmdsl.model.successors.ranges import enclosed
from lmdsl.problem.problem import parse_problem

AXES = {"x": line(-1, 1, 20), "y": line(-1, 1, 10)}
AWKWARD = {
    "nothing moves": ({"x": "x + u*y", "y": "y + sin(u)*x + tan(u)"}, AXES),
    "by 1 and -1": ({"x": "1*x + u", "y": "-1*(-1*y)"}, AXES),
    "constants": ({"x": "0.3", "y": "u"}, AXES),
    "roots": ({"x": "sqrt(x*x) + u", "y": "sqrt(abs(x)/2)*0.3"}, AXES),
    "powers": ({"x": "x**3 - x**2 + u", "y": "1/(2 + x**-2) + y**1"}, AXES),
    "turns": ({"x": "x + 3*u", "y": "0.5*y + cos(pi*x)"},
              {"x": line(-1, 1, 16, periodic=True), "y": line(-1, 1, 8)}),
}  # fmt: skip


def coarse(name, cells, **system):
    data = dict(lm.systems.NAMED[name].problem)
    box = {
        k: {**axis, "cells": n}
        for (k, axis), n in zip(data["state_box"].items(), cells, strict=True)
    }
    return lm.Problem.model_validate({
        **data, "state_box": box, "system": {**data["system"], **system},
        "successors": "enclosed",
    })  # fmt: skip


def of_all(problem, jets, monkeypatch):
    partition = Partition.of(problem)
    with monkeypatch.context() as patched:
        if jets:
            patched.setattr(CompiledEncloser, "of", lambda *_: None)
        controls = len(control_vectors(problem))
        cell = np.repeat(np.arange(partition.size), controls)
        control = np.tile(np.arange(controls), partition.size)
        sets = CellSets.of(problem, partition)
        return enclosed(problem, partition, sets, (cell, control), Deadline())


def same(problem, monkeypatch):
    ours, theirs = (of_all(problem, jets, monkeypatch) for jets in (False, True))
    assert ours.out.tolist() == theirs.out.tolist()
    inside = ~ours.out
    assert (ours.first[inside] == theirs.first[inside]).all()
    assert (ours.last[inside] == theirs.last[inside]).all()
    return inside.any()


@pytest.mark.parametrize("name", [*PROBLEMS, "walls"])
def test_declared_problems(name, monkeypatch):
    assert same({**PROBLEMS, "walls": WALLS}[name], monkeypatch)


@pytest.mark.parametrize("name", AWKWARD)
def test_what_is_exact(name, monkeypatch):
    formulas, axes = AWKWARD[name]
    assert same(declared({"kind": "map", "next": formulas}, axes), monkeypatch)


@pytest.mark.parametrize(
    ("name", "cells", "substeps"),
    [
        ("logistic_map", (100,), {}), ("henon_map", (35, 24), {}), ("standard_map", (20, 20), {}),
        ("double_integrator", (80, 60), {}), ("van_der_pol", (6, 6), {"substeps": 2}),
        ("inverted_pendulum", (4, 4), {"substeps": 2}),
    ],
)  # fmt: skip
def test_named_systems(name, cells, substeps, monkeypatch):
    assert same(coarse(name, cells, **substeps), monkeypatch)


FLOWS = {
    "noise and a circle": ({"x": "cos(a) + w", "a": "u"}, 1),
    "one way": ({"x": "1", "a": "-0.2*a"}, 2),
    "coupled": ({"x": "sin(a)*u", "a": "w*x"}, 3),
}  # fmt: skip


@pytest.mark.parametrize("name", FLOWS)
def test_paths(name, monkeypatch):
    derivative, substeps = FLOWS[name]
    problem = declared(
        {"kind": "ode", "derivative": derivative, "step": 0.3, "substeps": substeps},
        {"x": line(-1, 1, 12), "a": line(0, 3, 9, periodic=True)},
        noise={"w": {"uniform": {"low": -0.1, "high": 0.2, "points": 2}}},
        avoid={"boxes": [{"x": [0.5, 0.7]}]},
        attractor={"boxes": [{"x": [-0.3, 0.1], "a": [0.5, 1.5]}]},
    )  # fmt: skip
    assert same(problem, monkeypatch)


@pytest.mark.long
@pytest.mark.full
@settings(
    max_examples=300, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much,
                           HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(data=problems())
def test_random_problems(data, monkeypatch):
    try:
        problem = parse_problem(data)
        CellSets.of(problem, Partition.of(problem))
    except lm.BadInput:
        assume(False)
    same(problem, monkeypatch)


@pytest.mark.parametrize("formula", ["0.3", "u"])
def test_images_that_do_not_depend_on_the_state(formula):
    axes = {"x": line(-1, 1, 8)}
    assert lm.solve(declared({"kind": "map", "next": {"x": formula}}, axes, attractor={
        "boxes": [{"x": [0.25, 0.5]}]})).verified  # fmt: skip

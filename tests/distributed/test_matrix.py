"""Every kind of problem over ranks, beside one process: statuses, causes, policies, vectors."""

import math

import matrix
import numpy as np
import pytest
from alike import alike
from launching import needs_mpi

import lmdsl as lm

pytestmark = pytest.mark.long  # in other versions it would find nothing else


@pytest.mark.parametrize("name", matrix.DOZEN)
def test_a_dozen_problems(name):
    alike(matrix.problem(name), (2, 3))


@pytest.mark.long
@pytest.mark.full
@pytest.mark.parametrize("name", [*matrix.SHIPPED, *matrix.ZOO, *matrix.RANDOM])
def test_all_shipped_systems_and_fifty_random_problems(name):
    alike(matrix.problem(name), matrix.COUNTS)


@pytest.mark.long
@pytest.mark.full
@needs_mpi
@pytest.mark.parametrize("count", matrix.PROCESSES)
@pytest.mark.parametrize("name", [*matrix.SHIPPED, *matrix.RANDOM])
def test_all_of_them_as_processes(name, count):
    assert not matrix.as_processes(count, [name])


# Kinds of problems that none of these is.

MAP = matrix.problem("standard_map")
LINE = {
    "state_box": {"x": {"low": -1, "high": 1, "cells": 31}},
    "attractor": {"boxes": [{"x": [-0.1, 0.1]}]},
    "control_grid": {"u": {"low": 0, "high": 1, "points": 3}},
    "stage_cost": "1 + u",
    "sampling": {"kind": "grid", "per_axis": 3},
}


def nearer(x, u):
    return {"x": math.copysign(max(abs(x) - 0.1 * u, 0.0), x) + 0.01 * math.sin(x)}


def half(x, u):
    return {"x": 0.5 * x - 0.1 * u}


def recorded():
    random = np.random.default_rng(0)
    x, v = random.uniform(-1, 1, (2, 6000))
    u = random.choice([-0.5, 0.0, 0.5], 6000)
    axis = {"low": -1, "high": 1, "cells": 8}
    return lm.from_data(
        {"x": x, "v": v}, {"u": u}, {"x": x + 0.3 * v, "v": 0.9 * v + 0.5 * u},
        state_box={"x": axis, "v": axis}, control_grid={"u": {"values": [-0.5, 0.0, 0.5]}},
        stage_cost="1", attractor={"boxes": [{"x": [-0.3, 0.3], "v": [-0.3, 0.3]}]},
        confidence=0.9,
    )  # fmt: skip


def matrices():
    random = np.random.default_rng(2)
    P = random.random((2, 30, 30)) * (random.random((2, 30, 30)) < 0.1)
    P[:, np.arange(30), np.maximum(np.arange(30) - 1, 0)] += 1.0
    P = np.round(64 * P / P.sum(axis=2, keepdims=True)) / 64
    P[:, np.arange(30), np.maximum(np.arange(30) - 1, 0)] += 1 - P.sum(axis=2)
    return lm.from_matrices(P, random.integers(1, 9, (30, 2)), [0], layout="states")


def function(next_, **more):
    vectorized = more.pop("vectorized", True)
    lipschitz = more.pop("lipschitz", None)
    system = lm.systems.FunctionSystem(next=next_, vectorized=vectorized, lipschitz=lipschitz)
    return lm.Problem(system=system, **LINE, **more)


KINDS = {
    "a function of one sample": lambda: function(nearer, vectorized=False),
    "a function known by its constants":
        lambda: function(half, lipschitz=[[0.5]], successors="enclosed"),
    "recorded data": recorded,
    "matrices": matrices,
    "discounted": lambda: MAP.replaced(discount=0.9, gamma=1.0),
    "without a target": lambda: MAP.replaced(discount=0.9, gamma=1.0, attractor={}),
    "gamma below 1": lambda: MAP.replaced(gamma=0.9),
    "avoided cells": lambda: MAP.replaced(avoid={"boxes": [{"x": [0.4, 0.6], "y": [0.1, 0.2]}]}),
    "a measure off C": lambda: MAP.replaced(measure={"boxes": [{"x": [0, 0.2], "y": [0, 0.2]}]}),
    "admissible pairs": lambda: MAP.replaced(admissible="x < 0.9 and u > -0.4"),
    "a free stay": lambda: MAP.replaced(stage_cost="max(0, abs(x - 0.5) - 0.2) + max(0, u)"),
    "close to gamma_bar": lambda: MAP.replaced(gamma=2.4999),
}  # fmt: skip


LONG = {"close to gamma_bar"}


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=[pytest.mark.long] * (kind in LONG)) for kind in KINDS]
)
def test_all_kinds(kind):
    alike(KINDS[kind](), (2, 3))

"""Pairs by condition: a sample at which it does not hold makes its pair inadmissible."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.model.assembly.transitions import assemble
from lmdsl.model.grid.partition import Partition


def pairs(problem):
    found = assemble(problem, Partition.of(problem))
    cell = np.repeat(found.sets.free, np.diff(found.pair_pointer))
    return set(zip(cell.tolist(), found.control.tolist(), strict=True))


def test_one_sample_is_enough():
    # Two samples a cell, at 1/4 and 3/4 of it: 0.3125, 0.4375 | 0.5625, 0.6875 | 0.8125, 0.9375
    problem = made(steps(admissible="u < 1 or x > 0.5626"))
    assert pairs(problem) == {(1, 0), (2, 0), (3, 0), (3, 1)}
    problem = made(steps(admissible="u < 1 or x > 0.5624"))
    assert pairs(problem) == {(1, 0), (2, 0), (2, 1), (3, 0), (3, 1)}
    nothing = lm.solve(made(steps(admissible="x > 2")))
    assert nothing.status == "not_stabilizable"
    everything = lm.compile(made(steps(admissible="x < 2")))
    assert everything.digest == lm.compile(made(steps())).digest


def test_undefined_does_not_hold():
    assert pairs(made(steps(admissible="sqrt(x - 0.7) >= 0"))) == {(3, 0), (3, 1)}
    assert pairs(made(steps(admissible="not sqrt(x - 0.7) < 0"))) == {
        (1, 0), (1, 1), (2, 0), (2, 1), (3, 0), (3, 1)
    }  # fmt: skip


@pytest.mark.parametrize("cells", [6, 40])
@pytest.mark.parametrize("noise", [None, {"w": {"values": [0, 0.01], "weights": [0.5, 0.5]}}])
def test_every_way_of_sampling(cells, noise):
    """Few and many cells, with and without noise, as a box of the same pairs."""
    condition = "abs(u) <= 0.3 or x + y > 1.2 and let_x < 0.9"
    problem = made(standard_map(cells, noise=noise, let={"let_x": "x*1"}, admissible=condition))
    partition = Partition.of(problem)
    grid = np.random.default_rng(0).random((10, 2))
    u = np.linspace(-0.5, 0.5, 21)
    x, y = partition.samples(np.arange(partition.size), grid)
    x, y = x[:, None, :], y[:, None, :]
    held = (np.abs(u)[None, :, None] <= 0.3) | ((x + y > 1.2) & (x < 0.9))
    allowed = held.all(axis=-1)
    attractor = lm.compile(problem.replaced(admissible=None)).cell_status == 0
    want = {(int(i), int(a)) for i, a in np.argwhere(allowed) if not attractor[i]}
    assert pairs(problem) == want


def test_the_cause_is_said_in_words():
    problem = made(steps(admissible="u < 1 or x < 0.9"))
    why = lm.explain(problem).why(3)
    assert why.cause == "trapped"
    problem = made(steps(admissible="x < 0.9"))
    found = lm.explain(problem)
    why = found.why(3)
    assert why.cause == "escapes"
    assert [move.kind for move in why.moves] == ["not admissible"] * 2
    assert why.first == (
        "u = 0 is not admissible at 50 % of the samples: the condition does not hold at "
        "x = 0.9375, u = 0"
    )
    assert "or is not admissible at one" in found.text()
    assert why.to_dict()["moves"][0]["share"] == 0.5
    assert "admissible" not in lm.explain(made(steps())).text()


def test_hints_try_admissible_controls_only():
    problem = made(steps(admissible="u < 1"))  # no hint: the control that helps is not admissible
    assert not [hint for hint in lm.explain(problem).hints if hint.kind == "finer grid"]


def gliding(**more):
    """x' = u from 0 to 10 by steps of 2 cells; A is [0, 1]."""
    data = steps(system={"kind": "ode", "derivative": {"x": "u"}, "step": 2.0}, **more)
    data["state_box"] = {"x": {"low": 0, "high": 10, "cells": 10}}
    data["control_grid"] = {"u": {"values": [-1, 1]}}
    return data


@pytest.mark.parametrize("judged", ["path", "endpoint"])
def test_the_way_of_a_step_is_not_judged(judged):
    """Of all that x meets only where a sample begins counts; a set to avoid is met on the way."""
    data = gliding(admissible="x < 4 or x > 5")
    data["system"]["judged"] = judged
    plain = {**data, "admissible": "x < 99"}
    assert pairs(made(plain)) - pairs(made(data)) == {(4, 0), (4, 1)}
    avoided = {**plain, "avoid": {"boxes": [{"x": [4, 5]}]}}
    passing = {(5, 0), (3, 1)} if judged == "path" else set()  # from 5 to 3, and back
    ending = {(6, 0), (2, 1)}
    assert pairs(made(data)) - pairs(made(avoided)) == passing | ending


def test_between_samples_and_in_runs_nothing_is_judged():
    """The condition fails at 0.55, which no sample meets; runs go through it."""
    spared = made(steps(admissible="abs(x - 0.5) > 0.06 or u < 1"))
    assert pairs(spared) == pairs(made(steps()))
    found = lm.solve(spared)
    assert found.status == "verified"
    assert found.simulate(500, 9).reached == 500
    cornered = {"kind": "grid", "per_axis": 2, "corners": True}
    assert (2, 1) not in pairs(spared.replaced(sampling=cornered))

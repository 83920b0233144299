"""A time limit begins when the kernels are compiled; a proof that it ended says so."""

from __future__ import annotations

import pytest
from problems import made

import lmdsl as lm
from lmdsl.machine import deadline, kernels
from lmdsl.proof import warming
from lmdsl.results.directory import proved

LINE = {
    "format": "lmdsl/1",
    "system": {"kind": "map", "next": {"x": "0.7*x"}},
    "state_box": {"x": {"low": 0, "high": 1, "cells": 8}},
    "attractor": {"boxes": [{"x": [0, 0.25]}]},
    "control_grid": {"u": {"values": [0]}},
    "stage_cost": "x",
    "sampling": {"kind": "grid", "per_axis": 2},
}


class Begun(Exception):
    """The proof began, with so many seconds left."""


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands, of deadlines alone."""
    now = [1000.0]
    fake = type("Time", (), {"monotonic": staticmethod(lambda: now[0])})
    monkeypatch.setattr(deadline, "time", fake)
    return now


def test_the_limit_begins_after_compiling(clock, monkeypatch):
    result = lm.solve(made(LINE))

    def compiles(*_):
        clock[0] += 70.0

    def begins(_loop, _target, until, *_):
        raise Begun(until.left)

    monkeypatch.setattr(proved, "warm", compiles)
    monkeypatch.setattr(proved, "proved", begins)
    with pytest.raises(Begun) as found:
        result.prove(time_limit=15)
    assert found.value.args == (15.0,)
    with pytest.raises(Begun) as found:  # nothing to begin with
        result.prove()
    assert found.value.args == (None,)


NOISY = {**LINE, "system": {"kind": "map", "next": {"x": "0.7*x + w"}},
         "noise": {"w": {"values": [0, 0.01], "weights": [0.5, 0.5]}}}  # fmt: skip
STAYING = {**LINE, "attractor": {}, "discount": 0.9}
ODE = {**LINE, "system": {"kind": "ode", "derivative": {"x": "-x"}, "step": 0.5, "substeps": 2}}


@pytest.mark.parametrize("data", [LINE, NOISY, STAYING, ODE], ids=["map", "noise", "stay", "ode"])
@pytest.mark.parametrize("bracket", [False, True])
def test_after_it_a_proof_compiles_nothing(data, bracket, monkeypatch):
    monkeypatch.setattr(warming, "_warm", set())
    loop = proved.loop_of(lm.solve(made(data)))
    few = warming.small(loop)
    assert (few.partition.size, few.cells) == (2, 2 if few.to_stay else 1)
    told = []
    warming.warm(loop, bracket, lambda stage, _: told.append(stage))
    before = kernels.compiled()
    warming.warm(loop, bracket, lambda stage, _: told.append(stage))
    assert (told, kernels.compiled()) == (["compile kernels"], before)


def test_a_proof_that_the_limit_ended_says_so(clock, monkeypatch):
    result = lm.solve(made(LINE))
    monkeypatch.setattr(deadline.Deadline, "__call__", lambda self: self.seconds is not None)
    torn = lm.solve(made({**LINE, "system": {"kind": "map", "next": {"x": "0.9*x - 0.05"}}}))
    proof = torn.prove(1.0, time_limit=1.0)
    assert proof.stopped == (not proof.reached)
    assert ("stopped by the time limit; a longer one decides more" in str(proof)) == proof.stopped
    whole = result.prove(0.5)
    assert not whole.stopped
    assert "time limit" not in str(whole)

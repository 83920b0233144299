"""Paths that surely enter the attractor on their way: what would come after does not matter."""

from __future__ import annotations

from problems import made
from proved_points import exceptions

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.successors.compiled import places
from lmdsl.proof import proving
from lmdsl.proof.bounds.tightening import tighten
from lmdsl.proof.checking import faults
from lmdsl.proof.cover import Cover
from lmdsl.proof.prover import Prover
from lmdsl.results.directory.proved import loop_of


def through(**more):
    """x' = -1 on [0, 1] for half a unit of time: paths cross A = [0.3, 0.4], and may leave then."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "derivative": {"x": "-1"}, "step": 0.5, "substeps": 20},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 10}},
        "attractor": {"boxes": [{"x": [0.3, 0.4]}]},
        "control_grid": {},
        "cost_rate": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        **more,
    }


def test_what_crosses_the_attractor_arrives():
    """From (0.4, 0.9] in one step, beyond in two; the cost is the time until 0.4."""
    result = lm.solve(made(through()))
    proof = result.prove(0.9999)
    assert proof.arrives >= 0.9999
    assert proof.steps == 2
    assert proof.cost[0] <= 0.3 <= proof.cost[1]
    assert exceptions(result, proof, 2000) == {"arrives": 0, "lost": 0, "stays": 0}
    assert faults(loop_of(result), proof.arrays(), lambda: None) == []


def test_what_a_rate_is_after_the_attractor_lowers_no_bound():
    """Beyond 0.35 it is negative, where no sample goes before it is absorbed."""
    result = lm.solve(made(through(cost_rate="where(x < 0.35, -5, 1)")))
    proof = result.prove(0.99)
    assert proof.arrives >= 0.99
    assert exceptions(result, proof, 2000) == {"arrives": 0, "lost": 0, "stays": 0}


def test_paths_that_only_may_enter_are_not_absorbed(monkeypatch):
    """Negative control: with y above 1/2 paths of one substep pass A by, and leave the box."""
    data = through(
        system={"kind": "ode", "derivative": {"x": "-1", "y": "0"}, "step": 0.5},
        state_box={"x": {"low": 0, "high": 1, "cells": 10}, "y": {"low": 0, "high": 1, "cells": 2}},
        attractor={"boxes": [{"x": [0.3, 0.4], "y": [0, 0.5]}]},
    )
    result = lm.solve(made(data))

    def careless(found, start, ground, slack, flags):
        flags[(flags & places.MAY_ARRIVE) > 0] = places.MAY_ARRIVE | places.EMPTY

    true = few(result)
    assert faults(loop_of(result), true, lambda: None) == []
    monkeypatch.setattr(places, "absorb", careless)
    arrays = few(result)
    monkeypatch.undo()
    assert (arrays["class"] == 1).sum() > 0
    assert faults(loop_of(result), arrays, lambda: None)


def few(result):
    """The boxes of a proof of at most 500 boxes and some more."""
    loop = loop_of(result)
    images = loop.images(proving.SLACK)
    prover = Prover(Cover(loop.partition, loop.status), images, loop.factor, loop.entry(images))
    prover.run(lambda _: prover.cover.count > 500, Deadline(), None)
    tighten(prover, lambda boxes: boxes > 500, Deadline(), None)
    return proving.boxes(prover)

"""What is enclosed, proved and verified does not depend on the number of threads, to the bit."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from problems import made

import lmdsl as lm
from lmdsl.machine import threads
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import ranges, slabs
from lmdsl.proof import prover, proving
from lmdsl.proof.images import seen
from lmdsl.results.directory.proved import add

HELD = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "derivative": {"x": "v", "v": "sin(x) - 0.2*v + u"}, "step": 0.25},
    "state_box": {name: {"low": -1, "high": 1, "cells": 14} for name in "xv"},
    "attractor": {"boxes": [{"x": [-0.5, 0.5], "v": [-0.5, 0.5]}]},
    "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
    "stage_cost": "x**2 + v**2 + u**2",
    "sampling": {"kind": "grid", "per_axis": 2},
    "successors": "enclosed",
    "local_controller": {"kind": "hold"},
    "noise": {"w": {"uniform": {"low": -0.01, "high": 0.01, "points": 2}}},
}  # fmt: skip
HELD["system"]["derivative"]["v"] += " + w"
CART = {
    **{key: HELD[key] for key in ("format", "state_box", "attractor", "control_grid")},
    "successors": "enclosed",
    "system": {"kind": "map", "next": {"x": "x + 0.3*v", "v": "0.9*v + 0.3*u"}},
    "stage_cost": "1 + u**2",
    "sampling": {"kind": "grid", "per_axis": 2},
}  # fmt: skip


@pytest.mark.parametrize("name", ["path", "map"])
def test_one_thread_and_three(name, monkeypatch, tmp_path):
    data = HELD if name == "path" else CART
    problem, found = made(data), set()
    monkeypatch.setattr(slabs, "LANES", 2**7)  # many blocks, and many parts of boxes
    monkeypatch.setattr(slabs, "SHARED", 2**20)
    monkeypatch.setattr(seen, "SOME", 64)
    for name, value in (("ALONE", 8), ("PART", 16), ("FEW", 300), ("IN_VAIN", 2)):
        monkeypatch.setattr(prover, name, value)
    for name, value in (("FEW", 300), ("GROWN", 2)):
        monkeypatch.setattr(proving, name, value)
    for count in (1, 3):
        monkeypatch.setattr(threads, "count", lambda count=count: count)
        result = lm.solve(problem)
        proof = result.prove(0.9)
        partition = Partition.of(problem)
        sets = CellSets.of(problem, partition)
        pairs = np.repeat(sets.free, 2), np.tile(np.arange(2, dtype=np.int32), len(sets.free))
        met = ranges.enclosed(problem, partition, sets, pairs, Deadline())
        told = hashlib.sha256(b"".join(x.tobytes() for x in (met.first, met.last, met.out)))
        arrays = (result.value, result.control_index, result.sure_levels)
        found.add((result.lp.digest, told.hexdigest(), proof.sha256, proof.holds,
                   *(x.tobytes() for x in arrays)))  # fmt: skip
        result.save(tmp_path / str(count))
        add(tmp_path / str(count), lm.Result.load(tmp_path / str(count)), proof)
        said = lm.verify(tmp_path / str(count)).to_dict()
        assert said["holds"]
        found.add(("verify", str(said)))
    assert len(found) == 2
    assert result.stabilizable_cells > 20

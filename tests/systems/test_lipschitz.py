"""Functions with Lipschitz constants: enclosed as far as these go, which is assumed, never proved.

By interval arithmetic of the same map as formulas it is known what its cells can meet.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from problems import made

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.ranges import enclosed
from lmdsl.model.true_map import TrueMap
from lmdsl.systems import FunctionSystem

FORMULAS = {"x": "0.6*x + 0.2*sin(3*y) + u", "y": "0.7*y + 0.1*x + w"}
CONSTANTS = [[0.6, 0.6, 0], [0.1, 0.7, 1]]


def push(x, y, u, w):
    return {"x": 0.6 * x + 0.2 * np.sin(3 * y) + u, "y": 0.7 * y + 0.1 * x + w}


def one_push(x, y, u, w):
    return [0.6 * x + 0.2 * float(np.sin(3 * y)) + u, 0.7 * y + 0.1 * x + w]


def declared(system, **more):
    axis = {"low": -1, "high": 1, "cells": 12}
    return made({
        "format": "lmdsl/1", "system": system, "state_box": {"x": axis, "y": axis},
        "attractor": {"boxes": [{"x": [-0.5, 0.5], "y": [-0.5, 0.5]}]},
        "control_grid": {"u": {"low": -0.2, "high": 0.2, "points": 3}}, "stage_cost": "1 + u**2",
        "noise": {"w": {"uniform": {"low": -0.05, "high": 0.05, "points": 2}}},
        "sampling": {"kind": "grid", "per_axis": 2}, "successors": "enclosed", **more,
    })  # fmt: skip


def function(constants=CONSTANTS, next_=push, **more):
    return FunctionSystem(next=next_, lipschitz=constants, **more)


FORMULA = {"kind": "map", "next": FORMULAS}


@pytest.fixture(scope="module")
def result():
    return lm.solve(declared(function()))


def ranges(problem):
    partition = Partition.of(problem)
    sets = CellSets.of(problem, partition)
    cell = np.repeat(sets.free, 3)
    control = np.tile(np.arange(3, dtype=np.int32), len(sets.free))
    return partition, cell, control, enclosed(problem, partition, sets, (cell, control), Deadline())


@pytest.mark.parametrize("periodic", [False, True])
def test_every_image_is_in_the_ranges(periodic):
    axis = {"low": -1, "high": 1, "cells": 12}
    box = {"x": {**axis, "periodic": periodic}, "y": axis}
    problem = declared(function(), state_box=box)
    partition, cell, control, found = ranges(problem)
    rng, step = np.random.default_rng(0), TrueMap(problem, partition)
    some = rng.integers(len(cell), size=20_000)
    index = np.stack(partition.multi_index(cell[some]), axis=-1)
    x = partition.low + (index + rng.random((len(some), 2))) * partition.width
    u, w = np.array([-0.2, 0, 0.2])[control[some], None], rng.uniform(-0.05, 0.05, len(some))
    image = step.images(x, u, [w])
    part = (w > 0).astype(int)
    for k, axis in enumerate(partition.axes):
        at = axis.number(image[:, k], False)
        first, last = found.first[some, part, k], found.last[some, part, k]
        inside = (first <= at) & (at <= last)
        if periodic and k == 0:
            inside = (at - first) % 12 <= last - first
        assert (inside | found.out[some]).all()
    assert (~found.out).mean() > 0.3


def test_what_it_gives_is_assumed_and_never_proved(result, tmp_path):
    assert result.status == "verified"
    assert result.claims["safe"] == "assumed"
    assert result.to_dict()["claims"]["safe"] == "assumed"
    assert "no run is lost is assumed, not proved" in str(result.certificate)
    assert "lost" not in str(lm.solve(declared(FORMULA)).certificate)
    result.save(tmp_path / "out")
    found = lm.verify(tmp_path / "out")
    assert found.holds
    assert found.certificate.safe == "assumed"
    assert "assumed, not proved" in str(found)
    assert "safe of the map" not in str(found)
    assert any("whole cells" in note for note in found.notes)
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.claims["safe"] == "assumed"
    assert loaded.problem.system.lipschitz == tuple(map(tuple, CONSTANTS))


@pytest.mark.parametrize("word", [True, False, None, "proved"])
def test_no_saved_result_says_more(result, word, tmp_path):
    result.save(tmp_path / "out")
    path = tmp_path / "out" / "certificate.json"
    said = json.loads(path.read_text())
    said["claims"]["safe"] = word
    path.write_text(json.dumps(said))
    if word == "proved":
        with pytest.raises(lm.BadInput, match=r"claims.safe"):
            lm.verify(tmp_path / "out")
        return
    found = lm.verify(tmp_path / "out")
    assert not found.holds
    assert any("claims.safe" in reason for reason in found.reasons)


def test_it_is_no_tighter_than_the_truth_and_loses_no_run(result):
    proved = lm.solve(declared(FORMULA))
    assert proved.claims["safe"] is True
    assert set(result.lp.cells) <= set(proved.lp.cells)
    assert result.stabilizable_cells > 60
    assert result.simulate(starts=2000, as_compiled=True).lost == 0
    tight, loose = (np.unique(lp.cell * 3 + lp.control) for lp in (proved.lp, result.lp))
    assert len(loose) <= len(tight)


def test_a_function_of_one_sample_is_enclosed_alike(result):
    other = lm.solve(declared(function(next_=one_push, vectorized=False)))
    assert other.lp.digest == result.lp.digest
    assert np.array_equal(other.sure_levels, result.sure_levels)


@pytest.mark.parametrize(
    ("constants", "named"),
    [
        ([[0.6, 0.5, 0], [0.1, 0.7, 1]], r"lipschitz\[0\]: the image of x is .* at x = .*, y = "),
        ([[0.6, 0.6, 0], [0.1, 0.6, 1]], r"lipschitz\[1\]: the image of y is .* and .* at x = "),
        ([[0.6, 0.6, 0], [0.1, 0.7, 0.9]], r"lipschitz\[1\].*further apart than the constants"),
    ],
)
def test_samples_that_contradict_it_are_named(constants, named):
    with pytest.raises(lm.BadInput, match=named):
        lm.solve(declared(function(constants)))


def test_samples_of_neighbouring_cells_contradict_it_too():
    def jump(x, y, u, w):
        return {"x": np.where(x > 0.75, 0.9, 0.5) * x, "y": 0.7 * y + w}

    constants = [[0.9, 0, 0], [0, 0.7, 1]]
    with pytest.raises(lm.BadInput, match=r"lipschitz\[0\]"):
        lm.solve(declared(function(constants, jump), sampling={"kind": "grid", "per_axis": 1}))
    undefined = lambda x, y, u, w: {"x": np.sqrt(x - 0.75), "y": y}  # noqa: E731
    with pytest.raises(lm.BadInput, match="the image of x is nan"):
        lm.solve(declared(function(constants, undefined)))


def test_rounding_contradicts_no_exact_constant():
    """x+ = 0.5 x + u, far from zero: images round, and their differences with them."""
    far = {"x": {"low": 1e6, "high": 1e6 + 1, "cells": 40}}
    problem = made({
        "format": "lmdsl/1", "system": FunctionSystem(
            next=lambda x, u: {"x": 1e6 + 0.1 * (x - 1e6) + u}, lipschitz=[[0.1]]),
        "state_box": far, "attractor": {"boxes": [{"x": [1e6, 1e6 + 0.25]}]},
        "control_grid": {"u": {"values": [0, 0.1]}}, "stage_cost": "1",
        "sampling": {"kind": "random", "points": 7, "seed": 1}, "successors": "enclosed",
    })  # fmt: skip
    assert lm.solve(problem).stabilizable_cells == 30


@pytest.mark.parametrize(
    ("constants", "where", "word"),
    [
        (None, "successors", "Lipschitz"),
        ([[1, 1]], "system.lipschitz", "1 rows; write one for each of x, y"),
        ([[1, 1, 1], [1, 1]], r"system.lipschitz\[1\]", "2 numbers"),
        ([[1], [1]], r"system.lipschitz\[0\]", "1 numbers; write one for each of x, y, w"),
        ([[1, 1], [1, 1]], "system.lipschitz", "'w' varies"),
    ],
)
def test_constants_that_do_not_fit_are_refused(constants, where, word):
    with pytest.raises(lm.BadInput, match=f"{where}: .*{word}"):
        declared(function(constants))


@pytest.mark.parametrize("constants", [[], 3, [[-1, 1], [1, 1]], [[1, "1"], [1, 1]], [[np.nan]]])
def test_what_is_no_constants_is_refused(constants):
    with pytest.raises(lm.BadInput, match="lipschitz"):
        function(constants)


def test_nodes_need_no_constants():
    nodes = {"w": {"values": [-0.05, 0.05], "weights": [0.5, 0.5]}}
    short = [row[:2] for row in CONSTANTS]
    found = lm.solve(declared(function(short), noise=nodes))
    assert found.claims["safe"] == "assumed"
    assert found.lp.digest == lm.solve(declared(function(), noise=nodes)).lp.digest


def test_cells_that_hold_are_not_proved_either(tmp_path):
    found = lm.solve(declared(function(), local_controller={"kind": "hold"}))
    assert found.local_controller.proved is None
    assert found.local_controller.holding > 0
    assert "assuming the Lipschitz constants" in found.message
    with pytest.raises(lm.BadInput, match="cannot be enclosed"):
        found.prove()
    found.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds


def test_a_sample_that_the_middle_of_its_cell_contradicts_is_refused():
    """Every sample has the same image, and the middle between them another."""

    def spike(x, y, u, w):
        return {"x": 0.8 * (np.abs(np.mod(6 * (x + 1), 1) - 0.5) > 0.1), "y": 0 * y}

    flat = [[0, 0, 0], [0, 0, 0]]
    with pytest.raises(lm.BadInput, match="further from the image of the cell's middle"):
        lm.solve(declared(function(flat, spike)))

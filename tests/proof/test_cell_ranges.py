"""What the compiled model knows of whole cells, in proofs: it holds all images, edges included."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made
from proved_points import box_at, drawn, exceptions
from random_loops import AS_PROVED, followed, random_problem

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.discretization import control_vectors
from lmdsl.model.successors import ranges
from lmdsl.model.successors.left_out.staying import Staying
from lmdsl.proof import proving
from lmdsl.proof.cover import Cover
from lmdsl.proof.images.whole import CellRanges
from lmdsl.proof.loop import Loop
from lmdsl.proof.prover import Prover
from lmdsl.results.directory.proved import loop_of

pytestmark = pytest.mark.long  # in other versions it would find nothing else

KEPT = [None, {"kind": "hold"}, {"kind": "hold", "partial": True}]

# Down a field of cells, of which y never changes: every image ends on edges of cells there.
LINE = {
    "format": "lmdsl/1",
    "system": {"kind": "map", "next": {"x": "x + u", "y": "y"}},
    "state_box": {"x": {"low": 0, "high": 2, "cells": 16}, "y": {"low": -1, "high": 2, "cells": 7}},
    "attractor": {"boxes": [{"x": [0, 0.25]}]},
    "control_grid": {"u": {"values": [-0.2, 0.17]}},
    "stage_cost": "1 + x",
    "sampling": {"kind": "grid", "per_axis": 2},
    "successors": "enclosed",
}
# The same where y is a circle, beyond whose seam is what must be avoided, with noise along x.
CIRCLE = LINE | {
    "system": {"kind": "map", "next": {"x": "x + u + w", "y": "y"}},
    "state_box": {
        "x": {"low": 0, "high": 2, "cells": 16},
        "y": {"low": -1, "high": 2, "cells": 7, "periodic": True},
    },
    "noise": {"w": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}},
    "attractor": {"boxes": [{"x": [0, 0.25], "y": [-1, 1.5]}]},
    "avoid": {"boxes": [{"y": [1.8, 1.9]}]},
}
# A path that surely enters the attractor on its way, and ends beyond it, outside the box.
PATH = LINE | {
    "system": {"kind": "ode", "derivative": {"x": "-1", "y": "0"}, "step": 1.2, "substeps": 1},
    "attractor": {"boxes": [{"x": [0.5, 1]}]},
    "control_grid": {"u": {"values": [0]}},
}


def loop_with(lp, columns):
    """The closed loop under one column a cell, wherever there is one."""
    vectors = control_vectors(lp.problem)
    control = np.zeros((lp.partition.size, vectors.shape[1]))
    control[lp.cells[lp.cell[columns]]] = vectors[lp.control[columns]]
    return Loop(lp.problem, lp.partition, lp.cell_status, control)


def sure(lp):
    """The loop under the law of sure arrival; every cell of C has it."""
    keep = np.flatnonzero(Staying.of(lp, Deadline()).surely())
    cells, first = np.unique(lp.cell[keep], return_index=True)
    assert len(cells) == lp.n
    return loop_with(lp, keep[first])


def at_once(loop, whole):
    """The share of C that whole cells are proved to arrive, none of them bisected."""
    images = loop.images(proving.SLACK, whole)
    prover = Prover(Cover(loop.partition, loop.status), images, loop.factor, loop.entry(images))
    return prover.shares()[1]


@pytest.mark.parametrize("data", [LINE, CIRCLE, PATH])
def test_the_law_of_sure_arrival_is_proved_by_whole_cells(data):
    loop = sure(lm.compile(made(data)))
    assert at_once(loop, loop.whole(Deadline())) == 1.0
    assert at_once(loop, None) < 1.0


def test_nothing_is_known_where_successors_are_sampled():
    loop = loop_of(lm.solve(made(LINE | {"successors": "sampled"})))
    assert loop.whole(Deadline()) is None


def test_it_is_given_up_where_the_time_is_up():
    loop = loop_of(lm.solve(made(LINE)))
    assert isinstance(loop.whole(Deadline()), CellRanges)
    assert loop.whole(Deadline(1e-9)) is None


def test_a_control_that_is_not_of_the_grid_is_not_known():
    loop = loop_of(lm.solve(made(LINE)))
    control = loop.control.copy()
    control[50] = 0.1
    before = loop.whole(Deadline()).row
    row = loop._replace(control=control).whole(Deadline()).row
    assert (before >= 0).sum() == loop.cells
    assert np.flatnonzero((row >= 0) != (before >= 0)).tolist() == [50]


def test_a_repair_falls_back_on_the_law_of_sure_arrival(monkeypatch):
    monkeypatch.setattr(proving, "FEW", 2_000)
    result = lm.solve(made(CIRCLE), proved=0.999)
    assert result.proved.arrives == 1.0
    assert result.verified


def at_edges(result, proof, count, rng):
    """Random states, some coordinates a few doubles from an edge of cells, and their boxes."""
    partition = result.partition
    x, _ = drawn(proof, partition, count, rng)
    edge = partition.low + np.rint((x - partition.low) / partition.width) * partition.width
    edge += rng.choice([-2e-9, -1e-9, 0, 1e-9, 2e-9], x.shape) * partition.width
    edge += rng.integers(-2, 3, x.shape) * np.spacing(edge)
    x = np.where(rng.random(x.shape) < 0.7, edge, x)
    x = np.clip(x, partition.low, partition.high)
    box = np.array([box_at(proof, partition, state) for state in x])
    return x[box >= 0], box[box >= 0]


def random_enclosed(rng):
    data = random_problem(rng) | {"successors": "enclosed"}
    kept = KEPT[rng.integers(len(KEPT))]
    if kept is not None and rng.random() < 0.5:
        data["local_controller"] = kept
    if rng.random() < 0.5:  # images that end on edges of cells
        for axis in data["state_box"].values():
            axis["cells"] = 8
        moves = rng.choice([-0.5, -0.25, 0.0, 0.25, 0.5], 2)
        rules = {"x": f"x + {moves[0]}*(2*u)", "y": f"y + {moves[1]}"}
        if rng.random() < 0.5:
            data["system"] = {"kind": "map", "next": rules}
            data.pop("cost_rate", None)
            data["stage_cost"] = "1 + x**2"
            data.pop("noise", None)
    return data


def follow(seed, count, most):
    """Prove random loops, and follow states at edges, too; return the share proved to arrive."""
    rng = np.random.default_rng(seed)
    arrives = 0.0
    loops = followed(random_enclosed, rng, count, most, 1000)
    for done, (problem, result, proof) in enumerate(loops):
        x, box = at_edges(result, proof, 300, rng)
        if len(x):
            assert exceptions(result, proof, 0, done, x, box) == AS_PROVED, problem.to_json()
        arrives += proof.arrives
    return arrives / count


def test_what_is_proved_happens():
    assert follow(0, 12, 1_000) > 0.1


@pytest.mark.full
def test_what_is_proved_happens_in_many_loops():
    assert follow(1, 150, 4_000) > 0.1


def shorter(*args, **options):
    """Ranges without their last cells."""
    found = WHOLE(*args, **options)
    least = np.minimum(found.first, found.last - 1) if found.last.size else found.last
    return ranges.Ranges(least, np.maximum(found.last - 1, least), found.out)


WHOLE = ranges.enclosed


def test_runs_find_out_ranges_that_are_too_short(monkeypatch):
    monkeypatch.setattr("lmdsl.proof.images.whole.ranges.enclosed", shorter)
    with pytest.raises(AssertionError):
        follow(2, 40, 1_000)

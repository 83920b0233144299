"""Images of boxes: what the named systems do at points of boxes, against jets and the kernels."""

from __future__ import annotations

import numpy as np
import pytest
from named_systems import NAMED
from problems import made

from lmdsl.formulas.enclosures import Jet, enclosure
from lmdsl.formulas.intervals import Interval, subtract
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.successors.compiled import enclosing, places, tapes
from lmdsl.model.true_map import TrueMap
from lmdsl.proof.images.pieces import pieces

BOXES = 300


def problem_of(name, **changes):
    data = dict(NAMED[name].problem)
    if data["system"].get("substeps") == "auto":
        data["system"] = {**data["system"], "substeps": 2}
    return made({**data, **changes})


def boxes_of(problem, rng, count=BOXES):
    partition = Partition.of(problem)
    size = partition.width * 2.0 ** -rng.integers(0, 8, count)[:, None]
    middle = partition.low + rng.random(size.shape[:1] + partition.low.shape) * (
        partition.high - partition.low
    )
    u = control_vectors(problem)
    u = u[rng.integers(len(u), size=count)]
    none = np.zeros((count, len(problem.noises)))
    return partition, enclosing.Given(middle - size / 2, middle + size / 2, u, none, none)


@pytest.mark.parametrize("name", NAMED)
def test_images_are_as_narrow_as_those_of_jets_and_hold_every_point(name):
    problem, rng = problem_of(name), np.random.default_rng(0)
    partition, given = boxes_of(problem, rng)
    d, found = partition.dimension, enclosing.enclose(tapes.step(problem), given)
    true_map = TrueMap(problem, partition)
    u = [Jet.constant(given.control[:, j], d) for j in range(given.control.shape[1])]

    def jets(low, high):
        x = [Jet.variable(Interval(low[:, i], high[:, i]), i, d) for i in range(d)]
        return true_map.enclose(x, u, [])

    middle = given.low / 2 + given.high / 2
    away = subtract(Interval(given.low, given.high), Interval.point(middle))
    sides = [Interval(*(end[:, k] for end in away)) for k in range(d)]
    pairs = zip(jets(given.low, given.high), jets(middle, middle), strict=True)
    for i, (image, at) in enumerate(pairs):
        theirs = enclosure(image, at, sides)
        ours = found.high[:, i] - found.low[:, i]
        assert ours == pytest.approx(theirs.high - theirs.low, rel=1e-9)
    for _ in range(30):
        x = given.low + rng.random(given.low.shape) * (given.high - given.low)
        y = true_map.images(x, given.control, [])
        assert ((found.low[:, :d] <= y) & (y <= found.high[:, :d])).all()


@pytest.mark.parametrize("substeps", [1, 2, 3])
@pytest.mark.parametrize("name", ["van_der_pol", "inverted_pendulum", "lorenz"])
def test_arcs_hold_every_point_of_the_path(name, substeps):
    rng = np.random.default_rng(1)
    data = NAMED[name].problem
    problem = problem_of(name, system={**data["system"], "substeps": substeps})
    partition, given = boxes_of(problem, rng)
    d, found = partition.dimension, enclosing.enclose(tapes.step(problem), given)
    flow, true_map = problem.flow(), TrueMap(problem, partition)
    for t in (0.001, 0.1, 0.37, 0.8, 1.0):
        x = given.low + rng.choice([0, 1, rng.random()], size=given.low.shape) * (
            given.high - given.low
        )
        knots = list(flow.knots(true_map.named(list(x.T), list(given.control.T), [])))
        for s in range(substeps):
            for k in range(d):
                a, b = knots[s].state[k], knots[s + 1].state[k]
                m, n = knots[s].slope[k], knots[s + 1].slope[k]
                r = 1 - t
                y = r * a + t * b + t * r * (r * (m - (b - a)) - t * (n - (b - a)))
                wide = enclosing.HERMITE * np.abs(found.arcs[:, s, k]).max(axis=1)
                assert (y >= found.arcs[:, s, k, 0] - wide).all()
                assert (y <= found.arcs[:, s, k, 1] + wide).all()
                if s == 0:  # three weights that sum to t or more
                    low, high = found.way[:, k, 0], found.way[:, k, 1]
                    assert ((y - a)[low > 0] >= 0.99 * t * low[low > 0]).all()
                    assert ((y - a)[high < 0] <= 0.99 * t * high[high < 0]).all()


def axes():
    """Circles and segments, near and far from 0, and images near their edges."""
    rng = np.random.default_rng(2)
    for low, high, cells in ((0, 1, 7), (-3.1, 2.2, 50), (1e6, 1e6 + 1, 10), (-1e-3, 1e-3, 1000)):
        for periodic in (False, True):
            axis = {"low": low, "high": high, "cells": cells, "periodic": periodic}
            data = {**NAMED["logistic_map"].problem, "state_box": {"x": axis}}
            data["attractor"] = {"cells": [[0]]}
            data["sampling"] = {"kind": "grid", "per_axis": 1}
            width = (high - low) / cells
            edges = low + rng.integers(-2 * cells, 3 * cells, 200) * width
            x = np.concatenate([edges, edges + rng.choice([-1, 1], 200) * 10.0 ** -rng.integers(
                8, 16, 200) * width, rng.uniform(2 * low - high, 2 * high - low, 200),
                [low, high, -1e300, 1e300]])  # fmt: skip
            yield made(data), x


@pytest.mark.parametrize("clip", [False, True])
def test_places_hold_every_state_that_images_become(clip):
    """Each image of a range becomes a state whose cell and place lie between those of the ends."""
    for problem, x in axes():
        partition = Partition.of(problem)
        axis = np.array(partition.axes)[0]
        (low,), (width,), n = partition.low, partition.width, int(partition.cells[0])
        rng = np.random.default_rng(3)
        for a, b in rng.choice(x, (400, 2)):
            first, last = min(a, b), max(a, b)
            if rng.random() < 0.5:
                last = first + abs(rng.choice([0, 1e-12, 1e-3])) * width
            begin, end, flags = places.located(first, last, axis, clip, 0.0)
            inside = np.concatenate([[first, last], rng.uniform(first, last, 5)])
            states = partition.states(inside[:, None], clip)
            cells = partition.locate(list(states.T), clip)
            for state, cell in zip(states[:, 0], cells, strict=True):
                if cell < 0:
                    assert flags & places.MAY_LEAVE
                    continue
                t = (state - low) / width - cell
                t = 0.0 if partition.periodic[0] and t > n / 2 else t
                place = cell * 2**32 + int(np.clip(np.floor(t * 2**32), 0, 2**32 - 1))
                held = begin <= place <= end or begin <= place + n * 2**32 <= end
                near = min(abs(place - begin), abs(place - end), abs(place + n * 2**32 - end))
                assert held or near <= 2
                assert not flags & places.EMPTY


def test_pieces_hold_every_state_of_their_cell():
    for problem, x in axes():
        partition = Partition.of(problem)
        states = partition.states(x[:, None])
        cells = partition.locate(list(states.T))
        states, cells = states[cells >= 0, 0], cells[cells >= 0]
        split = np.zeros((len(cells), 1), dtype=np.int64)
        boxes = pieces(partition, cells, split, split)
        inside = np.zeros(len(cells), dtype=bool)
        np.logical_or.at(inside, boxes.owner, (boxes.low[:, 0] <= states[boxes.owner])
                         & (states[boxes.owner] <= boxes.high[:, 0]))  # fmt: skip
        assert inside.all()
        halves = [pieces(partition, cells, split + 1, split + half) for half in (0, 1)]
        assert (halves[0].high[: len(cells)] >= halves[1].low[: len(cells)]).all()

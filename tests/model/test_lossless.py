"""What no controller can keep without losing a run: by hand, the reference, and all controllers.

The set is compared with an independent one by definition, and with what every controller of a small
problem does; states that are said to lose a run are followed by the true map.
"""

import itertools

import numpy as np
import pytest
from random_problems import random_problem
from reference import compile_reference, lossless_cells

import lmdsl as lm
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.discretization import offsets
from lmdsl.model.successors.left_out import lossless
from lmdsl.model.successors.left_out.lossless import Lossless
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import parse_problem


def line(formula, cells=4, **more):
    """x+ = formula on [0, cells], cells of width 1, A = the first."""
    return parse_problem(
        {
            "format": "lmdsl/1",
            "system": {"kind": "map", "next": {"x": formula}},
            "state_box": {"x": {"low": 0, "high": cells, "cells": cells}},
            "attractor": {"cells": [[0]]},
            "control_grid": {"u": {"values": [0, 1]}},
            "stage_cost": "1 + u",
            "sampling": {"kind": "grid", "per_axis": 1},
            **more,
        }
    )


def known(problem, lp=None):
    return Lossless.of(lp or lm.compile(problem), Deadline(None))


def cells_of(found):
    return set(found.transitions.sets.free[found.inside].tolist())


def pairs_of(found):
    cell = found.transitions.sets.free[owner(found.transitions.pair_pointer)]
    pairs = np.stack([cell, found.transitions.control], axis=-1)[found.alive]
    return {tuple(pair) for pair in pairs.tolist()}


# By u = 0 a part of the last cell is lost.
STEEP = "where(x > 3.8, where(u < 0.5, 9, x - 1), x - 1)"


def test_only_a_dearer_control_is_safe():
    found = known(line(STEEP))
    assert found.share == 1
    assert found.losing().tolist() == [[3, 0]]
    pairs, hopeless = found.losing_most()
    assert pairs.tolist() == [[3, 0]]
    assert not hopeless.any()


def test_a_cell_of_which_every_control_loses_a_state_leaves_and_takes_others_along():
    """The last cell loses, the one before leads there under both controls, the next under one."""
    back = "where(x > 3, x + 1, where(x > 2 and u > 0.5, x + 1, x - 1))"
    found = known(line(f"where(x > 4.8, 9, where(x > 4, x - 4, {back}))", cells=5))
    assert cells_of(found) == {1, 2}
    assert found.share == pytest.approx(2 / 4)
    assert sorted(map(tuple, found.losing().tolist())) == [(2, 1), (3, 0), (3, 1), (4, 0), (4, 1)]
    pairs, hopeless = found.losing_most()
    assert not len(pairs)
    assert np.flatnonzero(hopeless).tolist() == [4]


def test_of_what_loses_anyhow_that_which_loses_less_is_kept():
    found = known(line("where(x > 3.6 + 0.2*u, 9, x - 1)"))
    assert found.share == pytest.approx(2 / 3)
    pairs, hopeless = found.losing_most()
    assert pairs.tolist() == [[3, 0]]
    assert np.flatnonzero(hopeless).tolist() == [3]


@pytest.mark.parametrize(
    "axis", [(0, 4, False), (-3.141592653589793, 3.1, True), (1e4, 2e4, False)]
)
def test_states_lie_in_their_own_cells(axis):
    box = {"x": dict(zip(("low", "high", "periodic"), axis, strict=True), cells=7)}
    found = known(line("x", state_box=box))
    cells = np.arange(7)
    (x,) = found.lp.partition.samples(cells, offsets(found.problem))
    assert x.shape == (7, 33)
    assert (found.lp.partition.locate([x]) == cells[:, None]).all()


@pytest.mark.parametrize("seed", [seed for seed in range(16) if seed != 9])  # slow there
def test_random_problems_agree_with_the_reference(seed, monkeypatch):
    monkeypatch.setattr(lossless, "MOST", 3)
    data = random_problem(np.random.default_rng(seed))
    model = compile_reference(data)
    stages = 4 * data["system"].get("substeps", 1) if data["system"]["kind"] == "ode" else 1
    if model.N * model.M * len(model.noise) * stages > 300:
        return
    found = known(parse_problem(data))
    per_axis = found.problem.sampling.per_axis
    cells, pairs = lossless_cells(data, per_axis, model.attractor, model.avoid)
    assert (cells_of(found), pairs_of(found)) == (cells, pairs)


def test_every_controller_that_loses_nothing_keeps_cells_of_it():
    """All laws of random maps of a line: those under which no state is lost, by definition."""
    random, cells = np.random.default_rng(3), 4
    proper = 0
    for _ in range(5):
        table = random.integers(-1, cells, size=(cells, 2, 3)).tolist()
        parts = "9"
        for i, u, k in itertools.product(range(1, cells), range(2), range(3)):
            at = f"x >= {i + k / 3} and x < {i + (k + 1) / 3} and abs(u - {u}) < 0.5"
            parts = f"where({at}, {table[i][u][k] + 0.5}, {parts})"
        found = known(line(parts, cells))
        best = set()
        for law in itertools.product((-1, 0, 1), repeat=cells - 1):
            domain = {i for i, u in enumerate(law, start=1) if u >= 0}
            ends = {t for i in domain for t in table[i][law[i - 1]]}
            if ends <= domain | {0}:
                best |= domain
        assert cells_of(found) == best
        proper += 0 < len(best) < cells - 1
    assert proper > 0


def test_states_that_lose_are_runs_of_the_true_map():
    """Of every pair that does not survive, some state leaves what can be kept, as runs go."""
    problem = lm.load("examples/henon_map.json")
    lp = lm.compile(problem)
    found = known(problem, lp)
    assert found.share < 1
    kept = np.zeros(lp.partition.size + 1, dtype=bool)
    kept[list(cells_of(found))] = kept[:-1][found.transitions.sets.attractor] = True
    true_map, points = TrueMap(problem, lp.partition), offsets(found.problem)
    for cell, control in found.losing()[::7].tolist():
        x = np.stack([s.ravel() for s in lp.partition.samples(np.array([cell]), points)], axis=-1)
        images = true_map.images(x, np.broadcast_to(lp.controls[control], (len(x), 1)), ())
        assert not kept[lp.partition.enter(images)[1]].all()


def test_what_takes_minutes_is_not_looked_at(monkeypatch):
    lp = lm.compile(line(STEEP))
    monkeypatch.setattr(lossless, "LARGEST", 3 * 2 * 2 - 1)
    assert known(lp.problem, lp) is None
    monkeypatch.setattr(lossless, "LARGEST", 3 * 2 * 2)
    assert known(lp.problem, lp) is not None


def test_what_is_too_fine_for_doubles_is_not_looked_at():
    problem = line("x - 1", state_box={"x": {"low": 1e9, "high": 1e9 + 4, "cells": 4}})
    lp = lm.compile(problem)
    assert Lossless.of(lp, Deadline(None)) is None


@pytest.mark.parametrize("error", [lm.BadInput("too large", "memory"), TimeLimitReached("it")])
def test_no_time_or_memory_is_no_answer(error, monkeypatch):
    lp = lm.compile(line(STEEP))

    def fail(*_):
        raise error

    monkeypatch.setattr(lossless, "assemble", fail)
    assert known(lp.problem, lp) is None

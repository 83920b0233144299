"""Enclosed successors, cells that hold and dropped pairs over ranks: the model of one process."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alike import alike, answers, sampled
from problems import made
from slab_programs import in_global_numbers

import lmdsl as lm
from lmdsl.model.successors import counting, survival
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone, RankError
from lmdsl.slabs import compiling, judging, solving
from lmdsl.slabs.digest import of_model
from lmdsl.slabs.graph.telling import Telling

pytestmark = pytest.mark.long  # in other versions it would find nothing else

EXAMPLES = Path(__file__).parents[2] / "examples"
BY_CELL = ("cell_status", "sure_levels", "hold")


def model(ranks, lp):
    """What a model holds, of own cells, as bytes."""
    arrays = {**in_global_numbers(lp), **{name: getattr(lp, name) for name in BY_CELL}}
    every = ranks.collect(arrays)
    return of_model(ranks, lp), {
        name: None if x is None else np.concatenate([own[name] for own in every]).tobytes()
        for name, x in arrays.items()
    }


def compared(problem, counts, dropped=None):
    """Require of each number of ranks the model of one process, and return that."""
    lp = lm.compile(problem, dropped=dropped)
    expected = model(Alone(), lp)
    for count in counts:
        found = as_threads(
            count, lambda ranks: model(ranks, compiling.compiled(ranks, problem, dropped=dropped))
        )
        assert found == [expected] * count
    return lp


@pytest.mark.parametrize("seed", [0, 5, 7, 13])
def test_enclosed_successors(seed):
    lp = compared(sampled(seed).replaced(successors="enclosed"), (2, 3))
    assert lp.sure_levels is not None


def test_where_cells_are_lost_by_enclosures():
    lp = compared(sampled(12).replaced(successors="enclosed"), (2, 3))
    assert not lp.n
    assert lm.compile(sampled(12)).n


HELD = [pytest.param("pendulum_held", marks=pytest.mark.long), "circle_map"]


@pytest.mark.parametrize("name", HELD)
def test_cells_that_hold(name):
    lp = compared(lm.load(EXAMPLES / f"zoo/{name}.json"), (2, 3))
    assert (lp.hold >= 0).any()
    assert (lp.sure_levels > 0).any()


@pytest.mark.parametrize("successors", ["sampled", "enclosed"])
@pytest.mark.parametrize("partial", [False, True])
@pytest.mark.parametrize("kind", ["map", "circle", "equation"])
def test_some_cells_of_an_attractor_hold(kind, partial, successors):
    """Of a square about rest, on a cylinder, and where ways are judged; not all of its cells."""
    axis = {"low": -1.0, "high": 1.0, "cells": 12}
    step = {"x": "x + 0.3*y", "y": "0.9*y + 0.3*u"}
    if kind == "equation":
        system = {"kind": "ode", "derivative": {"x": "y", "y": "-0.3*y + u"}, "step": 0.3}
    else:
        system = {"kind": "map", "next": step}
    first = {**axis, "periodic": True} if kind == "circle" else axis
    lp = compared(made({
        "format": "lmdsl/1", "system": system, "state_box": {"x": first, "y": axis},
        "attractor": {"boxes": [{"x": [-0.84, 0.84], "y": [-0.84, 0.84]}]},
        "avoid": {"boxes": [{"x": [0.9, 1.0], "y": [0.0, 0.4]}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
        "stage_cost": "x**2 + y**2 + u**2", "sampling": {"kind": "grid", "per_axis": 3},
        "successors": successors, "local_controller": {"kind": "hold", "partial": partial},
    }), (2, 3, 5))  # fmt: skip
    assert 0 < (lp.hold >= 0).sum() < 100
    assert lp.n


def test_where_no_cell_holds():
    problem = lm.load(EXAMPLES / "standard_map.json").replaced(
        local_controller={"kind": "hold"}, successors="enclosed"
    )
    assert not compared(problem, (2, 3)).n
    one = lm.solve(problem)
    for found in answers(problem, 2):
        assert (found.status, found.cause, found.message) == (one.status, one.cause, one.message)


def test_pairs_that_are_dropped():
    problem = lm.load(EXAMPLES / "standard_map.json")
    lp = lm.compile(problem)
    pairs = np.stack([lp.cells[lp.cell], lp.control], axis=-1)
    some = np.random.default_rng(0).permutation(len(pairs))[: len(pairs) // 2]
    left = compared(problem, (2, 3), pairs[some])
    assert left.n > 0
    assert len(pairs) > left.K
    assert of_model(Alone(), left) != of_model(Alone(), replace(left, dropped=left.dropped[1:]))


@pytest.mark.parametrize("dropped", [[[625, 3]], [[2499, 3]], [[0, 99]], [[0.5, 1]]])
def test_what_is_no_pair_is_told_as_by_one_process(dropped):
    """A cell of the attractor, one that is admissible nowhere, no control, no number."""
    problem = lm.load(EXAMPLES / "standard_map.json").replaced(admissible="x < 0.9 and u > -0.4")
    with pytest.raises(lm.BadInput) as alone:
        lm.compile(problem, dropped=dropped)
    with pytest.raises(lm.BadInput) as ranked:
        as_threads(3, lambda ranks: compiling.compiled(ranks, problem, dropped=dropped))
    assert str(ranked.value) == str(alone.value)


# Negative controls.


def telling(ranks, runs=((0, 40),)):
    starts = Division.cut(np.ones(40, dtype=int), ranks.count).starts
    return Telling.agreed(ranks, starts, [*runs])


@pytest.mark.parametrize("kind", [np.bool_, np.uint8])
@pytest.mark.parametrize("runs", [
    [[(0, 40)]] * 3, [[(0, 15)], [(9, 31)], [(20, 40)]], [[(33, 40), (0, 9)], [(2, 2)], [(2, 3)]],
])  # fmt: skip
def test_who_asks_hears_it_from_the_owner(runs, kind):
    wanted = (np.random.default_rng(3).random(40) * (2 if kind == np.bool_ else 200)).astype(kind)

    def program(ranks):
        told = telling(ranks, runs[ranks.rank])
        first, last = told.starts[ranks.rank : ranks.rank + 2]
        for _ in range(3):
            found = told.heard(wanted[first:last])
        return found.tolist(), found.dtype, ranks.traffic.sent

    found = as_threads(3, program)
    for k, own in enumerate(runs):
        assert found[k][0] == [int(x) for a, b in own for x in wanted[a:b]]
        assert found[k][1] == kind
    assert (found[1][2] == 0) == (runs[0][0] == (33, 40))  # nobody asks rank 1 for what it has


@pytest.mark.parametrize(
    ("wrong", "message"),
    [("time", "of another time"), ("size", "not its own"), ("range", "expects"),
     ("short", "expects"), ("shifted", "of other items than asked"), ("more", "expects")],
)  # fmt: skip
def test_what_is_told_wrong_is_refused(wrong, message):
    """By rank 1; or it takes another part for what rank 0 asks for, as after a halo cell short."""

    def program(ranks):
        told = telling(ranks, [(4, 30)])
        first, last = told.starts[ranks.rank : ranks.rank + 2].tolist()
        if ranks.rank == 1:
            if wrong == "time":
                told.told += 1
            if wrong == "range":  # it says that it has more than all have agreed on
                told.starts = np.array([0, 11, 40])
                first -= 9
            if wrong == "size":
                last -= 1
            told.asked[0] = {"short": [(4, 21)], "shifted": [(3, 29)], "more": [(4, 39)]}.get(
                wrong, told.asked[0]
            )
        return told.heard(np.zeros(last - first, dtype=bool))

    with pytest.raises(RankError, match=message):
        as_threads(2, program)


def deaf(telling, own, plain=Telling.heard):
    """A rank 1 that takes nothing of the marks that other ranks tell."""
    heard = plain(telling, own)
    if telling.ranks.rank == 1 and own.dtype == np.bool_:
        number = np.concatenate([np.arange(*run) for run in telling.asked[1]])
        first, last = telling.starts[1:3]
        heard[(number < first) | (number >= last)] = False
    return heard


def test_what_a_rank_does_not_hear_of_removed_cells_is_noticed(monkeypatch):
    """Cells that others lost: the claim on whole cells does not hold."""
    problem = sampled(13).replaced(successors="enclosed")
    monkeypatch.setattr(Telling, "heard", deaf)

    def program(ranks):
        return solving.solved(compiling.compiled(ranks, problem)).certificate

    for certificate in as_threads(2, program):
        assert certificate.safe is False
        assert not certificate.verified
        assert "is not proved that all that the image" in certificate.reasons[-1]


def test_who_does_not_hear_of_sure_cells_claims_less(monkeypatch):
    problem = lm.load(EXAMPLES / "zoo/circle_map.json")
    sure = lm.compile(problem).sure_levels
    monkeypatch.setattr(Telling, "heard", deaf)
    parts = as_threads(2, lambda ranks: compiling.compiled(ranks, problem).sure_levels)
    found = np.concatenate(parts)
    assert ((found == -1) | (found >= sure) & (sure >= 0)).all()
    assert (found != sure).any()


def test_a_rank_holds_no_more_than_the_window_of_its_pairs(monkeypatch):
    """Of a slow system: a quarter of the box, of four ranks; of one it would be nearly all."""
    problem = lm.Problem.model_validate({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "0.9*x", "y": "0.5*y"}},
        "state_box": {"x": {"low": -1, "high": 1, "cells": 200},
                      "y": {"low": -1, "high": 1, "cells": 6, "periodic": True}},
        "attractor": {"boxes": [{"x": [-0.2, 0.2]}]}, "control_grid": {}, "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2}, "successors": "enclosed",
    })  # fmt: skip
    sizes, plain = [], counting.table

    def table(cells, where, guard=None):
        sizes.append(len(cells))
        return plain(cells, where, guard)

    monkeypatch.setattr(counting, "table", table)
    monkeypatch.setattr(survival, "table", table)
    for count, most in ((1, 1.0), (2, 0.5), (4, 0.25)):
        sizes.clear()
        parts = as_threads(count, lambda ranks: compiling.compiled(ranks, problem).sure_levels)
        assert (np.concatenate(parts) > 0).any()
        assert 0.7 * most <= max(sizes) / 1200 <= most


def test_claim_7_asks_the_owner_what_a_cell_is():
    """Of a cell that its owner takes for lost nobody may say that runs are safe there."""
    problem = sampled(13).replaced(successors="enclosed")

    def program(ranks, spoiled):
        lp = compiling.compiled(ranks, problem)
        witness = solving.solved(lp).witness
        status = lp.cell_status.copy()
        if spoiled and ranks.rank == 1:
            status[status == 1] = 3
        return judging.verdict(replace(lp, cell_status=status), witness, 1e-6).safe

    assert as_threads(2, lambda ranks: program(ranks, False)) == [True] * 2
    assert as_threads(2, lambda ranks: program(ranks, True)) == [False] * 2


def test_answers_are_those_of_one_process():
    for problem in (sampled(0).replaced(successors="enclosed"),
                    lm.load(EXAMPLES / "zoo/circle_map.json")):  # fmt: skip
        one = alike(problem, (2, 3))
        assert one.certificate.safe
    assert one.sure_cells

"""Enclosed successors, cells that hold and dropped pairs over ranks: the model of one process."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alike import alike, answers, sampled
from slab_programs import in_global_numbers

import lmdsl as lm
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import Alone, RankError
from lmdsl.slabs import compiling, judging, solving
from lmdsl.slabs.digest import of_model
from lmdsl.slabs.graph.meeting import Marks, OwnSuccessors

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


def marks(ranks):
    return Marks(ranks, Division.cut(np.ones(40, dtype=int), ranks.count))


def test_marks_come_from_the_owner():
    wanted = np.random.default_rng(3).random(40) < 0.5

    def program(ranks):
        told = marks(ranks)
        first, last = told.division.own(ranks.rank)
        return told.everywhere(wanted[first:last]).tolist()

    assert as_threads(3, program) == [wanted.tolist()] * 3


@pytest.mark.parametrize(
    ("wrong", "message"),
    [("time", "marks of another time"), ("size", "not its own"), ("range", "expects")],
)
def test_wrong_marks_are_refused(wrong, message):
    def program(ranks):
        told = marks(ranks)
        first, last = told.division.own(ranks.rank)
        if ranks.rank == 1:
            if wrong == "time":
                told.told += 1
            if wrong == "range":  # it says that it has more than all have agreed on
                bounds = told.division.bounds.copy()
                bounds[told.division.firsts[1]] -= 9
                told = Marks(ranks, Division(bounds, told.division.firsts))
                first -= 9
            if wrong == "size":
                last -= 1
        return told.everywhere(np.zeros(last - first, dtype=bool))

    with pytest.raises(RankError, match=message):
        as_threads(2, program)


def deaf(successors, marked, plain=OwnSuccessors._spread):
    """A rank 1 that sees nothing of what other ranks tell."""
    if successors.marks.ranks.rank == 1:
        first, last = successors.marks.division.own(1)
        heard, marked = marked, np.zeros_like(marked)
        marked[first:last] = heard[first:last]
    return plain(successors, marked)


@pytest.mark.parametrize("seed", [3, 13])
def test_what_a_rank_does_not_hear_is_noticed(seed, monkeypatch):
    """Cells that others lost: the claim on whole cells does not hold; levels end out of step."""
    problem = sampled(seed).replaced(successors="enclosed")
    monkeypatch.setattr(OwnSuccessors, "_spread", deaf)

    def program(ranks):
        found = solving.solved(compiling.compiled(ranks, problem))
        return found.certificate

    if seed == 3:
        with pytest.raises(RankError, match="as its verb number"):
            as_threads(2, program)
        return
    for certificate in as_threads(2, program):
        assert certificate.safe is False
        assert not certificate.verified
        assert "is not proved that all that the image" in certificate.reasons[-1]


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

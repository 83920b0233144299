"""Claim 7 over ranks: judged in windows that grow, by what the owners of cells say of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lmdsl as lm
from lmdsl.certificate import safety as alone
from lmdsl.machine.deadline import Deadline
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.left_out.staying import Staying
from lmdsl.ranks.threaded import as_threads
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs import compiling, safety

pytestmark = pytest.mark.long  # in other versions it would find nothing else

EXAMPLES = Path(__file__).parents[2] / "examples"
SLOW = lm.load(EXAMPLES / "double_integrator.json").replaced(
    successors="enclosed",
    state_box={"x": {"low": -2, "high": 2, "cells": 40},
               "v": {"low": -1.5, "high": 1.5, "cells": 20}},
    attractor={"boxes": [{"x": [-0.2, 0.2], "v": [-0.3, 0.3]}]},
)  # fmt: skip
AROUND = lm.load(EXAMPLES / "zoo/circle_map.json")


def some(lp):
    """A policy of surviving pairs."""
    rng = np.random.default_rng(0)
    return lp.pair_pointer[:-1] + rng.integers(0, np.diff(lp.pair_pointer))


def counted(problem, count, change=lambda ranks, lp: lp):
    """The cells that are not proved under any of their controls, and windows by round."""
    rounds, plain = [], safety._judged

    def judged(lp, at, control, window, status):
        found = plain(lp, at, control, window, status)
        rounds.append((len(at), int(found.beyond.sum()), window.planes))
        return found

    def program(ranks):
        lp = change(ranks, compiling.compiled(ranks, problem))
        return safety.unproved(ranks, lp, some(lp))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(safety, "_judged", judged)
        found = as_threads(count, program)
    assert len(set(found)) == 1
    return found[0], rounds


@pytest.mark.parametrize("problem", [SLOW, AROUND])
def test_what_holds_is_found_to_hold(problem, monkeypatch):
    monkeypatch.setattr(safety, "FIRST", 16)
    lp = lm.compile(problem)
    assert alone.kept(lp, some(lp)).all()
    for count in (1, 2, 3, 4, 7):
        unproved, rounds = counted(problem, count)
        assert unproved == 0
        assert sum(judged - beyond for judged, beyond, _ in rounds) == lp.n
        assert (count == 1) != any(beyond for _, beyond, _ in rounds)  # windows did grow
        if count == 7:
            assert max(planes for *_, planes in rounds) < 0.7 * lp.partition.shape[0]


@pytest.mark.parametrize("problem", [SLOW, AROUND])
def test_what_an_owner_takes_for_lost_is_not_safe(problem):
    """Each rank in turn says that of its cells: refused where the pairs of others meet them."""
    lp, met = lm.compile(problem), 0
    staying = Staying.of(lp, Deadline())
    owned = as_threads(3, lambda ranks: compiling.compiled(ranks, problem).cells)
    for liar, cells in enumerate(owned):

        def lies(ranks, lp, liar=liar):
            told = lp.cell_status.copy()
            told[told == CellStatus.STABILIZED] = CellStatus.TRAPPED
            return replace(lp, cell_status=told) if ranks.rank == liar else lp

        allowed = np.ones(lp.partition.size, dtype=bool)
        allowed[cells] = False
        meets = ~staying.within(allowed)[some(lp)] & ~np.isin(lp.cells, cells)
        assert (counted(problem, 3, lies)[0] > 0) == meets.any()
        met += meets.any()
    assert met > 1


def test_cells_that_nobody_has_are_missed():
    def cut(ranks, lp):
        return replace(lp, cell_status=lp.cell_status[:-1]) if ranks.rank == 1 else lp

    with pytest.raises(RankError, match="ranks have 799 of 800 cells of the box"):
        counted(SLOW, 3, cut)


def test_no_rank_judges_what_others_can_meet(monkeypatch):
    """By the windows: their cells alone are told, so that a rank of four holds less than half."""
    heard, plain = [], safety.Telling.heard

    def hear(telling, own):
        heard.append(plain(telling, own))
        return heard[-1]

    monkeypatch.setattr(safety.Telling, "heard", hear)
    counted(SLOW, 4)
    bytes_heard = [len(x) for x in heard if x.dtype == np.uint8]
    assert 200 < max(bytes_heard) <= 400

"""Windows of the box: which planes ranges meet, and sums over those alone."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import lmdsl as lm
from lmdsl.machine.kernels import fixed
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.windows import Window, hull, joined, met
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import counting
from lmdsl.model.successors.following import (
    SLACK,
    Following,
    GrowingWindow,
    PathTables,
    WindowSets,
    WindowTables,
)
from lmdsl.model.successors.inclusion import Inclusion


def box(shape, periodic):
    """A box of cells of width 1."""
    low, cells = np.zeros(len(shape)), np.array(shape)
    return Partition(tuple("abcd")[: len(shape)], low, cells.astype(float), np.ones(len(shape)),
                     cells, np.array(periodic))  # fmt: skip


@pytest.mark.parametrize(("runs", "circle", "wanted"), [
    ([], False, (0, 1)),
    ([], True, (0, 1)),
    ([(3, 5)], False, (3, 3)),
    ([(3, 5)], True, (3, 3)),
    ([(1, 2), (8, 9)], False, (1, 9)),
    ([(1, 2), (8, 9)], True, (8, 5)),  # across the seam: 8, 9, 0, 1, 2
    ([(1, 2), (6, 7)], True, (6, 7)),
    ([(1, 1), (6, 6)], True, (6, 6)),  # of equal gaps it leaves out the first
    ([(8, 11)], True, (8, 4)),
    ([(8, 11), (3, 3)], True, (8, 6)),
    ([(0, 9)], True, (0, 10)),
    ([(0, 8)], True, (0, 9)),  # a gap of one plane
    ([(4, 12), (3, 3)], True, (0, 10)),  # both together leave none
    ([(7, 16)], True, (0, 10)),
    ([(0, 9)], False, (0, 10)),
])  # fmt: skip
def test_the_least_run_that_holds_others(runs, circle, wanted):
    """Of ten planes."""
    ends = np.array(runs, dtype=np.int64).reshape(-1, 2)
    for some in (ends, ends[::-1], joined(*np.repeat(ends, 2, axis=0).T)):
        assert hull(some, 10, circle) == wanted
    window = Window.around(box((10, 3), (circle, False)), ends)
    assert (window.start, window.planes) == wanted
    assert window.holds(ends[:, 0], ends[:, 1]).all()
    assert window.circles == [circle and wanted[1] == 10, False]


@pytest.mark.parametrize(("circle", "runs", "slack", "wanted"), [
    (False, (4, 5), 2, (2, 6)), (False, (1, 8), 3, (0, 10)), (True, (9, 10), 2, (7, 6)),
    (True, (1, 4), 9, (9, 8)), (True, (0, 8), 1, (0, 9)), (True, (0, 9), 1, (0, 10)),
])  # fmt: skip
def test_planes_beside_do_not_close_a_circle(circle, runs, slack, wanted):
    window = Window.around(box((10,), (circle,)), np.array([runs]), slack)
    assert (window.start, window.planes) == wanted


def test_runs_that_touch_are_one():
    first, last = np.array([5, 0, 3, 9, 1]), np.array([6, 1, 4, 9, 1])
    assert joined(first, last).tolist() == [[0, 1], [3, 6], [9, 9]]
    assert joined(first[:0], last[:0]).shape == (0, 2)


def test_cells_of_a_window_across_the_seam():
    window = Window(box((5, 3), (True, False)), 4, 2)
    assert window.runs == [(12, 15), (0, 3)]
    cells = np.arange(15)
    assert window.of(cells).tolist() == [12, 13, 14, 0, 1, 2]
    assert window.positions(cells).tolist() == [3, 4, 5, *[-1] * 9, 0, 1, 2]
    assert window.positions(np.array([-1])) == -1
    assert Window.whole(window.partition).of(cells).tolist() == cells.tolist()


@st.composite
def ranges(draw):
    """A box, and ranges of some pairs; those that mean nothing are anywhere."""
    axis = st.tuples(st.integers(1, 7), st.booleans())
    shape, periodic = zip(*draw(st.lists(axis, min_size=1, max_size=3)), strict=True)
    count, parts = draw(st.integers(1, 5)), draw(st.integers(1, 2))
    rng = np.random.default_rng(draw(st.integers(0, 2**20)))
    first = rng.integers(0, shape, size=(count, parts, len(shape))).astype(np.int16)
    length = rng.integers(0, 1 + rng.integers(0, shape, size=first.shape))
    stop = np.where(periodic, first + length, np.minimum(first + length, np.array(shape) - 1))
    return box(shape, periodic), first, stop.astype(np.int16), rng.random(count) < 0.8, rng


def same(partition, first, last, some, rng):
    """Require of a window the counts of the box, of ranges of the pairs that mean something."""
    cells = rng.random(partition.size) < 0.5
    window = Window.around(partition, met(first, last, some))
    entered = first.copy(), last.copy()
    window.enter(*entered)
    of_box, of_window = counting.table(cells, partition), counting.table(window.of(cells), window)
    assert of_window.sums.size <= of_box.sums.size
    for k in np.flatnonzero(some):
        for part in range(first.shape[1]):
            wanted = counting.count(of_box, fixed(first), fixed(last), k, part)
            assert counting.count(of_window, *map(fixed, entered), k, part) == wanted
    for low, high in zip(*(x[..., 0].ravel() for x in entered), strict=True):
        assert low >= 0
        assert high < window.planes * (2 if window.circles[0] else 1)
    return window


@settings(max_examples=150, deadline=None, derandomize=True)
@given(ranges())
def test_a_window_counts_what_the_box_does(made):
    partition, first, last, some, rng = made
    window = same(partition, first, last, some, rng)
    n, ends = partition.shape[0], (x[some][..., 0].ravel().tolist() for x in (first, last))
    reached = {k % n for a, b in zip(*ends, strict=True) for k in range(a, b + 1)}
    turn = n if partition.periodic[0] else 2 * n  # on a line there is no way around
    tried = (k for k in range(1, n + 1) for s in range(n)
             if reached <= {(s + i) % turn for i in range(k)})  # fmt: skip
    assert window.planes == next(tried)
    assert reached <= {(window.start + k) % n for k in range(window.planes)}


@pytest.mark.parametrize(("off", "wanted"), [(0, 4), (1, 0), (-1, 0)])
def test_ranges_one_plane_off_count_other_cells(off, wanted):
    """The control of the test above."""
    window = Window(box((9, 4), (True, False)), 7, 4)
    first, last = np.array([[[0, 0]]], dtype=np.int16), np.array([[[0, 3]]], dtype=np.int16)
    window.enter(first, last)
    assert first[0, 0, 0] == last[0, 0, 0] == 2
    first[..., 0] += off
    last[..., 0] += off
    sums = counting.table(window.of(np.arange(36) < 4), window)  # plane 0
    assert counting.count(sums, fixed(first), fixed(last), 0, 0) == wanted


class Plain:
    """What decides of a problem whose local controller absorbs."""

    local_controller, judged = None, "path"


class Marked:
    """Cells of the box by what they are; who reads all of them at once is seen."""

    def __init__(self, avoid, attractor):
        self.avoid, self.attractor = avoid, attractor


@settings(max_examples=100, deadline=None, derandomize=True)
@given(ranges(), st.integers(1, 3))
def test_steps_end_as_by_the_tables_of_the_box(made, stretches):
    """By a window that grows: same states; who is absorbed lies in the range that absorbed it."""
    partition, first, last, _, rng = made
    kinds = rng.choice(3, size=partition.size, p=[0.2, 0.5, 0.3])
    assume((kinds == 1).any())
    sets = Marked(kinds == 0, kinds == 1)
    plain = PathTables.of(Plain, sets, partition)
    known = GrowingWindow(Plain, partition, sets, 1)
    following, state = Following(known), np.zeros(first.shape[:2], dtype=np.uint8)
    other = state.copy()
    for _ in range(stretches):
        order = rng.permutation(len(first))
        a, b = first[order], last[order]
        out, way = rng.random(state.shape) < 0.2, rng.random(state.shape) < 0.7
        ends, wanted = (a.copy(), b.copy()), (a.copy(), b.copy())
        before = state == counting.ABSORBED
        counting.judge(plain, *wanted, out, way, other)
        following.judge(*ends, out, way, state)
        assert np.array_equal(state, other)
        absorbed = state == counting.ABSORBED
        assert np.array_equal(ends[0][absorbed], ends[1][absorbed])
        new = absorbed & ~before
        assert np.array_equal(ends[0][new], a[new])
        at = np.ravel_multi_index(tuple(ends[0][absorbed].T), partition.shape)
        assert (kinds[at] == 1).all()
        rest = ~absorbed
        for mine, its in zip(ends, wanted, strict=True):
            assert np.array_equal(mine[rest], its[rest])


def test_a_window_grows_no_more_than_is_asked():
    partition = box((100, 2), (False, False))
    marks = np.zeros(200, dtype=bool)
    known = GrowingWindow(Plain, partition, Marked(marks, marks), 8)
    sizes = []
    for plane in range(40, 60):
        run = np.array([plane])
        window = known(run, run).window
        assert window.holds(run, run).all()
        sizes.append(window.planes)
    assert sizes[0] == 1 + 2 * (8 // SLACK)
    assert len(set(sizes)) < 12  # it is not made anew for each
    assert sizes[-1] <= 20 * (1 + 2 / SLACK)
    assert isinstance(known(np.array([0]), np.array([99])), WindowTables)
    assert known(run, run).window.is_whole


CORRIDOR = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "derivative": {"x": "cos(a)", "y": "sin(a)"}, "step": 0.5,
               "substeps": 1},
    "state_box": {"x": {"low": 0, "high": 3, "cells": 15},
                  "y": {"low": 0, "high": 3, "cells": 5}},
    "control_grid": {"a": {"low": -2.4, "high": 2.4, "points": 7}},
    "attractor": {"boxes": [{"x": [2.4, 3], "y": [1.8, 3]}]},
    "avoid": {"boxes": [{"x": [1.4, 1.6], "y": [0, 1.2]}]}, "stage_cost": "1",
    "sampling": {"kind": "grid", "per_axis": 1}, "successors": "enclosed",
}  # fmt: skip
AROUND = CORRIDOR | {
    "system": {"kind": "map", "next": {"x": "x + 0.3*a + 0.1*x*x", "y": "0.8*y"}},
    "state_box": {"x": {"low": 0, "high": 3, "cells": 15, "periodic": True},
                  "y": {"low": 0, "high": 3, "cells": 5}},
}  # fmt: skip


@pytest.mark.parametrize("data", [pytest.param(CORRIDOR, marks=pytest.mark.long), AROUND])
def test_pairs_are_judged_in_a_window_as_in_the_box(data):
    """One by one, or what they need leaves the window: then it does so by the planes noted."""
    problem, rng = lm.Problem.model_validate(data), np.random.default_rng(1)
    partition = Partition.of(problem)
    sets = CellSets.of(problem, partition)
    allowed = sets.attractor | (rng.random(partition.size) < 0.8) & ~sets.avoid
    whole = Inclusion(problem, partition, sets, allowed)
    pairs = [(np.array([c]), np.array([u])) for c in sets.free[::11] for u in (0, 3, 4)]
    wanted = [bool(whole(*pair)[0]) for pair in pairs]
    seen = dict.fromkeys([(True, False), (False, False), (True, True), (False, True)], 0)
    starts = (0, 4, 11) if partition.periodic[0] else (0, 4, 8)
    for start in starts:
        window = Window(partition, start, 7)
        known = WindowSets(window.of(sets.avoid), window.of(sets.attractor))
        judge = Inclusion(problem, partition, known, window.of(allowed), window)
        for pair, holds in zip(pairs, wanted, strict=True):
            judge.left = judge.left[:0]
            (proved,), (beyond,) = judge.within(*pair)
            seen[holds, bool(beyond)] += 1
            if beyond:
                assert not window.holds(judge.left[:, 0], judge.left[:, 1]).any()
            else:
                assert proved == holds
                assert not len(judge.left)
    assert min(seen.values()) > 1, seen

"""Sets by condition: boxes, discs against exact geometry, seams, the safe side, bounded work."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made, steps
from spent import at_most

import lmdsl as lm
from lmdsl.formulas.language import negation, parse_condition
from lmdsl.formulas.program import Program
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid import conditions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets

NAMES = "abcdefghijklmnop"


def partition(*axes, periodic=()):
    low, high, cells = (np.array(column) for column in zip(*axes, strict=True))
    low, high = low.astype(float), high.astype(float)
    circles = np.array([k in periodic for k in range(len(axes))])
    return Partition(tuple(NAMES[: len(axes)]), low, high, (high - low) / cells, cells, circles)


def nothing():
    pass


def certain(text, grid, **constants):
    condition = parse_condition(text, {*grid.names, *constants})
    return conditions.certain(condition, constants, grid, nothing)


def possible(text, grid, **constants):
    condition = parse_condition(text, {*grid.names, *constants})
    return conditions.possible(condition, constants, grid, nothing)


ENDS = st.one_of(
    st.integers(-8, 8).map(lambda k: k / 4),
    st.floats(-2, 2, allow_subnormal=False),
    st.tuples(st.integers(-8, 8), st.sampled_from([-2e-9, -5e-10, 5e-10, 2e-9])).map(
        lambda t: (t[0] + t[1]) / 4
    ),
)


@settings(max_examples=150, deadline=None)
@given(ENDS, ENDS, ENDS, st.sampled_from([(-2, 2, 16), (-1.9, 2.3, 7)]))
def test_comparisons_mean_the_cells_of_a_box(a, b, c, axis):
    a, b = min(a, b), max(a, b)
    grid = partition(axis, (-2, 2, 16))
    if b - a < 1e-8:
        return
    text = f"a >= {a!r} and a <= {b!r} and b <= {c!r}"
    box = {"a": (a, b), "b": (-9.0, c)}
    inside = grid.mask([grid.inside_box(box, "")])
    overlapping = grid.mask([grid.overlapping_box(box, "")])
    np.testing.assert_array_equal(certain(text, grid), inside)
    np.testing.assert_array_equal(possible(text, grid), overlapping)


@pytest.mark.parametrize("cells", [5, 24, 60])
@pytest.mark.parametrize("radius", [0.5, 0.73, 1.0, 1.7])
@pytest.mark.parametrize("text", ["a**2 + b**2 <= r**2", "sqrt(a*a + b**2) <= r",
                                  "not (a**2 > r**2 - b**2)"])  # fmt: skip
def test_discs_against_exact_geometry(cells, radius, text):
    grid = partition((-2, 2, cells), (-2, 2, cells))
    index = np.stack(grid.multi_index(np.arange(grid.size)), axis=-1)
    low = grid.low + (index + 1e-9) * grid.width
    high = grid.low + (index + 1 - 1e-9) * grid.width
    far = np.hypot(*np.maximum(np.abs(low), np.abs(high)).T)
    near = np.hypot(*np.where(low * high < 0, 0, np.minimum(np.abs(low), np.abs(high))).T)
    np.testing.assert_array_equal(certain(text, grid, r=radius), far <= radius)
    np.testing.assert_array_equal(possible(text, grid, r=radius), near <= radius)


def test_a_seam_is_crossed_by_lists_and_by_functions_of_the_circle():
    grid = partition((-math.pi, math.pi, 36), periodic=(0,))
    box = {"a": (-math.pi, -math.pi + 0.5)}, {"a": (math.pi - 0.5, math.pi)}
    either = grid.mask([grid.inside_box(one, "") for one in box])
    found = certain("a <= -pi + 0.5 or a >= pi - 0.5", grid)
    np.testing.assert_array_equal(found, either)
    np.testing.assert_array_equal(certain("mod(a - (pi - 0.5), 2*pi) <= 1", grid), either)
    np.testing.assert_array_equal(certain("cos(a) <= cos(pi - 0.5)", grid), either)
    assert either[[0, 1, 34, 35]].all()
    assert either.sum() == 4


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([
    "a*b - b**2 < 0.3", "sin(3*a) > cos(b) or b > 1", "mod(a + b, 0.7) < 0.4",
    "not (abs(a) + b**2 >= 1)", "exp(a)*b != 1", "where(a > b, a, b**2) < 1", "log(a) < b",
    "a**3 - a < b and max(a, b) < 1", "floor(a) == -1", "1/(a - 0.37) > 3",
]), st.integers(3, 9))  # fmt: skip
def test_dense_points_never_contradict(text, cells):
    """Certain: it holds at every point of the cell. Not possible: it holds at none."""
    grid = partition((-2, 2, cells), (-1.5, 1.7, cells + 1))
    sure, may = certain(text, grid), possible(text, grid)
    condition = Program([parse_condition(text, grid.names)])
    rng = np.random.default_rng(cells)
    offsets = np.concatenate([
        1e-9 + (1 - 2e-9) * rng.random((200, 2)),
        np.array([[x, y] for x in (1e-9, 0.5, 1 - 1e-9) for y in (1e-9, 0.5, 1 - 1e-9)]),
    ])  # fmt: skip
    points = grid.samples(np.arange(grid.size), offsets)
    held = condition(dict(zip(grid.names, points, strict=True)))[0] != 0
    held = np.broadcast_to(held, (grid.size, len(offsets)))
    assert held[sure].all()
    assert not held[~may].any()
    assert not (sure & ~may).any()


@pytest.mark.parametrize("text", [
    "a*b - b**2 < 0.3", "sin(3*a) > cos(b) or b > 1", "a**3 - a < b and max(a, b) < 1",
    "mod(a + b, 0.7) < 0.4", "sqrt(2*(a - 0.1)**2 + b*b/3) + 0.1 < 1",
])  # fmt: skip
def test_hardly_a_cell_is_left_undecided(text):
    """Cells that dense points say are inside or outside are found so, but for a few."""
    grid = partition((-2, 2, 40), (-1.5, 1.7, 40))
    condition = Program([parse_condition(text, grid.names)])
    fine = np.linspace(1e-9, 1 - 1e-9, 33)
    offsets = np.stack(np.meshgrid(fine, fine, indexing="ij"), axis=-1).reshape(-1, 2)
    points = grid.samples(np.arange(grid.size), offsets)
    held = condition(dict(zip(grid.names, points, strict=True)))[0] != 0
    assert (held.all(axis=1) & ~certain(text, grid)).sum() <= 3
    assert (~held.any(axis=1) & possible(text, grid)).sum() <= 3


def test_what_cannot_be_decided_takes_the_safe_side_and_bounded_work():
    grid = partition((-2, 2, 60), (-2, 2, 60))
    with at_most(60):
        always = "sin(a)**2 + cos(a)**2 + 0*b <= 1"  # of every point, but no enclosure says so
        assert not certain(always, grid).any()
        assert possible("not " + always, grid).all()
        assert not certain("sqrt(a) + 0*b >= 0", grid)[: 30 * 60].any()
        assert possible("sqrt(a) + 0*b >= 0", grid).all()  # nothing is claimed of what is undefined


def test_sixteen_axes_cost_what_the_condition_depends_on():
    grid = partition(*[(0, 1, 2)] * 16)
    with at_most(10):
        held = certain("c + p < 1.1 and k > 0", grid)
    index = np.stack(grid.multi_index(np.arange(grid.size)), axis=-1)
    np.testing.assert_array_equal(held, index[:, 2] + index[:, 15] == 0)
    assert certain("1 < 2", grid).all()
    assert not possible("k < 1", grid, k=3.0).any()


def test_the_deadline_is_asked_for():
    grid = partition((-2, 2, 60), (-2, 2, 60))
    condition = parse_condition("sin(a)**2 + cos(a)**2 + 0*b <= 1", grid.names)
    asked = []

    def guard():
        asked.append(1)
        if len(asked) > 30:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        conditions.certain(condition, {}, grid, guard)
    problem = made(steps(attractor={"where": "sin(x)**2 + cos(x)**2 <= 1 or x < 0.3"}))
    with pytest.raises(lm.TimeLimitReached):
        CellSets.of(problem, Partition.of(problem), Deadline(1e-9))


def test_two_negations_are_one_meaning():
    grid = partition((-2, 2, 21), (-1, 1, 13))
    text = "a*b > 0.2 or a < -1"
    condition = parse_condition(text, grid.names)
    twice = negation(negation(condition))
    np.testing.assert_array_equal(conditions.certain(twice, {}, grid, nothing), certain(text, grid))


def sets_of(**more):
    problem = made(steps(**more))
    return CellSets.of(problem, Partition.of(problem))


def test_sets_are_united_with_each_other_and_with_other_keys():
    found = sets_of(attractor={"cells": [[0]], "where": ["x > 0.7", "x < 0.3 and 1 < 2"]})
    assert found.attractor.tolist() == [True, False, False, True]
    found = sets_of(avoid={"boxes": [{"x": [0.3, 0.4]}], "where": "abs(x - 0.6) < 0.01"})
    assert found.avoid.tolist() == [False, True, True, False]
    found = sets_of(measure={"boxes": [{"x": [0, 0.5]}], "where": "x > 0.75", "density": "1 + x"})
    np.testing.assert_allclose(found.mass, [1.125, 1.375, 0, 1.875])
    found = sets_of(attractor={"where": "x < k"}, let={"k": "1/2"})
    assert found.attractor.tolist() == [True, True, False, False]


def test_a_solution_is_that_of_the_box():
    boxed = lm.solve(made(steps(attractor={"boxes": [{"x": [0, 0.5]}]})))
    by_condition = lm.solve(made(steps(attractor={"where": "x <= 0.5"})))
    assert boxed.lp.digest == by_condition.lp.digest
    assert by_condition.certificate.verified

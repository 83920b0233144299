"""One rule: an image becomes a state, the state lies in a cell, the cell's domain holds it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import doubling, made, steps

import lmdsl as lm
from lmdsl.model.assembly.sampler import Sampler
from lmdsl.model.grid.axis import EDGE, MOST_TURNS, AxisCells
from lmdsl.model.grid.partition import Partition

MOST = 2**31 - 2


def axis_of(low, span, cells, periodic):
    high = low + span
    return AxisCells(low, high, (high - low) / cells, float(cells), 1.0, periodic)


def partition_of(axis, clip=False):
    return Partition(
        ("x",), np.array([axis.low]), np.array([axis.high]), np.array([axis.width]),
        np.array([int(axis.cells)]), np.array([axis.periodic]), clip,
    )  # fmt: skip


@st.composite
def axes(draw):
    cells = draw(
        st.one_of(st.integers(1, 60), st.sampled_from([4_503_600, 10**7, MOST]),
                  st.integers(1, MOST))
    )  # fmt: skip
    low = draw(st.sampled_from([0.0, -1.0, 1.0, -np.pi, 0.1, -3.0, 1e6, -123456.789, 1e-30]))
    span = draw(st.sampled_from([1.0, 2 * np.pi, 0.3, 8.0, 1e-7, 1e9, 1e300]))
    axis = axis_of(low, span, cells, draw(st.booleans()))
    scale = max(abs(axis.low), abs(axis.high))
    if not axis.width > 1e-13 * scale:  # such a file is refused
        cells = max(1, int(axis.cells * axis.width / scale / 2e-13)) if axis.width else 1
        axis = axis_of(low, span, cells, axis.periodic)
    return axis


def neighbours(x, steps=3):
    """Numbers and the doubles next to them."""
    rows = [x]
    for direction in (-np.inf, np.inf):
        y = x
        for _ in range(steps):
            rows.append(y := np.nextafter(y, direction))
    return np.concatenate(rows)


def images_of(axis, rng, turns=0.0):
    """Numbers at edges, within an edge's width of them, their neighbours, and others."""
    n = int(axis.cells)
    some = np.unique(
        np.concatenate([[0, 1, 2, n - 2, n - 1, n, n + 1], rng.integers(0, n + 1, 12)]) % (n + 2)
    ).astype(float)
    by = np.concatenate([[0.0, 1.0, -1.0], rng.uniform(-3, 3, 4)]) * EDGE
    edges = axis.low + (some[:, None] + by).ravel() * axis.width
    span = axis.high - axis.low
    ends = np.array([axis.low, axis.high, axis.low - span, axis.high + span])
    x = np.concatenate([edges, ends, rng.uniform(axis.low, axis.high, 20)])
    if turns:
        x = np.concatenate([x, x + rng.integers(-int(turns), int(turns) + 1, len(x)) * span])
    return neighbours(x)


@settings(max_examples=300, deadline=None, derandomize=True)
@given(axes(), st.sampled_from([3.0, 1e5, 2e6, 1e300]), st.booleans(), st.integers(0, 2**32 - 1))
def test_kernels_and_rule_agree_bit_for_bit_and_grow(axis, turns, clip, seed):
    with np.errstate(over="ignore", invalid="ignore"):
        x = images_of(axis, np.random.default_rng(seed), min(turns, 9e18))
    x = np.concatenate([x, [np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e308, -1e308]])
    index = axis.add_index(x, clip, None)
    state = axis.state(x, clip)
    number = axis.number(x, clip)
    np.testing.assert_array_equal(index, np.mod(number, axis.cells))
    # The loop holds the state: it stays as it is, and lies in the cell of the image.
    np.testing.assert_array_equal(axis.state(state, clip), state)
    np.testing.assert_array_equal(axis.add_index(state, clip, None), index)
    if axis.periodic or clip:
        held = state[np.isfinite(state)]
        assert ((held >= axis.low) & (held <= axis.high)).all()
    at_home = (x >= axis.low) & (x <= axis.high)
    np.testing.assert_array_equal(state[at_home], x[at_home])
    assert not np.isnan(index[at_home]).any()  # a state may be exactly `high`
    finite = np.isfinite(x)
    order = np.argsort(x[finite], kind="stable")
    grown = number[finite][order]
    inside = np.flatnonzero(~np.isnan(grown))
    assert (np.diff(grown[inside]) >= 0).all()
    if len(inside):  # and where it is defined has no holes
        assert (np.diff(inside) == 1).all()


@settings(max_examples=300, deadline=None, derandomize=True)
@given(axes(), st.booleans(), st.integers(0, 2**32 - 1))
def test_all_that_lies_in_a_cell_lies_in_its_domain(axis, clip, seed):
    rng = np.random.default_rng(seed)
    partition = partition_of(axis, clip)
    x = images_of(axis, rng, 3 if axis.periodic else 0)
    state = partition.states(x[:, None])[:, 0]
    cell = partition.locate([state])
    state, cell = state[cell >= 0], cell[cell >= 0]
    corner = np.concatenate([np.zeros(3), np.ones(3), rng.random(3), [np.nextafter(1.0, 0.0)]])
    some = np.unique(cell)[:30]
    sample = partition.samples(some, corner[:, None])[0].ravel()
    state = np.concatenate([state, sample])
    cell = np.concatenate([cell, np.repeat(some, len(corner))])
    low, high, owner = partition.domain(cell)
    held = np.zeros(len(cell), dtype=bool)
    np.logical_or.at(held, owner, (state[owner] >= low[:, 0]) & (state[owner] <= high[:, 0]))
    assert held.all()
    # Exactly, and as MATHEMATICS has it: B = [low + (i - d) w, low + (i + 1 + d) w].
    d, w, start = Fraction(axis.margin), Fraction(axis.width), Fraction(axis.low)
    u = Fraction(1, 2**53)
    reach = max(abs(Fraction(axis.low)), abs(Fraction(axis.high))) / w
    assert abs(d / (Fraction(1e-9) + 8 * u * (int(axis.cells) + reach)) - 1) < 2**-50
    for value, i in zip(state[:40].tolist(), cell[:40].tolist(), strict=True):
        t = (Fraction(value) - start) / w
        ends = [i] + [int(axis.cells) + i] * axis.periodic
        assert any(k - d <= t <= k + 1 + d for k in ends)


def test_the_domain_of_a_cell_at_the_seams_of_two_circles():
    data = doubling()
    circle = {"low": -1, "high": 1, "cells": 4, "periodic": True}
    data["state_box"] = {"x": circle, "y": circle, "z": {"low": 0, "high": 1, "cells": 4}}
    data["system"]["next"] = {"x": "x", "y": "y", "z": "z"}
    data["attractor"] = {"cells": [[0, 0, 0]]}
    partition = Partition.of(made(data))
    low, high, owner = partition.domain(np.array([21, 0, 4]))
    assert owner.tolist() == [0, 1, 2, 1, 2, 1, 1]
    corner = partition.states(np.array([[1.0, 1.0, 0.0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]]))
    assert partition.locate(list(corner.T)).tolist() == [0, 0, 0, 0]
    for state in corner:
        inside = ((state >= low) & (state <= high)).all(axis=1)
        assert 1 in owner[inside]
    for k in range(3):
        assert (high[:, k] - low[:, k] < partition.width[k] * 1.001).all()


def far(turns):
    """x+ = x + turns + u, wrapped: near the edges, located before and after wrapping may differ."""
    return {
        **doubling(),
        "system": {"kind": "map", "next": {"x": f"x + {turns} + u"}},
        "state_box": {"x": {"low": 0, "high": 0.7, "cells": 50, "periodic": True}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"low": 0, "high": 0.7, "points": 100}},
        "on_exit": "forbid",
    }


@pytest.mark.parametrize("turns", [0, 7, 70_000.0])
def test_compilation_and_loop_find_the_same_cells(turns):
    problem = made(far(turns))
    partition = Partition.of(problem)
    sampler = Sampler(problem, partition)
    loop = lm.solve(made(far(0))).closed_loop.partition
    rng = np.random.default_rng(0)
    unwrapped = 0
    for block in sampler.blocks(np.arange(50)):
        values = sampler.values(block)
        image = sampler.step(values)[0]
        for found in (sampler.outcomes(block)[0], sampler.images(block, values)):
            states, cell = loop.enter(image.reshape(-1, 1))
            np.testing.assert_array_equal(found.ravel(), cell)
            np.testing.assert_array_equal(partition.locate([states[:, 0]]), cell)
        edges = np.arange(1, 50) * partition.width[0] + turns // 0.7 * 0.7
        near = neighbours(edges + rng.uniform(-2e-9, 2e-9, (20, 49)) * partition.width[0], 1)
        old = np.floor(near / partition.width[0] + EDGE) % 50
        unwrapped += int((old != loop.enter(near.reshape(-1, 1))[1].reshape(near.shape)).sum())
    assert (unwrapped > 0) == (turns > 1000)  # the images that make the difference are there


def test_starting_points_are_wrapped_too():
    result = lm.solve(made(doubling()))
    loop = result.closed_loop
    path = loop.path([7.8], 10)
    np.testing.assert_allclose(path[:2, 0], [0.8, 0.6])
    for start in (1.0, -1e-20, 7.0):  # exactly `high`, twice; 0
        path = loop.path([start], 5)
        assert path.shape == (1, 1)  # cell 0 is the attractor
        assert 0 <= path[0, 0] <= 1
    assert loop.path([-1e-20], 5)[0, 0] == 1.0
    runs = loop.run(np.array([[7.8], [1.0], [-0.2]]), 9, np.random.default_rng(0))
    assert (runs.outcome == 0).all()
    assert runs.taken[1] == 0
    np.testing.assert_array_equal(result.controller([[7.3], [0.3]]), np.zeros((2, 0)))


def test_clipping_is_one_rule_too():
    data = steps(on_exit="clip")
    data["system"]["next"] = {"x": "x + 9*u"}
    data["attractor"] = {"cells": [[3]]}
    result = lm.solve(made(data))
    assert result.closed_loop.path([-3.0], 5).tolist() == [[0.0], [1.0]]
    assert result.controller([[-3.0], [0.3], [0.0]]).ravel().tolist() == [1, 1, 1]
    assert np.isnan(result.controller([[np.inf], [7.0]])).all()  # out; the attractor, at `high`
    assert result.partition.states(np.array([[np.inf], [7.0]])).tolist() == [[np.inf], [1.0]]


def test_too_many_turns_are_out():
    axis = axis_of(0.0, 1.0, 4, True)
    x = np.array([1, -1])[:, None] * (MOST_TURNS + np.array([-1.0, 0.5, 1.0, 1e3, 1e300]))
    index = axis.add_index(x.ravel(), False, None).reshape(x.shape)
    np.testing.assert_array_equal(np.isnan(index[0]), [False, False, True, True, True])
    np.testing.assert_array_equal(np.isnan(index[1]), [False, True, True, True, True])
    with pytest.raises(lm.BadInput, match=r"attractor.points\[0\].x: 3000000.0 is too many turns"):
        lm.compile(made(doubling(attractor={"points": [[3e6]]})))

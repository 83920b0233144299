"""Phase portraits and runs are those of the true map."""

from __future__ import annotations

import numpy as np
import pytest
from pictures import maze, patches
from problems import made, standard_map

import lmdsl as lm
from lmdsl import plotting
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import regions, runs
from lmdsl.plotting.view import View, segments

pytest.importorskip("matplotlib")


def test_portrait_follows_the_true_map(solved):
    result = solved("standard")
    ax = plotting.portrait(result, control=1.0, starts=3, steps=5)
    assert ax.get_title() == "map at u = 1"
    dots = np.asarray(ax.collections[0].get_offsets())
    assert len(dots) == 9 * 6
    x, y = dots.T
    kick = 0.25 * np.sin(2 * np.pi * x)
    images = np.stack([(x + y + kick) % 1, (y + kick) % 1], axis=-1)
    distance = np.abs(images[:, None] - dots[None]).max(axis=-1).min(axis=1)
    assert (distance < 1e-12).sum() == 9 * 5  # all but the last of each run
    assert "attractor" in patches(ax)


def test_portrait_of_a_problem_and_its_controls(solved):
    problem = made(maze())
    assert plotting.portrait(problem).get_title() == "map at u = 0, v = 0"
    assert plotting.portrait(problem, {"v": -1, "u": 0.5}).get_title() == "map at u = 0.5, v = −1"
    assert plotting.portrait(problem, [1, 2]).get_title() == "map at u = 1, v = 2"
    for wrong in (1.0, [1, np.nan], {"u": 1}):
        with pytest.raises(lm.BadInput, match="control"):
            plotting.portrait(problem, wrong)
    with pytest.raises(lm.BadInput, match="two axes"):
        plotting.portrait(problem, axes=("x",))
    assert plotting.portrait(solved("autonomous")).get_title() == "map"


def test_portrait_of_one_dimension_is_a_cobweb(solved):
    ax = plotting.portrait(solved("logistic"), 0.01)
    diagonal, graph, web = ax.lines
    assert np.array_equal(*diagonal.get_data())
    x, y = graph.get_data()
    assert np.allclose(y, 4.3 * x * (1 - x) + 0.01)
    u, v = web.get_data()
    assert np.allclose(v[1::2], 4.3 * u[1::2] * (1 - u[1::2]) + 0.01)
    assert np.array_equal(u[::2], v[::2])


def test_lines_of_an_ode_pass_through_the_states_of_the_model(solved):
    result = solved("lorenz")
    x = np.array([[5.0, 5.0, 20.0], [-19.0, 0.0, 30.0]])
    p = result.partition
    coarse, fine = (runs.constant_map(result.problem, p, fine) for fine in (False, True))
    u = np.full((2, 1), 30.0)
    image = x
    for _ in range(runs.PIECES):
        image = fine(image, u)
    assert np.allclose(image, coarse(x, u), rtol=1e-3)
    points, last, pieces = runs.closed_loop(result, x, steps=50, seed=0)
    for k in range(2):
        path = result.closed_loop.path(x[k], 50)
        assert np.allclose(points[::pieces, k][: len(path)], path)
        assert (result.partition.locate(list(path[-1:].T)) == last[k]).all()


def test_trajectories_are_the_closed_loop(solved):
    result = solved("standard")
    starts = np.array([[0.1, 0.9], [0.6, 0.2], [0.25, 0.5]])
    ax = plotting.trajectories(result, starts=starts)
    assert ax.get_title() == "closed loop, 3 of 3 runs reach A"
    dots = np.concatenate([np.asarray(c.get_offsets()) for c in ax.collections])
    for start in starts:
        for state in result.closed_loop.path(start, 500):
            assert np.nanmin(np.abs(dots - state).max(axis=1)) < 1e-12
    assert "attractor" in patches(ax)
    first, second = (plotting.trajectories(result, seed=3) for _ in range(2))
    assert np.array_equal(first.collections[0].get_paths()[0].vertices,
                          second.collections[0].get_paths()[0].vertices)  # fmt: skip
    for wrong in (0, [0.1, 0.2], [[0.1]]):
        with pytest.raises(lm.BadInput, match="starts"):
            plotting.trajectories(result, starts=wrong)


def test_lost_runs_are_marked(solved):
    result = solved("maze")
    ax = plotting.trajectories(result, starts=[[0.55, 0.1], [0.15, 0.15]])
    assert ax.get_title() == "closed loop, 1 of 2 runs reach A"
    ends, crosses = (c.get_offsets() for c in ax.collections if c.get_zorder() == 4)
    assert len(ends) == 1
    assert np.allclose(crosses, [[0.55, 0.1]])


def test_lines_break_where_an_axis_wraps():
    problem = made(standard_map(20))
    partition = lm.solve(problem).partition
    view = View.of(partition, np.arange(400) == 0)
    points = np.array([[[0.9, 0.5]], [[0.1, 0.6]], [[0.2, 0.6]], [[np.nan, np.nan]]])
    pieces, run = segments(points, view)
    assert np.allclose(
        pieces,
        [[[0.9, 0.5], [1.1, 0.6]], [[0.1, 0.6], [0.2, 0.6]], [[-0.1, 0.5], [0.1, 0.6]]],
    )
    assert (run == 0).all()
    assert (np.abs(pieces[:, 1] - pieces[:, 0]) < 0.5).all()


def test_runs_of_one_dimension_go_over_the_step(solved):
    ax = plotting.trajectories(solved("logistic"), starts=[[0.3]])
    path = solved("logistic").closed_loop.path([0.3], 500)[:, 0]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("step", "x")
    dots = np.asarray(next(c for c in ax.collections if c.get_zorder() == 2.2).get_offsets())
    assert np.array_equal(dots, np.stack([np.arange(len(path)), path], axis=-1))


def test_portrait_of_a_result_shows_what_is_left_of_the_attractor(monkeypatch):
    axis = {"low": -1, "high": 1, "cells": 20}
    held = {
        "system": {"kind": "map", "next": {"x": "1.5 * x + u", "y": "0.5 * y"}},
        "state_box": {"x": axis, "y": axis},
        "attractor": {"boxes": [{"x": [-0.6, 0.6], "y": [-0.3, 0.3]}]},
        "control_grid": {"u": {"low": -0.2, "high": 0.2, "points": 9}},
        "stage_cost": "1",
        "local_controller": {"kind": "hold"},
        "sampling": {"kind": "grid", "per_axis": 3},
        "format": "lmdsl/1",
    }
    result = lm.solve(made(held))
    left = np.flatnonzero(result.cell_status == CellStatus.ATTRACTOR)
    seen = []
    outline = regions.outline
    monkeypatch.setattr(regions, "outline", lambda ax, view, mask, *more: (
        seen.append(np.flatnonzero(mask)), outline(ax, view, mask, *more)))  # fmt: skip
    plotting.portrait(result)
    plotting.portrait(result.problem)
    assert 0 < len(left) < len(seen[1])
    np.testing.assert_array_equal(seen[0], left)

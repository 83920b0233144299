"""The controller and the closed loop: wrap, clip, outcomes, starts, the interval."""

from __future__ import annotations

import numpy as np
import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.control.simulation import clopper_pearson


def test_vectorised_call_wraps_and_knows_its_limits():
    result = lm.solve(made(standard_map(20)))
    x = np.random.default_rng(0).random((3, 5, 2))
    u = result.controller(x)
    assert u.shape == (3, 5, 1)
    np.testing.assert_array_equal(result.controller(x + np.array([1.0, -2.0])), u)
    assert np.isnan(result.controller([0.25, 0.5])).all()  # on the attractor
    assert np.isnan(result.controller([np.nan, 0.5])).all()
    line = lm.solve(made(steps()))
    assert line.controller([[0.3], [0.99], [1.0]]).ravel().tolist() == [1, 1, 1]
    assert np.isnan(line.controller([[-0.1], [1.1], [0.1]])).all()


def test_closed_loop_wraps():
    loop = lm.solve(made(doubling())).closed_loop
    x, cell = loop.step(np.array([[0.8], [0.3]]), np.array([1, 0]), np.random.default_rng(0))
    np.testing.assert_allclose(x, [[0.6], [0.6]])
    assert cell.tolist() == [1, 1]


def test_closed_loop_clips():
    data = steps(on_exit="clip")
    data["system"]["next"] = {"x": "-7 + 14*(1 - u)"}
    loop = lm.solve(made(data)).closed_loop
    x, cell = loop.step(np.array([[0.3]]), np.array([1]), np.random.default_rng(0))
    assert x.tolist() == [[0.0]]
    assert cell.tolist() == [0]


def test_outcomes_steps_and_starts():
    result = lm.solve(made(steps(measure={"boxes": [{"x": [0.75, 1]}]})))
    runs = result.simulate(starts=50, steps=3)
    assert runs.reached == 50  # the last step counts
    assert set(runs.steps.values()) == {3}
    short = result.simulate(starts=50, steps=2)
    assert (short.reached, short.cycling, short.lost) == (0, 50, 0)
    assert short.steps is None
    assert short.interval[0] == 0


def test_lost_runs_are_counted():
    # The sampled model sees one point per cell; the true map also leaves from the cell's rim.
    data = steps()
    data["system"]["next"] = {"x": "where(abs(x - 0.625) < 0.1, x - 0.25*u, x - 0.25*u - 0.5)"}
    data["sampling"] = {"kind": "grid", "per_axis": 1}
    data["attractor"] = {"cells": [[1]]}
    data["measure"] = {"boxes": [{"x": [0.5, 0.75]}]}
    result = lm.solve(made(data))
    assert result.status == "verified"
    runs = result.simulate(starts=2000, steps=10)
    assert runs.reached + runs.lost + runs.cycling == 2000
    assert 0.1 < runs.lost / 2000 < 0.3  # 20 % of the cell lies outside 0.1 around its centre


def test_noise_is_drawn_with_its_weights():
    data = steps()
    data["system"]["next"] = {"x": "x - 0.25*w"}
    data["control_grid"] = {}
    data["noise"] = {"w": {"values": [0, 1], "weights": [0.9, 0.1]}}
    data["measure"] = {"boxes": [{"x": [0.25, 0.5]}]}
    runs = lm.solve(made(data)).simulate(starts=5000, steps=1, seed=3)
    assert runs.reached / 5000 == pytest.approx(0.1, abs=0.02)
    assert runs.interval[0] < 0.1 < runs.interval[1]


def test_same_seed_same_runs():
    result = lm.solve(made(standard_map(20)))
    assert result.simulate(starts=300, seed=5) == result.simulate(starts=300, seed=5)
    assert result.simulate(starts=300, seed=5) != result.simulate(starts=300, seed=6)


def test_clopper_pearson():
    # Known values: 0 of 10 and 10 of 10 give 1 - 0.025^(1/10).
    assert clopper_pearson(0, 10) == (0.0, pytest.approx(1 - 0.025**0.1))
    assert clopper_pearson(10, 10) == (pytest.approx(0.025**0.1), 1.0)
    low, high = clopper_pearson(8, 10)
    assert (low, high) == (pytest.approx(0.4439, abs=1e-4), pytest.approx(0.9748, abs=1e-4))


def test_a_path_ends_in_the_attractor():
    path = lm.solve(made(steps())).closed_loop.path([0.9], 10)
    np.testing.assert_allclose(path[:, 0], [0.9, 0.65, 0.4, 0.15])


def test_an_avoid_box_thinner_than_an_edge_avoids_nothing():
    data = steps(avoid={"boxes": [{"x": [0.6, 0.6 + 1e-11]}]})
    assert 5 not in lm.compile(made(data)).cell_status

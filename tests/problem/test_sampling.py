"""Sample points: by axis, and the corners of cells."""

from __future__ import annotations

import itertools
import warnings

import numpy as np
import pytest
from problems import made

import lmdsl as lm
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.discretization import offsets, sample_points
from lmdsl.model.grid.partition import Partition


def turning(sampling, **more):
    """A circle whose width is no double, and an interval; the image is the sample itself."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"a": "a", "x": "x"}},
        "state_box": {"a": {"low": -0.3, "high": 0.7, "cells": 7, "periodic": True},
                      "x": {"low": 0.1, "high": 0.4, "cells": 3}},
        "attractor": {"cells": [[0, 0]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": sampling,
        **more,
    }  # fmt: skip


CORNERS = [[0, 0], [0, 1], [1, 0], [1, 1]]


def test_a_number_an_axis():
    problem = made(turning({"kind": "grid", "per_axis": {"x": 2, "a": 3}}))
    expected = [[i, j] for i in (1 / 6, 1 / 2, 5 / 6) for j in (0.25, 0.75)]
    assert offsets(problem) == pytest.approx(np.array(expected))
    assert sample_points(problem) == 6
    again = lm.Problem.model_validate(problem.to_dict())
    assert again == problem
    same = made(turning({"kind": "grid", "per_axis": {"x": 2, "a": 2}}))
    np.testing.assert_array_equal(
        offsets(same), offsets(made(turning({"kind": "grid", "per_axis": 2})))
    )


@pytest.mark.parametrize(
    "sampling",
    [{"kind": "grid", "per_axis": 2}, {"kind": "random", "points": 5, "seed": 3},
     {"kind": "sobol", "points": 4, "seed": 3}],
)  # fmt: skip
def test_corners_follow_the_points(sampling):
    inner = offsets(made(turning(sampling)))
    problem = made(turning({**sampling, "corners": True}))
    found = offsets(problem)
    np.testing.assert_array_equal(found[: len(inner)], inner)
    assert found[len(inner) :].tolist() == CORNERS
    assert sample_points(problem) == len(found)


def test_the_last_corner_is_the_end_of_the_axis():
    """Offset 1 of the last cell is ``high`` to the bit, elsewhere low + (i + 1) width."""
    problem = made(turning({"kind": "grid", "per_axis": 1, "corners": True}))
    p = Partition.of(problem)
    sampler = Sampler(problem, p)
    cells = np.arange(p.size)
    values = sampler.values(Block(0, cells, (0, 1)))
    for k, name in enumerate(("a", "x")):
        x = np.broadcast_to(values[name], (1, 5, 1, p.size))[0, :, 0]
        index = p.multi_index(cells)[k]
        for s, offset in enumerate([0.5] + [corner[k] for corner in CORNERS]):
            expected = p.low[k] + (index + offset) * p.width[k]
            if offset == 1:
                expected = np.where(index == p.cells[k] - 1, p.high[k], expected)
            np.testing.assert_array_equal(x[s], expected)
        np.testing.assert_array_equal(p.samples(cells, sampler.points)[k], x.T)


def test_a_corner_at_high_of_a_circle_is_not_wrapped_before_the_formula():
    """x+ = x - high is 0 there, and far from 0 at ``low``, the same place of the circle."""
    data = turning({"kind": "grid", "per_axis": 1, "corners": True})
    data["system"]["next"] = {"a": "where(a == 0.7, 10*x, a)", "x": "where(a == 0.7, 9, x)"}
    status = lm.compile(made(data)).cell_status.reshape(7, 3)
    assert (status[6] == 2).all()  # all but these may stay where they are
    assert (status[:6].ravel()[1:] != 2).all()


@pytest.mark.parametrize(
    ("sampling", "field", "words"),
    [
        ({"kind": "grid", "per_axis": {"a": 2}}, "sampling.per_axis", "no number for the axis x"),
        ({"kind": "grid", "per_axis": {"a": 2, "y": 2}}, "sampling.per_axis", "'y' is not an axis"),
        ({"kind": "grid", "per_axis": {"a": 2, "x": 0}}, "sampling.per_axis.x", "at least 1"),
        ({"kind": "grid", "per_axis": {}}, "sampling.per_axis", "no number for the axis a"),
        ({"kind": "grid", "per_axis": "2"}, "sampling.per_axis", "write"),
        ({"kind": "grid", "per_axis": 2, "corners": 1}, "sampling.corners", "write"),
        ({"kind": "random", "points": 2, "corners": "yes"}, "sampling.corners", "write"),
    ],
)
def test_what_does_not_fit_is_refused(sampling, field, words):
    with pytest.raises(lm.BadInput, match=words) as error:
        made(turning(sampling))
    assert field in str(error.value)


def test_corners_are_for_eight_axes():
    names = "abcdfghij"
    data = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {name: name for name in names}},
        "state_box": {name: {"low": 0, "high": 1, "cells": 1} for name in names},
        "attractor": {"cells": [[0] * 9]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1, "corners": True},
    }
    with pytest.raises(lm.BadInput, match="at most 8 axes") as error:
        made(data)
    assert error.value.where == "sampling.corners"
    for key in ("system", "state_box"):
        inner = data[key]["next"] if key == "system" else data[key]
        del inner["j"]
    data["attractor"] = {"cells": [[0] * 8]}
    found = offsets(made(data))[1:]
    assert [tuple(map(int, row)) for row in found] == list(itertools.product((0, 1), repeat=8))


@pytest.mark.parametrize("points", [1, 2, 3, 5, 8, 13, 1000])
def test_sobol_points_are_those_of_scipy(points, monkeypatch):
    """Whose warning no filter of the process has to hide: these are not a thread's."""
    from scipy.stats import qmc

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        expected = qmc.Sobol(2, scramble=True, seed=4).random(points)
    problem = made(turning({"kind": "sobol", "points": points, "seed": 4}))
    monkeypatch.delattr(warnings, "catch_warnings")
    warnings.simplefilter("error")
    np.testing.assert_array_equal(offsets(problem), expected)

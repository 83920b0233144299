"""Steps that jump over the attractor on curved paths, and coverage where it is estimated."""

from __future__ import annotations

import numpy as np
import pytest
from checked import found, pendulum, shift
from problems import made

import lmdsl as lm
from lmdsl.advice import jumps, sizes

AXIS = {"low": -1, "high": 1, "cells": 40}


def rotation(step, **more):
    """A spiral into 0; A lies aside of it."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "derivative": {"x": "-y - x/20", "y": "x - y/20"}, "step": step,
                   "substeps": "auto", "judged": "endpoint"},
        "state_box": {"x": AXIS, "y": AXIS},
        "attractor": {"boxes": [{"x": [0.5, 0.6], "y": [-0.2, 0.2]}]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        "on_exit": "clip",
        **more,
    }  # fmt: skip


def double_integrator(step, **more):
    return rotation(
        step,
        system={"kind": "ode", "derivative": {"x": "v", "v": "u"}, "step": step,
                "judged": "endpoint"},
        state_box={"x": AXIS, "v": AXIS},
        attractor={"boxes": [{"x": [-0.1, 0.1], "v": [-0.1, 0.1]}]},
        control_grid={"u": {"values": [-1, 1]}},
        on_exit="forbid",
        **more,
    )  # fmt: skip


def coverage(data):
    lp = lm.compile(made(data))
    return lp.n / np.isin(lp.cell_status, [0, 5], invert=True).sum()


# Jumps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [rotation(2), rotation(3), double_integrator(0.8),
                                  double_integrator(0.4)])  # fmt: skip
def test_paths_that_run_over_the_attractor(data):
    """On circles, and by more than a quarter of an axis; the remedy does what it says."""
    figures = found(data)["long_step"].figures
    along = {**data, "system": {**data["system"], "judged": "path"}}
    assert figures["share"] == pytest.approx(coverage(data))
    assert figures["share_then"] == pytest.approx(coverage(along))
    assert figures["share_then"] > figures["share"] + 0.05
    assert figures["jumping"] > 0


@pytest.mark.parametrize("data", [rotation(0.2), double_integrator(0.1), double_integrator(0.2)])
def test_steps_that_miss_nothing(data):
    assert "long_step" not in found(data)


def test_no_remedy_that_does_not_help():
    """Samples run over A, and all that can arrive does so by other controls."""
    data = double_integrator(0.4)
    data["control_grid"]["u"]["values"] = [-1, -0.5, -0.25, 0, 0.25, 0.5, 1]
    along = {**data, "system": {**data["system"], "judged": "path"}}
    if coverage(along) < coverage(data) + 0.03:
        assert "long_step" not in found(data)


def test_landing_and_jumping_are_counted_one_by_one():
    """x' = u, u = 1 or -1, step 0.3: from x the image is x + 0.3 u, A is [-0.1, 0.1]."""
    data = shift(cells=80, controls=(-1, 1), attractor={"boxes": [{"x": [-0.1, 0.1]}]})
    data["system"] = {"kind": "ode", "derivative": {"x": "u"}, "step": 0.3, "judged": "endpoint"}
    figures = found(data)["long_step"].figures
    x = -4 + (np.arange(80) + 0.5) * 0.1
    x = x[abs(x) > 0.1]
    ends, before = np.abs(np.abs(x) - 0.3) < 0.1, np.abs(x) < 0.4
    assert figures["landing"] == ends.sum()
    assert figures["jumping"] == (before & ~ends).sum()


def test_jumps_where_compiling_is_not_cheap(monkeypatch):
    monkeypatch.setattr(jumps.remedies, "cheap", lambda *_: False)
    monkeypatch.setattr(sizes, "OWN_WORK", 0)
    monkeypatch.setattr(sizes, "WORK", 0)
    data = shift(cells=80, controls=(-1, 1), attractor={"boxes": [{"x": [-0.1, 0.1]}]})
    data["system"] = {"kind": "ode", "derivative": {"x": "u"}, "step": 3, "judged": "endpoint"}
    figures = found(data)["long_step"].figures
    assert "share" not in figures
    assert figures["jumping"] > 9 * figures["landing"]
    assert "long_step" not in found(rotation(0.2))


# Estimates -----------------------------------------------------------------------------------


@pytest.fixture
def small(monkeypatch):
    """Only grids of at most so many additions are compiled, and never the problem's own."""

    def limit(data, cells):
        data = {**data, "state_box": {k: {**a, "cells": cells} for k, a in
                                      data["state_box"].items()}}  # fmt: skip
        monkeypatch.setattr(sizes, "OWN_WORK", 0)
        monkeypatch.setattr(sizes, "WORK", 1.01 * sizes.work(made(data)))

    return limit


def large(data, cells):
    for axis in data["state_box"].values():
        axis["cells"] = cells
    return data


@pytest.mark.parametrize("name", ["pendulum", "points", "double integrator"])
def test_an_estimate_on_fewer_cells(name, small):
    data = large(pendulum(), 60)
    if name == "points":
        data = large(pendulum(attractor={"points": [[0, 0]]}), 60)
    if name == "double integrator":
        data = large(double_integrator(0.2), 80)
        data["state_box"] = {key: {**AXIS, "cells": 80} for key in ("x", "v")}
    true, cells = coverage(data), data["state_box"]
    small(data, 40)
    report = lm.check(made(data))
    expected = report.expected
    assert 0 < max(expected.coverage_cells.values()) <= 40 < min(a["cells"] for a in cells.values())
    assert "about" in str(report)
    assert "an estimate on" in str(report)
    assert expected.coverage == pytest.approx(true, abs=0.15)
    assert expected.coverage_coarser is not None
    assert not expected.attractor_widened


def test_an_attractor_smaller_than_a_coarse_cell_is_widened(small):
    data = large(pendulum(attractor={"boxes": [{"th": [-0.11, 0.11], "om": [-0.3, 0.3]}]}), 60)
    true = coverage(data)
    small(data, 30)
    expected = lm.check(made(data)).expected
    assert expected.coverage_cells == {"th": 30, "om": 30}
    assert expected.attractor_widened
    assert expected.coverage == pytest.approx(true, abs=0.15)
    assert "widened to whole cells" in str(lm.check(made(data)))


def test_an_attractor_of_indices_is_found_again_on_fewer_cells(small):
    boxes = large(pendulum(attractor={"boxes": [{"th": [-0.42, 0.42], "om": [-1.1, 1.1]}]}), 60)
    cells = np.argwhere((lm.compile(made(boxes)).cell_status == 0).reshape(60, 60)).tolist()
    same = {**boxes, "attractor": {"cells": cells}}
    small(boxes, 30)
    first, second = (lm.check(made(one)).expected for one in (boxes, same))
    assert first.coverage_cells == second.coverage_cells == {"th": 30, "om": 30}
    assert second.coverage == pytest.approx(first.coverage, abs=0.1)


def test_cells_that_are_tried_bound_what_can_be_stabilized(small):
    """x+ = x + u, u = 3 or 4 on [-4, 4]: from x > 1 every control leaves."""
    data = shift("u", controls=(3, 4), cells=160, attractor={"where": "x > 3.9 and x < 3.95 + 0*x"})
    data["attractor"] = {"boxes": [{"x": [3.5, 4]}]}
    small(data, 4)
    report = lm.check(made(data))
    expected = report.expected
    assert expected.coverage is None
    assert expected.coverage_at_most == pytest.approx(5 / 7.5, abs=0.02)
    assert "% at most" in str(report)


def test_the_problem_itself_is_no_estimate():
    report = lm.check(made(pendulum()))
    assert report.expected.coverage_cells == report.axes
    assert report.expected.coverage_coarser is None
    assert "about" not in str(report).split("\n")[1]

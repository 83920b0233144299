"""``check``: every finding where it must be found, and none where nothing is wrong."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from checked import found, pendulum, shift
from problems import made, standard_map
from random_problems import random_problem

import lmdsl as lm
from lmdsl.advice import sizes

# Nothing is wrong ------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [pendulum(), shift(), standard_map(20)])
def test_nothing_is_found_where_nothing_is_wrong(data):
    report = lm.check(made(data))
    assert not report
    assert not report.findings
    assert "nothing looks wrong" in str(report)


SHIPPED = [
    "henon_map", "inverted_pendulum", "logistic_map", "standard_map", "standard_map_held",
    "van_der_pol",
]  # fmt: skip


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_problems_look_right(name):
    assert not lm.check(lm.load(f"examples/{name}.json"))


LARGER = ["cart_pole", "double_integrator", "lorenz", "pendulum_on_cart"]


def test_every_shipped_problem_is_looked_at():
    assert {path.stem for path in Path("examples").glob("*.json")} == {*SHIPPED, *LARGER}


@pytest.mark.long
@pytest.mark.parametrize("name", LARGER)
def test_larger_shipped_problems_look_right(name):
    assert not lm.check(lm.load(f"examples/{name}.json"))


def test_a_step_that_is_too_short_for_all_that_is_tried():
    data = shift(low=-1, high=1, cells=20, controls=(-0.1, 0, 0.1), per_axis=3)
    data["attractor"] = {"boxes": [{"x": [-0.1, 0.1]}]}
    data["system"] = {"kind": "ode", "derivative": {"x": "-x + u"}, "step": 0.0005}
    finding = found(data)["short_step"]
    assert finding.where == "system.step"
    assert finding.figures["step"] == pytest.approx(0.1 / 0.65, rel=0.3)  # a width at mean speed
    data["system"]["step"] = finding.figures["step"]
    assert lm.solve(made(data)).coverage.share == 1
    data["system"] = {"kind": "map", "next": {"x": "x + 0.0001*u"}}
    assert "steps of its map at once" in found(data)["short_step"].remedy
    data["system"] = {"kind": "map", "next": {"x": "x + 0*u"}}
    assert "short_step" not in found(data)


def test_a_cost_that_is_none_on_finer_cells_only():
    """Twice the cells have samples nearer to 0, where the cost is negative: they are not tried."""
    data = shift(low=-1, high=1, cells=20, stage_cost=lambda x: np.abs(x) - 0.03)
    data["attractor"] = {"boxes": [{"x": [0.5, 0.7]}]}
    data["sampling"] = {"kind": "grid", "per_axis": 1}
    assert lm.check(made(data)).expected.coverage is not None


# Steps -----------------------------------------------------------------------------------------


def test_a_step_so_short_that_cells_stay_put():
    finding = found(pendulum(0.01))["short_step"]
    figures = finding.figures
    assert finding.where == "system.step"
    assert 0 < figures["cells"] <= figures["tried"]
    assert figures["moved"] < 1
    # The remedy does what it says.
    system = {"step": figures["step"], "substeps": figures["substeps"]}
    assert json.dumps(system)[1:-1] in finding.remedy
    data = pendulum()
    data["system"] |= system
    coverage = lm.solve(made(data)).coverage
    assert coverage.share == pytest.approx(figures["share_then"])
    assert figures["share_then"] >= figures["share"] + 0.1


def test_a_step_that_moves_every_cell_may_still_be_too_short():
    figures = found(pendulum(0.02))["short_step"].figures
    assert figures["cells"] <= 0.05 * figures["tried"]
    assert figures["share"] < 0.1 < 0.8 < figures["share_then"]


def test_a_map_that_moves_too_little():
    finding = found(shift("0.01*u"))["short_step"]
    assert finding.figures["cells"] == finding.figures["tried"] == 14
    assert finding.figures["moved"] == pytest.approx(0.02)
    # 0.01 moves the middle of a cell over its edge from a width of 0.02 on: 512 cells, not 256.
    assert finding.figures["cells_needed"] == {"x": 512}
    assert "51 steps" in finding.remedy or "50 steps" in finding.remedy


def test_no_step_is_too_short_for_a_map_that_rests():
    assert "short_step" not in found(shift("0*u"))


def test_a_step_that_jumps_over_the_attractor():
    jumping = shift("0.9*u", cells=80, controls=(-1, 1), attractor={"boxes": [{"x": [-0.1, 0.1]}]})
    finding = found(jumping)["long_step"]
    assert finding.figures["landing"] == 0
    assert finding.figures["widths_of_attractor"] == pytest.approx(4.5)
    landing = shift("0.9*u", cells=80, attractor={"boxes": [{"x": [-0.5, 0.5]}]})
    assert "long_step" not in found(landing)


def test_jumping_does_not_matter_where_the_path_is_judged():
    system = {"kind": "ode", "derivative": {"x": "u"}, "step": 0.9}
    for judged, expected in (("endpoint", True), ("path", False)):
        data = shift(cells=80, controls=(-1, 1), attractor={"boxes": [{"x": [-0.1, 0.1]}]})
        data["system"] = {**system, "judged": judged}
        report = found(data)
        assert ("long_step" in report) == expected
        if expected:
            assert '"judged": "path"' in report["long_step"].remedy


def test_steps_that_miss_the_equation():
    problem = lm.load("examples/van_der_pol.json")
    coarse = problem.replaced(system={"kind": "van_der_pol", "step": 0.4, "substeps": 1})
    findings = {finding.code: finding for finding in lm.check(coarse).findings}
    figures = findings["few_substeps"].figures
    assert figures["widths"] > 1
    enough = coarse.system.replaced(substeps=figures["substeps_needed"])
    assert "few_substeps" not in {f.code for f in lm.check(coarse.replaced(system=enough)).findings}


# Attractors ------------------------------------------------------------------------------------


def at_a_point():
    """The shipped double integrator, with the point in its attractor's middle as attractor."""
    return lm.load("examples/double_integrator.json").replaced(attractor={"points": [[0, 0]]})


def test_an_attractor_of_points_that_shrinks_with_the_cells():
    # 88, 59, 30, 15 % stabilizable on 1, 2, 4, 8 times the cells an axis.
    problem = at_a_point()
    (finding,) = lm.check(problem).findings
    assert finding.code == "shrinking_attractor"
    shares = finding.figures["shares"]
    assert shares["80 x 60 cells"] == pytest.approx(0.88, abs=0.01)
    assert shares["160 x 120 cells"] == pytest.approx(0.59, abs=0.01)
    boxes = finding.figures["boxes"]
    assert boxes == [{"x": (-0.05, 0.05), "v": (-0.05, 0.05)}]
    # A box is the cure: the one that is shipped, with the same cells as the point.
    box = problem.replaced(attractor={"boxes": boxes})
    assert box == lm.load("examples/double_integrator.json")
    assert lm.compile(box).digest == lm.compile(problem).digest
    assert not lm.check(box)
    axes = {name: axis.replaced(cells=2 * axis.cells) for name, axis in problem.state_box.items()}
    lp = lm.compile(box.replaced(state_box=axes))
    share = (lp.cell_status == lm.CellStatus.STABILIZED).mean()
    assert share == pytest.approx(finding.figures["share_with_boxes"], abs=0.001)
    assert share > 0.85


def test_a_box_for_an_attractor_that_has_shrunk_already():
    problem = at_a_point()
    axes = {name: axis.replaced(cells=4 * axis.cells) for name, axis in problem.state_box.items()}
    findings = {f.code: f for f in lm.check(problem.replaced(state_box=axes)).findings}
    figures = findings["shrinking_attractor"].figures
    assert figures["shares"]["320 x 240 cells"] == pytest.approx(0.30, abs=0.01)
    assert figures["share_with_boxes"] > 0.85
    # The map is a step of 0.15: it jumps over cells of 0.0125.
    assert findings["long_step"].figures["widths_of_attractor"] > 1


def test_points_do_not_matter_where_they_suffice():
    data = standard_map(20)
    assert "points" in data["attractor"]
    assert "shrinking_attractor" not in found(data)


# Names -----------------------------------------------------------------------------------------


def test_names_that_no_formula_uses():
    data = pendulum(
        control_grid={"u": {"low": -4, "high": 4, "points": 3}, "v": {"values": [0]}},
        noise={"w": {"values": [0], "weights": [1]}},
        let={"used": "u**2", "idle": "u"},
        stage_cost="1 + used",
    )
    data["system"]["parameters"]["k"] = 1
    where = [f.where for f in lm.check(made(data)).findings if f.code == "unused"]
    assert where == ["system.parameters.k", "let.idle", "control_grid.v", "noise.w"]


def test_named_systems_and_functions_use_their_own_names():
    system = {"kind": "van_der_pol", "parameters": {"mu": 2}}
    problem = lm.load("examples/van_der_pol.json").replaced(system=system)
    assert not [f for f in lm.check(problem).findings if f.code == "unused"]

    def step(x, u, a):
        return {"x": x + a * u}

    own = lm.systems.FunctionSystem(next=step, parameters={"a": 0.5})
    for more in ({}, {"stage_cost": lambda x, u: 1 + 0 * x}):
        report = lm.check(lm.Problem(**{**shift(), "system": own, **more}))
        assert not report
        assert report.expected.coverage == 1


def test_a_slow_function_is_asked_a_few_times():
    calls = []

    def step(th, om, u):
        calls.append(1)
        return {"th": th + 0.1 * om, "om": om + 0.1 * (9.81 * math.sin(th) + u)}

    own = lm.systems.FunctionSystem(next=step, vectorized=False)
    data = pendulum(periodic=False)
    data["control_grid"]["u"]["points"] = 101
    report = lm.check(lm.Problem(**{**data, "system": own}))
    assert len(calls) < 100_000
    assert [finding.code for finding in report.findings] == ["not_periodic"]
    assert report.expected.coverage is None


# What it takes ---------------------------------------------------------------------------------


def test_what_is_expected():
    expected = lm.check(made(pendulum())).expected
    result = lm.solve(made(pendulum()))
    assert expected.cells == result.cells == 900
    assert expected.controls == 5
    assert expected.samples == 9
    assert expected.coverage == pytest.approx(result.coverage.share)
    assert 0.8 < expected.admissible <= 1
    assert 0 < expected.memory < expected.available
    assert expected.seconds >= 0


def test_nothing_can_be_stabilized():
    report = found(shift("0*u"))
    assert report["nothing_stabilizable"].figures["cells"] == 14
    assert lm.check(made(shift("0*u"))).expected.coverage == 0


@pytest.mark.parametrize("cells", [2_000, 40_000])
def test_large_problems_are_checked_on_fewer_cells(cells):
    data = pendulum()
    for axis in data["state_box"].values():
        axis["cells"] = cells
    data["control_grid"]["u"]["points"] = 201
    report = lm.check(made(data))
    assert report.expected.cells == cells**2
    assert report.expected.coverage is None or report.expected.coverage_cells["th"] < cells
    # Of so many cells not even the free ones are found: nothing is said of what was not tried.
    untried = cells == 40_000
    assert (report.expected.seconds is None) == (report.expected.admissible is None) == untried
    assert ("how long compiling so many cells takes is not known" in str(report)) == untried
    codes = [finding.code for finding in report.findings]
    assert ("memory" in codes) == (report.expected.memory > report.expected.available)


def test_a_problem_that_does_not_fit(monkeypatch):
    monkeypatch.setattr(sizes.memory, "available", lambda: sizes.memory.Memory(10**6, "a test"))
    problem = lm.load("examples/logistic_map.json")
    finding = next(f for f in lm.check(problem).findings if f.code == "memory")
    assert finding.figures["memory"] > finding.figures["available"] == 10**6


@pytest.mark.parametrize("cost", ["x", "log(x)", "1/x"])
def test_a_cost_that_cannot_be_is_bad_input(cost):
    with pytest.raises(lm.BadInput, match="stage_cost"):
        lm.check(made(shift(stage_cost=cost, low=-4, cells=15, controls=(0,))))


def test_a_finite_model_has_no_map_to_try():
    P = [[[1, 0], [0, 1]], [[0, 1], [0, 1]]]
    report = lm.check(lm.from_matrices(P, cost=[[1, 1], [0, 0]], targets=[1], layout="states"))
    assert not report
    assert report.expected.coverage == 1
    report = lm.check(lm.from_matrices(P[:1], cost=[[1], [0]], targets=[1], layout="states"))
    assert [finding.code for finding in report.findings] == ["nothing_stabilizable"]


def test_a_discounted_problem_needs_no_attractor_and_no_step():
    data = pendulum(0.01, discount=0.9)
    data["attractor"] = {}
    data["on_exit"] = "clip"
    report = lm.check(made(data))
    assert not report
    assert report.expected.coverage == 1


def test_what_is_no_problem_is_refused():
    with pytest.raises(lm.BadInput, match="a Problem"):
        lm.check({"problem": 1})


def test_boxes_of_an_attractor_across_the_seam():
    data = standard_map(20, attractor={"points": [{"x": 0, "y": 0.5}]})
    from lmdsl.explanation.remedies import attractor_boxes

    for grow in (0, 1, 3):
        boxes = attractor_boxes(made(data), grow)
        problem = made({**data, "attractor": {"boxes": boxes}})
        cells = (lm.compile(problem).cell_status == lm.CellStatus.ATTRACTOR).sum()
        assert cells == (2 + 2 * grow) ** 2


@pytest.mark.parametrize("block", range(4))
def test_random_problems_are_checked_as_they_are_solved(block):
    """Nothing breaks, and the coverage of a small problem is that of its solution."""
    for i in range(10):
        problem = made(random_problem(np.random.default_rng([80 + block, i])))
        report = lm.check(problem)
        assert report.expected.coverage_cells == report.axes
        assert report.expected.coverage == lm.solve(problem).coverage.share
        json.dumps(report.to_dict(), allow_nan=False)


def test_what_wraps_or_is_clipped_into_its_cell_is_no_short_step():
    for more in ({"on_exit": "clip"}, {}):
        data = shift("8*u", controls=(-1, 1), **more)
        data["state_box"]["x"]["periodic"] = not more
        assert "short_step" not in found(data)

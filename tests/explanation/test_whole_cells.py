"""Explanations where successors are enclosed: what drops a pair whose samples are all kept."""

import json

import matplotlib as mpl
import numpy as np
import pytest

import lmdsl as lm
import lmdsl.plotting
from lmdsl.cli import main
from lmdsl.problem.problem import parse_problem

mpl.use("Agg")


def bump(**more):
    """x+ = 2x/5 but where a bump between the samples throws runs far up."""
    return parse_problem({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "where(abs(x - 0.75) < 0.01, 3, 0.4*x) + u"}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 4}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0.0, 0.01]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2, "corners": False},
        "successors": "enclosed",
        **more,
    })  # fmt: skip


AVOID = {"avoid": {"boxes": [{"x": [0.75, 1.0]}]}, "on_exit": "clip"}


@pytest.mark.parametrize("more", [{}, AVOID, {"discount": 0.9}])
def test_the_causes_are_those_of_the_compiled_model(more):
    problem = bump(**more)
    lp = lm.compile(problem)
    found, again = lm.explain(problem), lm.explain(lp)
    assert (found.cell_status == lp.cell_status).all()
    assert found.to_dict() == again.to_dict()
    assert found.text() == again.text()


def test_a_pair_dropped_by_its_enclosure_says_so():
    found = lm.explain(bump())
    why = found.why({"x": 0.7})
    assert why.cause == "escapes"
    assert [move.kind for move in why.moves] == ["can leave", "can leave"]
    assert why.first == (
        "u = 0 loses no sample, but its enclosure leaves the box along x, or may be undefined there"
    )
    assert "enclosures" in found.text()
    (hint,) = [hint for hint in found.hints if hint.kind == "smaller cells"]
    assert hint.numbers["share_sampled"] == 1.0
    assert hint.numbers["share"] == pytest.approx(1 / 3)
    json.dumps(found.why({"x": 0.7}).to_dict())


def test_avoid_lost_cells_and_conditions():
    why = lm.explain(bump(**AVOID)).why({"x": 0.7})
    assert why.moves[0].kind == "can enter avoid"
    assert why.first == ("u = 0 loses no sample, but its enclosure meets x in [0, 1], and so avoid")
    shelf = {"kind": "map", "next": {"x": "where(abs(x - 0.5) < 0.01, 0.9, 0.5*x)"}}
    trap = {**shelf, "next": {"x": "where(x > 0.75, x, " + shelf["next"]["x"] + ")"}}
    why = lm.explain(bump(system=trap, control_grid={})).why({"x": 0.4})
    assert why.cause == "leads to these"
    assert why.moves[0].kind == "can enter"
    assert why.moves[0].cell == 3
    assert why.moves[0].cause == "trapped"
    assert "and so a cell that is lost (trapped)" in why.first
    halved = {"kind": "map", "next": {"x": "0.5*x"}}
    why = lm.explain(
        bump(system=halved, control_grid={}, admissible="abs(x - 0.75) > 0.01")
    ).why({"x": 0.7})  # fmt: skip
    assert why.moves[0].kind == "not admissible everywhere"
    assert "the condition is not shown to hold on the whole cell" in why.first


def test_a_trap_is_what_admissible_pairs_reach():
    """From cell 1 a pair enters A by its samples, but may leave the box by its enclosure."""
    system = {"kind": "map", "next": {"x": "where(u > 0, where(abs(x - 0.4) < 0.01, 9, 0.1), x)"}}
    found = lm.explain(bump(system=system, control_grid={"u": {"values": [0, 1]}}))
    why = found.why({"x": 0.3})
    assert why.cause == "trapped"
    assert why.trap_cells == 1


def test_the_phase_one_lp_is_of_samples():
    for given in (bump(), lm.compile(bump())):
        with pytest.raises(lm.BadInput, match="phase_one: successors are enclosed"):
            lm.explain(given, phase_one=True)
    assert lm.explain(bump(successors="sampled"), phase_one=True).phase_one is not None


def test_cells_beyond_gamma_are_not_left_out():
    problem = bump(gamma=1.1)
    with pytest.raises(lm.BadInput, match="restrict_to_gamma: successors are enclosed"):
        lm.solve(problem, restrict_to_gamma=True)
    with pytest.raises(lm.BadInput, match="restrict_to_gamma: successors are enclosed"):
        lm.solve(lm.compile(problem), restrict_to_gamma=True)


def test_a_refused_gamma_does_not_suggest_it():
    slow = {"kind": "map", "next": {"x": "where(x < 0.5, 0.1, where(w > 0, x, 0.1))"}}
    noise = {"w": {"values": [0.0, 0.2], "weights": [0.5, 0.5]}}
    told = {}
    for successors in ("sampled", "enclosed"):
        problem = bump(system=slow, noise=noise, control_grid={}, gamma=3.0, successors=successors)
        result = lm.solve(problem)
        assert result.status == "not_stabilizable"
        told[successors] = result.message
    assert "--restrict-to-gamma" in told["sampled"]
    assert "--restrict-to-gamma" not in told["enclosed"]


def test_reports_say_what_is_claimed(tmp_path, capsys):
    file = tmp_path / "problem.json"
    file.write_text(bump(attractor={"boxes": [{"x": [0, 0.5]}]}).to_json())
    assert main(["solve", str(file)]) == 3
    assert "as far as enclosures of whole cells show" in capsys.readouterr().out
    file.write_text(bump().to_json())
    assert main(["solve", str(file), "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    assert "no run of the map as compiled is lost (claim 7)" in told
    assert "some controller surely arrives from 1 cells" in told
    assert "the lower bound speaks of usable pairs" in told
    assert main(["verify", str(tmp_path / "out")]) == 0
    assert "safe of the map as compiled" in capsys.readouterr().out


@pytest.mark.parametrize("axes", [1, 2])
def test_a_line_runs_around_the_cells_that_surely_arrive(axes):
    more = {}
    if axes == 2:
        more = {
            "system": {"kind": "map", "next": {"x": "0.4*x", "y": "0.4*y"}},
            "state_box": {n: {"low": 0, "high": 1, "cells": 6} for n in "xy"},
            "attractor": {"cells": [[0, 0]]},
            "control_grid": {},
        }
    result = lm.solve(bump(**more))
    assert result.sure_cells
    legend = lm.plotting.cost(result).get_legend()
    assert "surely arrives" in [text.get_text() for text in legend.get_texts()]
    sampled = lm.solve(bump(successors="sampled", **more))
    legend = lm.plotting.cost(sampled).get_legend()
    assert "surely arrives" not in [text.get_text() for text in legend.get_texts()]
    assert np.isin(result.sure_levels, (-1, 0, 1, 2, 3)).all()


def test_what_holds_is_explained_as_it_is_compiled():
    """The attractor is what holds of it: by enclosures fewer cells than by samples."""
    declared = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "1.2*x + u"}},
        "state_box": {"x": {"low": -1, "high": 1, "cells": 14}},
        "attractor": {"boxes": [{"x": [-0.4, 0.4]}]},
        "control_grid": {"u": {"low": -0.3, "high": 0.3, "points": 2}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        "local_controller": {"kind": "hold"},
    }
    kept = []
    for more in ({}, {"successors": "enclosed"}):
        problem = parse_problem({**declared, **more})
        lp = lm.compile(problem)
        kept.append(int((lp.cell_status == 0).sum()))
        assert np.array_equal(lm.explain(problem).cell_status, lp.cell_status)
    assert kept == [4, 0]

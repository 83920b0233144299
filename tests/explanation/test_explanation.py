"""Explanations of infeasibility: causes, boxes, facts, phase one and hints, with known answers."""

from __future__ import annotations

import json

import matplotlib as mpl
import numpy as np
import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.errors import LmdslError
from lmdsl.explanation.causes import phase_one
from lmdsl.model.grid import boxes
from lmdsl.model.grid.partition import Partition

mpl.use("Agg")


def three_causes(**more):
    """Cells 0 to 5: escapes, trapped, leads to these, two stabilized, A (see test_causes)."""
    jump = "where(x < 1, -5, where(x < 2, x, where(x < 3, where(x < 2.5, 1.5, 5.5), x + u)))"
    data = steps(1.0, **more)
    data["system"]["next"] = {"x": jump}
    data["state_box"] = {"x": {"low": 0, "high": 6, "cells": 6}}
    data["attractor"] = {"cells": [[5]]}
    return data


def line(formula, low=0.0, high=1.0, cells=10, controls=(-1, 0, 1), at=0.05, **more):
    """One axis, A at a point."""
    return made(
        {
            "format": "lmdsl/1",
            "system": {"kind": "map", "next": {"x": formula}},
            "state_box": {"x": {"low": low, "high": high, "cells": cells}},
            "attractor": {"points": [[at]]},
            "control_grid": {"u": {"values": list(controls)}},
            "stage_cost": "1",
            "sampling": {"kind": "grid", "per_axis": 4},
            **more,
        }
    )


def kinds(explanation):
    return {hint.kind for hint in explanation.hints}


# Causes and facts -----------------------------------------------------------------------------


def test_causes_by_region():
    found = lm.explain(made(three_causes()))
    assert [(c.name, c.cells, c.elsewhere) for c in found.causes] == [
        ("escapes", 1, 0), ("trapped", 1, 0), ("leads to these", 1, 0)
    ]  # fmt: skip
    assert [c.regions[0].box for c in found.causes] == [
        {"x": (0.0, 1.0)}, {"x": (1.0, 2.0)}, {"x": (2.0, 3.0)}
    ]  # fmt: skip
    assert found.lost == 3


def test_the_same_from_the_compiled_lp():
    problem = made(three_causes())
    a, b = lm.explain(problem), lm.explain(lm.compile(problem))
    assert a.to_dict() == b.to_dict()
    assert a.text() == b.text()


def test_why_a_cell_escapes():
    why = lm.explain(made(three_causes())).why(0)
    assert why.cause == "escapes"
    assert why.controls == 2
    assert [m.control for m in why.moves] == [{"u": 0.0}, {"u": 1.0}]
    move = why.moves[0]
    assert (move.kind, move.state, move.image) == ("leaves", {"x": 0.25}, {"x": -5.0})
    assert move.sides == (("x", "low", 5.0),)
    assert move.share == 1
    assert "below the x axis by 5" in why.first


def test_why_a_cell_is_trapped():
    why = lm.explain(made(three_causes())).why({"x": 1.5})
    assert (why.cell, why.cause, why.trap_cells, why.trap_lost) == (1, "trapped", 1, 0)
    assert [r.box for r in why.trap] == [{"x": (1.0, 2.0)}]
    assert "never the attractor" in why.first


def test_a_trap_that_ends_in_an_escape():
    # x+ = x - 0.25 on 4 cells with A on top: 3, 2, 1 go down, and 0 leaves.
    data = steps(1.0)
    data["system"]["next"] = {"x": "x - 0.25"}
    data["attractor"] = {"cells": [[3]]}
    found = lm.explain(made(data))
    assert [(c.name, c.cells) for c in found.causes] == [("escapes", 1), ("trapped", 2)]
    why = found.why(2)
    assert (why.trap_cells, why.trap_lost) == (3, 1)
    assert [r.box for r in why.trap] == [{"x": (0.0, 0.75)}]


def test_why_a_cell_leads_to_these():
    why = lm.explain(made(three_causes())).why(2)
    move = why.moves[0]
    assert (move.kind, move.cell, move.cause, move.share) == ("enters", 1, "trapped", 0.5)
    assert "lost (trapped)" in why.text()


@pytest.mark.parametrize(
    ("formula", "more", "kind"),
    [
        ("x/0", {}, "not finite"),
        ("0.95 + 0*u", {"avoid": {"boxes": [{"x": [0.9, 1.0]}]}}, "avoid"),
        ("x + 10", {}, "leaves"),
    ],
)
def test_kinds_of_leaving(formula, more, kind):
    why = lm.explain(line(formula, **more)).why(5)
    assert {m.kind for m in why.moves} == {kind}
    json.dumps(why.to_dict(), allow_nan=False)


def test_why_where_nothing_is_wrong():
    found = lm.explain(made(steps(1.0)))
    assert (found.lost, found.causes, found.hints) == (0, (), ())
    assert found.why(1).first == "it is stabilizable"
    assert found.why(0).cause == "attractor"
    assert found.text().startswith("0 of 3")
    for cell in (-1, 4, 1.5, {"y": 0}, {"x": 7.0}):
        with pytest.raises(lm.BadInput):
            found.why(cell)
    with pytest.raises(lm.BadInput):
        lm.explain(made(steps(1.0)), regions=0)


def test_noise_is_named():
    data = steps(1.0, noise={"w": {"values": [0, 9], "weights": [0.75, 0.25]}})
    data["system"]["next"] = {"x": "x - 0.25*u + w"}
    move = lm.explain(made(data)).why(1).moves[0]
    assert move.noise == {"w": 9.0}
    assert move.share == pytest.approx(0.25)


def test_many_controls_are_thinned():
    why = lm.explain(line("x + 10 + u", controls=range(1000))).why(5)
    assert (len(why.moves), why.controls) == (32, 1000)
    assert [why.moves[k].control["u"] for k in (0, -1)] == [0, 999]
    assert "968 more controls" in why.text()


# Boxes ----------------------------------------------------------------------------------------


def grid(shape, periodic=()):
    names = "xyz"[: len(shape)]
    data = standard_map(2)
    data["system"]["next"] = {n: n for n in names}
    data["system"].pop("parameters")
    data["state_box"] = {
        n: {"low": 0, "high": k, "cells": k, "periodic": n in periodic}
        for n, k in zip(names, shape, strict=True)
    }
    data.update(attractor={"cells": [[0] * len(shape)]}, stage_cost="1", control_grid={})
    return Partition.of(made({**data, "system": {"kind": "map", "next": data["system"]["next"]}}))


def covered(partition, region):
    """The cells of a box, found by their centres."""
    centres = partition.centres(np.arange(partition.size))
    inside = np.ones(partition.size, dtype=bool)
    for k, name in enumerate(partition.names):
        low, high = region.box[name]
        turn = partition.high[k] - partition.low[k]
        x = centres[:, k]
        wrapped = partition.periodic[k] & (low <= x + turn) & (x + turn <= high)
        inside &= ((low <= x) & (x <= high)) | wrapped
    return inside


@pytest.mark.parametrize("shape", [(40,), (12, 9), (6, 5, 7)])
@pytest.mark.parametrize("periodic", ["", "x", "xyz"])
@pytest.mark.parametrize("seed", range(4))
def test_boxes_are_disjoint_and_cover(shape, periodic, seed):
    partition = grid(shape, periodic)
    mask = np.random.default_rng(seed).random(partition.size) < 0.7
    found = boxes.regions(partition, mask, 10_000)
    count = sum(covered(partition, r).astype(int) for r in found)
    assert (count == mask).all()
    assert [r.cells for r in found] == sorted((r.cells for r in found), reverse=True)
    assert all(covered(partition, r).sum() == r.cells for r in found)
    assert all(covered(partition, r)[r.cell] for r in found)
    few = boxes.regions(partition, mask, 3)
    assert len(few) == 3


def test_a_rectangle_is_one_box():
    partition = grid((20, 30))
    mask = np.zeros((20, 30), dtype=bool)
    mask[3:8, 10:25] = mask[15, 2] = True
    a, b = boxes.regions(partition, mask.ravel(), 5)
    assert (a.box, a.cells) == ({"x": (3, 8), "y": (10, 25)}, 75)
    assert (b.box, b.cells) == ({"x": (15, 16), "y": (2, 3)}, 1)


def test_a_box_goes_across_a_seam():
    mask = np.zeros((10, 4), dtype=bool)
    mask[[8, 9, 0, 1]] = True
    (one,) = boxes.regions(grid((10, 4), "xy"), mask.ravel(), 5)
    assert one.box == {"x": (8.0, 12.0), "y": (0.0, 4.0)}
    assert len(boxes.regions(grid((10, 4)), mask.ravel(), 5)) == 2


# Phase one ------------------------------------------------------------------------------------


def test_phase_one_by_hand():
    # Cells 0 to 4 hold 1/5 each: 0 and 1 are lost, half of 2 goes to A, half to 1.
    found = phase_one(made(three_causes()))
    np.testing.assert_allclose(found.lost, np.array([1, 1, 0.5, 0, 0]) / 5, atol=1e-12)
    np.testing.assert_allclose(found.residual, np.array([1, 1.5, 0, 0, 0]) / 5, atol=1e-12)
    assert found.total == pytest.approx(2.5 / 5)
    by = found.by_cause()
    assert by["leads to these"]["lost"] == pytest.approx(0.1)
    assert by["trapped"]["residual"] == pytest.approx(0.3)
    assert found.largest().tolist() == [0, 1, 2]


@pytest.mark.parametrize("gamma", [0.5, 1.0])
def test_phase_one_takes_traps_for_lost_at_any_discount(gamma):
    assert phase_one(made({**three_causes(), "gamma": gamma})).total == pytest.approx(0.5)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.9])
def test_phase_one_of_a_feasible_problem_is_zero(gamma):
    found = phase_one(made(doubling(gamma)))
    assert found.total == pytest.approx(0, abs=1e-12)
    assert not found.lost.any()


def test_phase_one_beyond_gamma_bar():
    # Half of the one free cell returns: at gamma = 3 its theta removes 1 and brings 1.5.
    found = phase_one(made(doubling(3.0)))
    assert found.total == pytest.approx(1)
    assert found.lost.tolist() == pytest.approx([1])


def test_phase_one_weighs_the_support_only():
    found = phase_one(made(three_causes(measure={"boxes": [{"x": [2, 4]}]})))
    assert found.weight.tolist() == [0, 0, 0.5, 0.5, 0]
    np.testing.assert_allclose(found.lost, [0, 0, 0.25, 0, 0], atol=1e-12)
    assert found.total == pytest.approx(0.25)


def test_phase_one_is_greatest_probability_of_reaching():
    # Under u = 0 a third cell in four stays lost; the LP must choose u = 1, which loses one half.
    data = three_causes()
    data["system"]["next"] = {
        "x": "where(x < 2, x, where(x < 3, where(x < 2.75 - 0.25*u, 1.5, 5.5), x + u))"
    }
    data["sampling"]["per_axis"] = 4
    assert phase_one(made(data)).lost[2] == pytest.approx(0.5 / 5)


def test_phase_one_agrees_with_value_iteration():
    problem = lm.load("examples/double_integrator.json")
    axes = {"x": {"low": -2, "high": 2, "cells": 20}, "v": {"low": -1.5, "high": 1.5, "cells": 15}}
    system = {"kind": "double_integrator", "parameters": {"h": 0.4}}
    explanation = lm.explain(problem.replaced(state_box=axes, system=system), phase_one=True)
    found, t = explanation.phase_one, explanation.transitions
    P = t.rows.matrix()
    y = np.ones(t.rows.columns)
    for _ in range(3_000):
        best = np.ones_like(y)
        np.minimum.at(best, np.repeat(np.arange(len(y)), np.diff(t.pair_pointer)), P @ y)
        y = best
    np.testing.assert_allclose(found.lost / found.weight, y, atol=5e-5)
    assert found.total == pytest.approx((found.weight * y).sum(), rel=5e-5)
    assert found.lost.sum() == pytest.approx(found.total, rel=5e-5)
    # Exactly the cells outside C lose mass.
    assert found.cause.min() == lm.CellStatus.STABILIZED
    assert ((found.lost > 0) == (found.cause != lm.CellStatus.STABILIZED)).all()


def test_phase_one_says_when_it_is_not_solved():
    with pytest.raises(LmdslError, match="phase-one"):
        phase_one(lm.load("examples/standard_map.json"), time_limit=1e-9)


# Hints ----------------------------------------------------------------------------------------


def test_a_larger_box_helps_what_overshoots_and_returns():
    # Velocity v must first be braked: x runs over the upper side, then comes back.
    found = lm.explain(lm.load("examples/double_integrator.json"))
    sides = {h.numbers["end"]: h.numbers for h in found.hints if h.kind == "larger box"}
    assert set(sides) == {"low", "high"}
    # Braking from v = 1.5 at -1 takes 1.5^2/2 = 1.125; the quantile of those near must be below.
    assert 2 < sides["high"]["extend_to"] < 2 + 1.125
    assert sides["low"]["extend_to"] == pytest.approx(-sides["high"]["extend_to"], rel=0.05)


def test_no_larger_box_for_what_never_returns():
    # x+ = 1.5 x + 0.1 u: beyond 0.2 nothing returns, however near the side.
    found = lm.explain(line("1.5*x + 0.1*u", -1, 1, 40, at=0.0))
    assert found.lost > 10
    assert "larger box" not in kinds(found)


def test_no_larger_box_where_the_overshoot_is_large():
    # One visit far outside (70 % of the axis) and back to A: not a matter of a slightly larger box.
    near = lm.explain(line("where(x > 1, 0.05, where(x > 0.5, 1.1, x - 0.1))"))
    far = lm.explain(line("where(x > 1, 0.05, where(x > 0.5, 1.7, x - 0.1))"))
    assert "larger box" in kinds(near)
    assert near.hints[0].numbers["overshoot"] == pytest.approx(0.1)
    assert "larger box" not in kinds(far)


def test_more_controls_where_the_overshoot_falls_to_the_end():
    # x+ = x + 0.4 + 0.2 u, u in -1, -0.5, 0: leaves above x = 0.8; u = -2 would hold it.
    found = lm.explain(line("x + 0.4 + 0.2*u", controls=(-1, -0.5, 0)))
    (hint,) = [h for h in found.hints if h.kind == "more controls"]
    assert (hint.numbers["control"], hint.numbers["end"]) == ("u", "low")
    # The cell up to x = 1 needs 0.2 |u| >= 0.4 - 1/80, and 1.875 is not tried; 2 is the next.
    assert hint.numbers["extend_to"] == -2
    assert hint.numbers["cells"] == hint.numbers["tried"] == 2


@pytest.mark.parametrize(
    ("formula", "controls"),
    [
        ("x + 0.4 + 0.2*u", (-1, 0)),  # two values are no trend
        ("x + 0.4 + 0.2*u**2", (-1, 0, 1)),  # least in the middle
        ("x + 0.4 + 0*u", (-1, 0, 1)),  # no effect
        ("x + 9 + 0.2*u", (-1, 0, 1)),  # falls, but much too slowly
        ("x + 0.4 - 0.2/(1 + exp(-u))", (0, 5, 10)),  # falls, and saturates
    ],
)
def test_no_more_controls_without_a_trend_that_suffices(formula, controls):
    found = lm.explain(line(formula, controls=controls))
    assert any(c.name == "escapes" for c in found.causes)
    assert "more controls" not in kinds(found)


def test_a_finer_grid_where_samples_stay_although_the_map_moves():
    # Steps of 0.02 in cells of 0.1: no sample leaves its cell, so all are trapped.
    two = {"kind": "grid", "per_axis": 2}
    found = lm.explain(line("x + 0.02*u", sampling=two))
    assert [(c.name, c.cells) for c in found.causes] == [("trapped", 9)]
    (hint,) = [h for h in found.hints if h.kind == "finer grid"]
    assert hint.numbers["trapped"] == hint.numbers["cells"] == 9
    assert hint.numbers["own_cell_share"] == 1
    finer = lm.explain(line("x + 0.02*u", cells=100, sampling=two))
    assert finer.lost == 0


def test_no_finer_grid_where_the_map_itself_stays():
    found = lm.explain(line("x + 0*u"))
    assert [c.name for c in found.causes] == ["trapped"]
    assert found.hints == ()
    assert "nothing that was tried" in found.text()


def test_hints_are_bounded_for_many_controls_and_samples():
    problem = line("x + 0.4 + 1e-4*u", controls=range(-500, 500))
    found = lm.explain(problem.replaced(sampling={"kind": "random", "points": 500}))
    assert found.lost > 0


@pytest.mark.parametrize("name", ["henon_map", "van_der_pol", "inverted_pendulum"])
def test_examples_are_explained(name):
    found = lm.explain(lm.load(f"examples/{name}.json"))
    status = lm.compile(found.problem).cell_status
    for cause in found.causes:
        code = lm.CellStatus[cause.name.upper().replace(" ", "_")]
        assert cause.cells == (status == code).sum()
        for region in cause.regions:
            assert (status[covered(found.partition, region)] == code).all()
    json.dumps(found.to_dict(), allow_nan=False)


# Outputs --------------------------------------------------------------------------------------


def test_command(tmp_path, capsys):
    path = tmp_path / "p.json"
    made(three_causes()).save(path)
    assert main(["explain", str(path)]) == 0
    text = capsys.readouterr().out
    assert "escapes, 1 cells" in text
    assert "phase one" not in text
    assert main(["explain", str(path), "--phase-one", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["causes"]["trapped"]["regions"][0]["box"] == {"x": [1.0, 2.0]}
    assert data["phase_one"]["total"] == pytest.approx(0.5)
    assert main(["explain", str(tmp_path / "none.json")]) == 2


@pytest.mark.parametrize("axes", [None, ["x"], ["v", "x"]])
def test_plot(axes):
    found = lm.explain(lm.load("examples/double_integrator.json"), regions=3)
    ax = lm.plotting.causes(found, axes=axes)
    names = {patch.get_label() for patch in ax.patches}
    ax.figure.canvas.draw()
    if axes != ["x"]:
        assert {"escapes", "trapped", "leads to these", "stabilizable"} <= names
        outlines = [p for p in ax.patches if not p.get_fill()]
        assert len(outlines) == 9


def test_plot_splits_a_box_at_the_seam():
    # The map leaves everything where it is; A is in the middle of the circle.
    data = doubling(1.0)
    data["system"]["next"] = {"x": "x"}
    data["state_box"]["x"]["cells"] = 5
    data["attractor"] = {"cells": [[2]]}
    found = lm.explain(made(data))
    (region,) = found.causes[0].regions
    assert region.box == {"x": (pytest.approx(0.6), pytest.approx(1.4))}
    ax = lm.plotting.causes(found)
    spans = sorted((p.get_x(), p.get_width()) for p in ax.patches if hasattr(p, "get_width"))
    np.testing.assert_allclose(spans, [(0, 0.4), (0.6, 0.4)])

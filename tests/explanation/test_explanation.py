"""Why cells cannot be stabilized: causes, facts and boxes, with known answers."""

from __future__ import annotations

import json

import matplotlib as mpl
import numpy as np
import pytest
from infeasible import covered, line, three_causes
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.model.grid import boxes
from lmdsl.model.grid.partition import Partition

mpl.use("Agg")


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

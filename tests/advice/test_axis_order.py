"""The note on large problems whose axes stand in an order that is slow over ranks."""

from pathlib import Path

import pytest

import lmdsl as lm
from benchmarks.halos import counted
from lmdsl.advice import declaration
from lmdsl.advice.survey import Survey
from lmdsl.model.grid.partition import Partition
from lmdsl.slabs.compiling import local
from lmdsl.slabs.graph import cuts

EXAMPLES = Path(__file__).parents[2] / "examples"


def reordered(problem, factor=1):
    """The same with the last axis first, and more cells."""
    box = {x: {**a.model_dump(), "cells": factor * a.cells} for x, a in problem.state_box.items()}
    return problem.replaced(state_box=dict(reversed(box.items())))


def noted(problem):
    survey = Survey(problem, Partition.of(problem))
    return [*declaration.axis_order(survey)]


def double_integrator():
    return lm.load(EXAMPLES / "double_integrator.json")


def large(monkeypatch, least=1):
    monkeypatch.setattr(cuts, "LARGE", least)


def test_the_slow_axis_is_to_be_declared_first(monkeypatch):
    """In words and in figures; of problems that are small or in order nothing is said."""
    problem = reordered(double_integrator(), 2)
    assert noted(problem) == []
    large(monkeypatch, 4 * 4800)
    (note,) = [each for each in lm.check(problem).notes if each.code == "axis_order"]
    exact = counted(local(lm.compile(problem)), declaration.RANKS)
    assert [*note.figures["by_axis"]] == ["v", "x"]
    for axis, x in exact.items():
        assert note.figures["by_axis"][axis] == pytest.approx(x, rel=0.25)
    assert note.remedy == f"declare x first in state_box: then about {note.figures['then']:.2g}"
    assert note.figures["now"] == note.figures["by_axis"]["v"] > 2 * note.figures["then"]
    assert f"about {note.figures['now']:.2g} cells of others" in note.text
    assert noted(reordered(problem)) == noted(double_integrator()) == []


def shift(next_, by=3, cells=(600, 500)):
    """x+ = x + by cells, y+ = y, until the last columns, which are the attractor."""
    return lm.Problem(
        system=next_,
        state_box={
            name: {"low": 0, "high": n, "cells": n} for name, n in zip("xy", cells, strict=True)
        },
        attractor={"boxes": [{"x": [cells[0] - by, cells[0]]}]},
        control_grid={}, stage_cost="1", sampling={"kind": "grid", "per_axis": 1},
    )  # fmt: skip


def moved(x, y):
    return {"x": x + 60, "y": y}


SYSTEMS = {
    "formulas": lm.systems.MapSystem(next={"x": "x + 60", "y": "y"}),
    "function": lm.systems.FunctionSystem(next=moved),
    "sample by sample": lm.systems.FunctionSystem(next=moved, vectorized=False),
}


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("system", SYSTEMS)
def test_a_shift_along_one_axis(monkeypatch, system, known):
    """Three cuts of 60 planes, of 540 whose cells have a pair that stays in the box."""
    if not known:
        monkeypatch.setattr("lmdsl.advice.survey.MOST_SETS", 0)
    (note,) = noted(shift(SYSTEMS[system], 60))
    assert note.figures["by_axis"] == {"x": pytest.approx(3 * 60 / 540, rel=0.1), "y": 0}


def test_pairs_that_are_lost_lead_nowhere(monkeypatch):
    """Of those that leave, end in a cell to avoid, or are not admitted, nothing is told."""
    large(monkeypatch)
    far = {"control_grid": {"u": {"values": [0, 1]}},
           "system": {"kind": "map", "next": {"x": "x + 1 + 16*u", "y": "y"}}}  # fmt: skip
    free = shift(SYSTEMS["formulas"], 1, (40, 30)).replaced(**far)
    # Slabs of 10 planes: 10, 10, 2 or 3 that are 17 further, and one at each cut.
    assert noted(free)[0].figures["now"] == pytest.approx(25 / 39, rel=0.1)
    for key, value in (("admissible", "u < 0.5"), ("avoid", {"boxes": [{"x": [17, 38]}]})):
        (note,) = noted(free.replaced(**{key: value}))
        assert note.figures["now"] == pytest.approx(
            3 / (39 if key == "admissible" else 17), rel=0.15
        )


@pytest.mark.parametrize("problem", [
    lm.from_matrices([[[0.5, 0.5], [0, 1]]], [[1.0], [0.0]], targets=[1]),
    lm.load(EXAMPLES / "logistic_map.json"),
])  # fmt: skip
def test_nothing_is_said_where_there_is_no_axis_to_choose(monkeypatch, problem):
    large(monkeypatch)
    assert "axis_order" not in {note.code for note in lm.check(problem).notes}

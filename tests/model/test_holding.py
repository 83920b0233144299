"""Attractor cells that hold: the set, its controls, and that runs stay for ever.

The set is compared with plain definitions over sets of cells (of samples by the independent
reference, of enclosures by what single pairs can meet), and with runs whose noise does its worst.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from random_problems import random_problem
from reference import compile_reference

import lmdsl as lm
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.holding import held
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.inclusion import Inclusion
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import parse_problem
from lmdsl.results.directory import archive
from lmdsl.systems import FunctionSystem

HOLD, PARTIAL = {"kind": "hold"}, {"kind": "hold", "partial": True}


def line(text, cells=10, attractor=(0.0, 0.5), **more):
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": cells}},
        "attractor": {"boxes": [{"x": list(attractor)}]},
        "control_grid": {"u": {"values": [-1, 0, 1]}},
        "stage_cost": "u**2 + 0.25*u",
        "sampling": {"kind": "grid", "per_axis": 3, "corners": True},
        "local_controller": HOLD,
        **more,
    }


def cart(cells=24, half=0.5, **more):
    """A cart whose speed is controlled; A is a square about rest."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x + 0.3*y", "y": "0.9*y + 0.3*u"}},
        "state_box": {
            "x": {"low": -1, "high": 1, "cells": cells},
            "y": {"low": -1, "high": 1, "cells": cells},
        },
        "attractor": {"boxes": [{"x": [-half, half], "y": [-half, half]}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
        "stage_cost": "x**2 + y**2 + u**2",
        "sampling": {"kind": "grid", "per_axis": 3},
        "successors": "enclosed",
        "local_controller": HOLD,
        **more,
    }


# by hand --------------------------------------------------------------------------------------


def test_a_cell_holds_by_the_cheapest_control_that_keeps_it():
    # x + u/10 moves by a whole cell: 0 keeps every cell, and costs least but for -1 (0.75, 1.25)
    lp = lm.compile(parse_problem(line("x + 0.1*u", stage_cost="(u - 1)**2", on_exit="clip",
                                       sampling={"kind": "grid", "per_axis": 1})))  # fmt: skip
    assert lp.hold.tolist() == [2, 2, 2, 2, 1, -1, -1, -1, -1, -1]


def test_cells_that_do_not_hold_become_ordinary_ones():
    declared = line(
        "x + 0.3*where(x > 0.3, 1, 0)", attractor=(0.2, 0.5), on_exit="clip",
        control_grid={"u": {"values": [0]}}, sampling={"kind": "grid", "per_axis": 1},
    )  # fmt: skip
    for local, whole in ((HOLD, False), (PARTIAL, True)):
        lp = lm.compile(parse_problem({**declared, "local_controller": local}))
        assert np.flatnonzero(lp.hold >= 0).tolist() == [2]
        assert np.flatnonzero(lp.cell_status == 0).tolist() == ([2, 3, 4] if whole else [2])


def test_no_cell_that_holds_is_a_refusal_that_says_why(tmp_path):
    wild = line("x + 0.6*where(x < 0.5, 1, -1)")
    result = lm.solve(parse_problem(wild))
    assert (result.status, result.cause) == ("not_stabilizable", "hold")
    assert "no control of the grid holds" in result.message
    assert (result.control_index == -1).all()
    result.save(tmp_path / "wild")
    assert lm.verify(tmp_path / "wild").holds

    coarse = lm.solve(parse_problem(cart(half=0.2)))
    assert coarse.cause == "hold"
    assert "too coarse" in coarse.message


def test_where_the_middles_cannot_be_looked_at_the_refusal_stands():
    # The cost is negative at the middles only, which no declared sample is.
    problem = line("x + 0.6*where(x < 0.5, 1, -1)", sampling={"kind": "random", "points": 1})
    problem["stage_cost"] = "where(abs(mod(10*x, 1) - 0.5) < 1e-6, -1, 1)"
    result = lm.solve(parse_problem({**problem, "on_exit": "clip"}))
    assert result.cause == "hold"
    assert "no attractor cell holds" in result.message


@pytest.mark.parametrize("key", ["control", "orbit"])
def test_bad_input(key):
    with pytest.raises(BadInput, match=rf"local_controller.{key}"):
        parse_problem(line("x", local_controller={"kind": "hold", key: {}}))
    with pytest.raises(BadInput, match=r"local_controller.partial"):
        parse_problem(line("x", local_controller={"kind": "hold", "partial": 1}))


# against plain definitions --------------------------------------------------------------------


def as_arrays(model):
    index = np.full(model.N, -1)
    index[list(model.hold)] = list(model.hold.values())
    return index


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("local", [HOLD, PARTIAL], ids=["whole", "partial"])
def test_the_model_is_that_of_the_reference(seed, local):
    rng = np.random.default_rng(seed)
    problem = {**random_problem(rng), "local_controller": local}
    model = compile_reference(problem)
    some = [c for c in range(model.N) if c not in model.avoid and rng.random() < 0.5]
    if not some:
        return
    axes = [len(range(a["cells"])) for a in problem["state_box"].values()]
    cells = [[int(i) for i in np.unravel_index(c, axes)] for c in some]
    problem["attractor"] = {"cells": cells}
    model, lp = compile_reference(problem), lm.compile(parse_problem(problem))
    assert lp.hold.tolist() == as_arrays(model).tolist()
    assert lp.cell_status.tolist() == model.cell_status


def by_single_pairs(problem, partition, sets):
    """The greatest set by its definition: each pair is judged anew against the set so far."""
    inside = sets.attractor.copy()
    way = CellSets.made(np.zeros_like(inside), sets.avoid, sets.mass)
    M = len(lm.compile(problem.replaced(local_controller=None)).controls)
    while True:
        judge, now = Inclusion(problem, partition, way, inside), inside.copy()
        for cell in np.flatnonzero(inside):
            one = np.array([cell])
            now[cell] = any(judge(one, np.array([k])).all() for k in range(M))
        if (now == inside).all():
            return inside
        inside = now


@pytest.mark.parametrize("cells", [8, 14])
def test_enclosed_cells_hold_by_definition(cells):
    problem = parse_problem(cart(cells))
    partition = Partition.of(problem)
    sets = CellSets.of(problem, partition)
    index = held(problem, partition, sets)
    plain = by_single_pairs(problem, partition, sets)
    assert ((index >= 0) <= plain).all()  # which cuts cells further: it may prove more
    assert (index >= 0).sum() >= 0.9 * plain.sum()


# runs -----------------------------------------------------------------------------------------

NOISY = cart(30, noise={"w": {"uniform": {"low": -0.02, "high": 0.02, "points": 2}}})
NOISY["system"] = {"kind": "map", "next": {"x": "x + 0.3*y + w", "y": "0.9*y + 0.3*u - w"}}
SWING = cart(24, half=0.6)
SWING["system"] = {
    "kind": "ode", "derivative": {"x": "y", "y": "sin(x) + 3*u - 0.2*y"}, "step": 0.15,
    "substeps": 2,
}  # fmt: skip


@pytest.mark.parametrize("problem", [cart(), NOISY, SWING], ids=["cart", "noisy", "swing"])
@pytest.mark.parametrize("local", [HOLD, PARTIAL], ids=["whole", "partial"])
def test_no_run_ever_leaves_the_cells_that_hold(problem, local):
    problem = parse_problem({**problem, "local_controller": local})
    result = lm.solve(problem)
    assert result.verified
    partition, index = result.partition, result.control_index
    holding = (result.cell_status == CellStatus.ATTRACTOR) & (index >= 0)
    assert holding.any()
    report = result.local_controller
    assert (report.holding, report.proved) == (holding.sum(), holding.sum())
    assert report.kept == report.samples > 0
    rng, true_map = np.random.default_rng(3), TrueMap(problem, partition)
    cell = np.repeat(np.flatnonzero(holding), 20)
    place = np.stack(partition.multi_index(cell), axis=-1)
    x = partition.low + (place + rng.choice([0, 1, 0.5, 1e-12], place.shape)) * partition.width
    x, cell = partition.enter(x)
    x, cell = x[holding[cell]], cell[holding[cell]]
    ends = [(v.uniform.low, v.uniform.high) for v in (problem.noise or {}).values()]
    for _ in range(200):
        u = result.control_vectors[index[cell]]
        noise = [rng.choice(end, size=len(x)) for end in ends]
        values = true_map.named(list(x.T), list(u.T), noise)
        x, cell = true_map.step(values, Deadline())
        assert holding[cell].all()


@pytest.mark.parametrize("local", [HOLD, PARTIAL], ids=["whole", "partial"])
def test_simulations_hold(local):
    result = lm.solve(parse_problem({**SWING, "local_controller": local}))
    runs = result.simulate(300, 400, hold=100, as_compiled=True)
    assert (runs.reached, runs.lost) == (300, 0)
    assert runs.held.stayed > 0
    assert runs.held.returned == runs.held.away == runs.held.lost == 0
    if local is HOLD:
        assert runs.held.stayed == 300
        assert result.prove(0.5, time_limit=4).holds


def test_only_the_end_of_a_step_enters_the_attractor():
    # A is crossed within a step of 1, and the next control would have to be chosen there
    crossing = {"kind": "ode", "derivative": {"x": "1.0 + 0*u"}, "step": 0.3, "substeps": 1}
    problem = line(
        "x", attractor=(0.4, 0.5), control_grid={"u": {"values": [0]}}, stage_cost="1",
        on_exit="clip", local_controller={"kind": "constant"},
    )  # fmt: skip
    problem["system"] = crossing
    on_way = lm.compile(parse_problem(problem))
    assert on_way.cell_status[2] == CellStatus.STABILIZED
    problem["local_controller"] = HOLD
    problem["attractor"] = {"cells": [[4], [9]]}  # the last is held, clipped
    lp = lm.compile(parse_problem(problem))
    assert np.flatnonzero(lp.hold >= 0).tolist() == [9]
    partial = lm.compile(parse_problem({**problem, "local_controller": PARTIAL}))
    at = partial.column(2, 0)
    assert partial.rows.matrix()[[at]].sum() == 1  # not in A at the end: passes over cell 4


# directories ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    places = {}
    for name, more in (("enclosed", {}), ("sampled", {"successors": "sampled"}),
                       ("partial", {"local_controller": PARTIAL})):  # fmt: skip
        places[name] = tmp_path_factory.mktemp(name) / "result"
        lm.solve(parse_problem(cart(**more))).save(places[name])
    return places


def spoiled(place, target, **arrays):
    result = archive.load(place)

    data = {name: np.array(array) for name, array in arrays.items()}
    lp = lm.compile(result.problem)
    replace(result, **data, lp=lp).save(target)
    return lm.verify(target)


@pytest.mark.parametrize("name", ["enclosed", "sampled", "partial"])
def test_saved_results_verify_and_hold(saved, name):
    assert lm.verify(saved[name]).holds
    result = archive.load(saved[name])
    cells = np.flatnonzero((result.cell_status == 0) & (result.control_index >= 0))
    assert len(cells) == result.local_controller.holding
    centre = result.partition.centres(cells[:3])
    expected = result.control_vectors[result.control_index[cells[:3]]]
    assert result.controller(centre).tolist() == expected.tolist()


@pytest.mark.parametrize("name", ["enclosed", "sampled", "partial"])
def test_spoiled_controls_and_cells_are_refused(saved, name, tmp_path):
    result = archive.load(saved[name])
    cell = int(np.flatnonzero((result.cell_status == 0) & (result.control_index >= 0))[0])
    for number, wrong in enumerate((-1, 0, 8)):
        index = np.array(result.control_index)
        index[cell] = wrong if wrong != index[cell] else 4
        found = spoiled(saved[name], tmp_path / f"{number}", control_index=index)
        assert not found.holds
        assert any("control_index" in reason for reason in found.reasons)
    status = np.array(result.cell_status)
    other = int(np.flatnonzero(status == CellStatus.STABILIZED)[0])
    for number, (at, code) in enumerate(((cell, 1), (other, 0))):
        wrong = status.copy()
        wrong[at] = code
        found = spoiled(saved[name], tmp_path / f"status{number}", cell_status=wrong)
        assert not found.holds


def test_a_report_of_more_cells_than_hold_is_refused(saved, tmp_path):

    result = archive.load(saved["partial"])
    for number, change in enumerate(({"holding": 140}, {"proved": 144}, {"cells": 118})):
        report = replace(result.local_controller, **change)
        lp = lm.compile(result.problem)
        replace(result, local_controller=report, lp=lp).save(tmp_path / f"{number}")
        found = lm.verify(tmp_path / f"{number}")
        assert any("local_controller" in reason for reason in found.reasons)


def test_a_function_holds_by_its_samples(tmp_path):
    def step(x, y, u):
        return {"x": x + 0.3 * y, "y": 0.9 * y + 0.3 * u}

    formulas = cart(successors="sampled")
    data = {**formulas, "system": FunctionSystem(next=step)}
    function = lm.solve(parse_problem(data))
    other = lm.solve(parse_problem(formulas))
    assert function.control_index.tolist() == other.control_index.tolist()
    assert function.local_controller.proved is None
    function.save(tmp_path / "function")
    found = lm.verify(tmp_path / "function")
    assert found.holds, found.reasons


def test_corners_of_enclosed_cells_land_in_cells_that_hold():
    lp = lm.compile(parse_problem(NOISY))
    partition, holding = lp.partition, lp.hold >= 0
    true_map = TrueMap(lp.problem, partition)
    cell = np.flatnonzero(holding)
    place = np.stack(partition.multi_index(cell), axis=-1)
    for corner in itertools.product((0.0, 0.25, 1.0), repeat=2):
        x, at = partition.enter(partition.low + (place + np.array(corner)) * partition.width)
        on = holding[at]
        u = lp.controls[lp.hold[at[on]]]
        for w in (-0.02, 0.0, 0.02):
            values = true_map.named(list(x[on].T), list(u.T), [np.full(on.sum(), w)])
            assert holding[true_map.step(values, Deadline())[1]].all()


# published ------------------------------------------------------------------------------------

BOOST = {
    "format": "lmdsl/1",
    "system": {
        "kind": "map",
        "next": {
            "i": "where(mode == 1, 0.99170129263887596*i + 0.16597414722248083, "
            "0.99029502942829728*i - 0.032892318823717293*v + 0.16587291875265633)",
            "v": "where(mode == 1, 0.99291787673210441*v, 0.035241770168268523*i + "
            "0.99233317846969549*v + 0.0029450833173848517)",
        },
    },
    "state_box": {
        "i": {"low": 1.14975, "high": 1.54975, "cells": 800},
        "v": {"low": 5.45025, "high": 5.84975, "cells": 799},
    },
    "attractor": {"boxes": [{"i": [1.15025, 1.54975]}]},
    "control_grid": {"mode": {"values": [1, 2]}},
    "stage_cost": "1",
    "sampling": {"kind": "grid", "per_axis": 2},
    "successors": "enclosed",
    "local_controller": HOLD,
}


def test_a_boost_converter_is_held_where_others_hold_it():
    # SCOTS, by growth bounds, keeps 593,089 of these 799 x 799 cells.
    problem = parse_problem(BOOST)
    partition = Partition.of(problem)
    index = held(problem, partition, CellSets.of(problem, partition))
    assert (index >= 0).sum() >= 593_089


def test_where_no_cell_holds_nothing_else_is_compiled(monkeypatch, tmp_path):
    from lmdsl.model import lp as compiling

    problem = parse_problem(cart(half=0.2))
    monkeypatch.setattr(compiling, "assemble", None)  # it would be called
    lp = lm.compile(problem)
    assert (lp.n, lp.K) == (0, 0)
    assert set(lp.cell_status.tolist()) == {CellStatus.TRAPPED}
    result = lm.solve(problem)
    assert result.cause == "hold"
    result.save(tmp_path / "none")
    earlier = archive.load(tmp_path / "none").cell_status.copy()
    earlier[:5] = CellStatus.ESCAPES  # as they were compiled before
    replace(result, cell_status=earlier).save(tmp_path / "earlier")
    assert lm.verify(tmp_path / "earlier").holds
    earlier = np.where(earlier == CellStatus.ESCAPES, CellStatus.ATTRACTOR, earlier).astype(
        np.uint8
    )
    replace(result, cell_status=earlier).save(tmp_path / "spoiled")
    assert not lm.verify(tmp_path / "spoiled").holds

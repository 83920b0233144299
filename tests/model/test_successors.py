"""Enclosed successors: everything that a cell can meet is in its ranges, and what survives them.

The ranges are compared with the true map at dense and at awkward points, the fixed points with
plain ones over sets of cells, and the outcome with runs whose noise does its worst.
"""

import itertools
import json

import numpy as np
import pytest

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.transitions import assemble
from lmdsl.model.grid.partition import Partition
from lmdsl.model.successors.survival import Successors
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import parse_problem


def declared(system, axes, controls=None, attractor=None, **more):
    return parse_problem({
        "format": "lmdsl/1",
        "system": system,
        "state_box": axes,
        "attractor": attractor or {"cells": [[0] * len(axes)]},
        "control_grid": {"u": {"values": [-0.3, 0.0, 0.25]}} if controls is None else controls,
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2, "corners": True},
        "successors": "enclosed",
        **more,
    })  # fmt: skip


def line(low, high, cells, **more):
    return {"low": low, "high": high, "cells": cells, **more}


BAND = {"boxes": [{"y": [-0.5, 0.5]}]}
CIRCLE = {"x": line(0.0, 1.0, 7, periodic=True), "y": line(-1.0, 1.5, 5)}
PROBLEMS = {
    "line": declared(
        {"kind": "map", "next": {"x": "0.7*x + u*(1 - x**2)"}}, {"x": line(-1, 1, 9)},
        attractor={"boxes": [{"x": [-0.34, 0.34]}]},
    ),
    "circle": declared(
        {"kind": "map", "next": {"x": "x + 0.3*y + u*sin(2*pi*x)", "y": "0.8*y + 0.2*u"}}, CIRCLE,
        attractor=BAND,
    ),
    "doubling": declared(
        {"kind": "map", "next": {"x": "2*x + 0.1*u", "y": "0.5*y + 0.1*cos(2*pi*x)"}}, CIRCLE,
        attractor=BAND,
    ),
    "jumps": declared(
        {"kind": "map", "next": {"x": "where(x*y > 0.2, x - 0.2, x + u)", "y": "0.4*floor(3*y)"}},
        {"x": line(-1, 1, 8), "y": line(-1, 1, 6)},
    ),
    "nodes": declared(
        {"kind": "map", "next": {"x": "0.6*x + u*w"}}, {"x": line(-1, 1, 9)},
        attractor={"boxes": [{"x": [-0.34, 0.34]}]},
        noise={"w": {"values": [-1, 0, 1.5], "weights": [0.2, 0.5, 0.3]}},
    ),
    "uniform": declared(
        {"kind": "map", "next": {"x": "0.6*x + u + w*x + w**2", "y": "0.5*y - w"}}, CIRCLE,
        attractor=BAND,
        noise={"w": {"uniform": {"low": -0.2, "high": 0.3, "points": 3}}},
    ),
    "clip": declared(
        {"kind": "map", "next": {"x": "1.4*x + u", "y": "y + 0.5*u"}},
        {"x": line(-1, 1, 6), "y": line(0, 1, 5)}, on_exit="clip",
        attractor={"boxes": [{"y": [0.8, 1]}]},
        avoid={"boxes": [{"x": [0.3, 0.7], "y": [0.0, 0.3]}]},
    ),
    "poles": declared(
        {"kind": "map", "next": {"x": "0.2/x + u", "y": "sqrt(y)*0.9"}},
        {"x": line(-1, 1, 8), "y": line(-0.5, 1, 6)},
    ),
    "edges": declared(  # images that lie on edges: all neighbours count
        {"kind": "map", "next": {"x": "x + u", "y": "-y"}},
        {"x": line(0, 1, 10), "y": line(-0.3, 0.3, 6)},
        attractor={"boxes": [{"x": [0, 0.2]}]},
        controls={"u": {"values": [-0.1, 0.0, 0.2]}},
    ),
    "admissible": declared(
        {"kind": "map", "next": {"x": "0.9*x + u"}}, {"x": line(-1, 1, 12)},
        attractor={"boxes": [{"x": [-0.35, 0.35]}]},
        admissible="x*u < 0.1 and x + u > -1.1",
    ),
    "endpoint": declared(
        {"kind": "ode", "derivative": {"x": "y", "y": "-sin(x) + 4*u"}, "step": 0.2,
         "substeps": 2, "judged": "endpoint"},
        {"x": line(-1, 1, 40), "y": line(-1, 1, 35)},
        attractor={"boxes": [{"x": [-0.5, 0.5], "y": [-0.45, 0.45]}]},
    ),
}  # fmt: skip


def successors(problem):
    partition = Partition.of(problem)
    transitions = assemble(problem, partition)
    found = Successors.asked_for(problem, partition, transitions, Deadline())
    cell = transitions.sets.free[owner(transitions.pair_pointer)]
    return partition, transitions, found, cell


def inside(partition, found, pair, cells):
    """Return which cells lie in a range of a pair."""
    first, last = found._ranges
    index = np.stack(partition.multi_index(cells), axis=-1)
    held = np.zeros(len(cells), dtype=bool)
    for part in range(first.shape[1]):
        a, b = first[pair, part], last[pair, part]
        on = (index >= a) & (index <= b)
        again = index + partition.cells
        on |= partition.periodic & (again >= a) & (again <= b)
        held |= on.all(axis=1)
    return held


def states_of(partition, cell, count, rng):
    """Return states that are located in a cell: inside, at its edges, and beside them."""
    index = np.array([int(k[0]) for k in partition.multi_index(np.array([cell]))])
    offsets = rng.random((count, len(index)))
    special = np.array([0.0, 1.0, 0.9e-9, -0.9e-9, 1 - 1.1e-9, 1e-12, 0.5])
    chosen = rng.random(offsets.shape) < 0.4
    offsets[chosen] = rng.choice(special, size=int(chosen.sum()))
    x = partition.low + (index + offsets) * partition.width
    seam = partition.periodic & (index == 0) & (rng.random(offsets.shape) < 0.2)
    x = np.where(seam, partition.high, x)
    states, located = partition.enter(x)
    return states[located == cell]


def noise_of(problem, count, rng):
    columns = []
    for noise in (problem.noise or {}).values():
        values, _ = noise.nodes()
        drawn = rng.choice(values, size=count)
        if hasattr(noise, "uniform"):
            drawn = rng.uniform(noise.uniform.low, noise.uniform.high, count)
            drawn[::7] = noise.uniform.high
        columns.append(drawn)
    return columns


@pytest.mark.parametrize("name", PROBLEMS)
def test_everything_that_a_cell_can_meet_is_in_its_ranges(name):
    problem, rng = PROBLEMS[name], np.random.default_rng(0)
    partition, transitions, found, cell = successors(problem)
    true_map, controls = TrueMap(problem, partition), lm.compile(problem).controls
    admitted = problem.admitted()
    checked = 0
    for pair in np.flatnonzero(found.admissible):
        x = states_of(partition, cell[pair], 60, rng)
        u = np.repeat(controls[[transitions.control[pair]]], len(x), axis=0)
        w = noise_of(problem, len(x), rng)
        _, reached = partition.enter(true_map.images(x, u, w))
        assert (reached >= 0).all(), (pair, x[reached < 0])
        assert not transitions.sets.avoid[reached].any()
        assert inside(partition, found, pair, reached).all()
        if admitted is not None:
            values = dict(zip((*problem.states, *problem.controls), (*x.T, *u.T), strict=True))
            assert (admitted(values)[0] != 0).all()
        checked += len(x)
    assert checked > 200


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_support_of_sampled_rows_lies_in_the_ranges(name):
    partition, transitions, found, _ = successors(PROBLEMS[name])
    rows = transitions.rows
    for pair in np.flatnonzero(found.admissible):
        target = rows.target[rows.pointer[pair] : rows.pointer[pair + 1]]
        free = transitions.sets.free[target[target < rows.columns]]
        assert inside(partition, found, pair, free).all()


def plain_sets(partition, transitions, found):
    """Return C and the sure levels by their definitions, over sets of cells."""
    sets, own = transitions.sets, owner(transitions.pair_pointer)
    every = np.arange(partition.size)
    reach = {
        int(k): set(every[inside(partition, found, k, every)].tolist())
        for k in np.flatnonzero(found.admissible)
    }
    attractor = set(np.flatnonzero(sets.attractor).tolist())
    cells = {int(i) for i in sets.free}
    while True:
        good = cells | attractor
        kept = {k: s for k, s in reach.items() if s <= good and int(sets.free[own[k]]) in cells}
        arriving, before = set(attractor), None
        while before != arriving:
            before = set(arriving)
            for k in kept:
                rows = transitions.rows
                target = rows.target[rows.pointer[k] : rows.pointer[k + 1]]
                if (target == rows.columns).any() or any(
                    int(sets.free[t]) in arriving for t in target if t < rows.columns
                ):
                    arriving.add(int(sets.free[own[k]]))
        smaller = cells & (arriving - attractor)
        if smaller == cells:
            break
        cells = smaller
    level = dict.fromkeys(attractor, 0)
    while True:
        sure = set(level)
        new = {int(sets.free[own[k]]) for k, s in reach.items() if s <= sure} - sure
        if not new:
            return cells, level
        level |= dict.fromkeys(new, max(level.values()) + 1)


@pytest.mark.parametrize("name", PROBLEMS)
def test_fixed_points_are_those_of_their_definition(name):
    problem = PROBLEMS[name]
    partition, transitions, found, _ = successors(problem)
    cells, level = plain_sets(partition, transitions, found)
    lp = lm.compile(problem)
    assert set(lp.cells.tolist()) == cells
    assert {int(i): int(lp.sure_levels[i]) for i in np.flatnonzero(lp.sure_levels >= 0)} == level


def worst_runs(result, rng, count=2_000, steps=60):
    """Return how many runs are lost whose noise is random, often at its ends."""
    problem, lp = result.problem, result.lp
    true_map, partition = TrueMap(problem, lp.partition), lp.partition
    cell = rng.choice(lp.cells, size=count)
    x = np.concatenate([states_of(partition, c, 1, rng)[:1] for c in cell])
    lost = 0
    for _ in range(steps):
        where = partition.locate(list(x.T))
        going = result.cell_status[where] != 0
        x, where = x[going], where[going]
        if not len(x):
            break
        index = result.control_index[where]
        lost += int((index < 0).sum())
        x, index = x[index >= 0], index[index >= 0]
        images = true_map.images(x, lp.controls[index], noise_of(problem, len(x), rng))
        states, cells = partition.enter(images)
        bad = (cells < 0) | lp_avoid(lp)[cells]
        lost += int(bad.sum())
        x = states[~bad]
    return lost


def lp_avoid(lp):
    return lp.cell_status == 5


@pytest.mark.parametrize("name", PROBLEMS)
def test_no_run_is_lost(name):
    result = lm.solve(PROBLEMS[name])
    if result.lp.n == 0:
        assert name in ("jumps", "poles")
        return
    assert result.claims["safe"] is (True if result.verified else result.claims["safe"])
    if result.certificate.safe:
        assert worst_runs(result, np.random.default_rng(1)) == 0


@pytest.mark.parametrize("spoil", ["safe", "level", "control", "nothing"])
def test_a_spoiled_directory_is_refused(tmp_path, spoil):
    from lmdsl.common import arrays

    result = lm.solve(PROBLEMS["line"])
    assert result.verified
    assert result.sure_cells > 0
    result.save(tmp_path / "out")
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.sure_cells == result.sure_cells
    assert loaded.claims == result.claims
    if spoil != "nothing":
        certificate = json.loads((tmp_path / "out" / "certificate.json").read_text())
        certificate.pop("files", None), certificate.pop("save", None)
        with np.load(tmp_path / "out" / "solution.npz") as file:
            held = {name: file[name] for name in file.files}
        if spoil == "safe":
            certificate["claims"]["safe"] = None
        if spoil == "level":
            held["sure_levels"][np.argmax(held["sure_levels"])] -= 1
        if spoil == "control":
            free = np.flatnonzero(held["cell_status"] == 1)
            held["control_index"][free] = (held["control_index"][free] + 1) % 3
        (tmp_path / "out" / "certificate.json").write_text(json.dumps(certificate))
        (tmp_path / "out" / "solution.npz").write_bytes(arrays.packed(held))
    assert lm.verify(tmp_path / "out").holds is (spoil == "nothing")


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"noise": {"w": {"normal": {"std": 1, "points": 3}}}}, "noise.w.normal"),
        ({"system": lm.systems.FunctionSystem(next=lambda x, u: x)}, "successors"),
        ({"successors": "exact"}, "successors"),
    ],
)
def test_what_cannot_be_enclosed_is_refused(change, where):
    with pytest.raises(lm.BadInput, match=f"^{where}: "):
        PROBLEMS["line"].replaced(**change)


def test_how_likely_noise_is_that_is_not_covered_is_printed(tmp_path, capsys):
    """Beyond 3 standard deviations 0.27 % of a normal variable lie, of two at most twice that."""
    normal = {"normal": {"std": 0.05, "points": 3, "within": 3}}
    problem = PROBLEMS["line"].replaced(
        system={"kind": "map", "next": {"x": "0.5*x + 0.1*w + 0.1*v"}},
        noise={"w": normal, "v": normal},
    )
    problem.save(tmp_path / "noisy.json")
    assert main(["solve", str(tmp_path / "noisy.json"), "--no-simulate"]) == 0
    assert "a step leaves with probability 5.5e-03 at most" in capsys.readouterr().out


def test_within_bounds_normal_noise():
    problem = PROBLEMS["line"].replaced(
        system={"kind": "map", "next": {"x": "0.5*x + 0.1*w"}},
        noise={"w": {"normal": {"std": 1, "points": 3, "within": 2}}},
    )
    partition, _, found, cell = successors(problem)
    for pair, noise in itertools.product(np.flatnonzero(found.admissible), (-2.0, -1.0, 2.0)):
        x = partition.centres(cell[[pair]])
        _, reached = partition.enter(0.5 * x + 0.1 * noise)
        assert inside(partition, found, pair, reached).all()

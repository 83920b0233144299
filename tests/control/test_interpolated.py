"""Interpolated control: laws that are affine are met exactly, jumps stay, hulls are not left."""

import itertools
import json

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl import cli
from lmdsl.control.controller import Controller
from lmdsl.control.loop import ClosedLoop
from lmdsl.model.grid.partition import Partition


def grid(*axes, clip=False):
    """A partition by (low, high, cells, periodic)."""
    low, high, cells, periodic = (np.array(x) for x in zip(*axes, strict=True))
    names = tuple(f"x{k}" for k in range(len(axes)))
    cells = cells.astype(np.int64)
    return Partition(names, low, high, (high - low) / cells, cells, periodic.astype(bool), clip)


def controller(partition, u, missing=()):
    """The law whose control in every cell is that of u, shape (N, p)."""
    index = np.arange(partition.size, dtype=np.int32)
    index[list(missing)] = -1
    return Controller(partition, np.asarray(u, dtype=float), index)


def kuhn(partition, law, x):
    """The same by the book: the simplex is searched for among all orders of the axes."""
    t = (x - partition.low) / partition.width - 0.5
    base = np.floor(t).astype(int)
    f = t - base
    for order in itertools.permutations(range(len(f))):
        g = [1.0, *(f[i] for i in order), 0.0]
        if all(a >= b for a, b in itertools.pairwise(g)):
            break
    corner, found = base.copy(), []
    for k in range(len(g) - 1):
        if k:
            corner[order[k - 1]] += 1
        place = [i % n if around else min(max(i, 0), n - 1) for i, n, around in
                 zip(corner, partition.shape, partition.periodic, strict=True)]  # fmt: skip
        found.append((g[k] - g[k + 1], np.ravel_multi_index(place, partition.shape)))
    own = law.index[partition.locate(list(x[:, None]))[0]]
    if own < 0:
        return np.full(law.vectors.shape[1], np.nan)
    reach = np.ptp(law.vectors, axis=0) / 4
    near = [(w, law.vectors[law.index[i]]) for w, i in found if law.index[i] >= 0]
    kept = [(w, u) for w, u in near if (np.abs(u - law.vectors[own]) <= reach).all()]
    total = sum(w for w, _ in kept)
    return sum(w * u for w, u in kept) / total if total else law.vectors[own]


def test_one_axis_is_piecewise_linear():
    partition = grid((0.0, 2.0, 10, False))
    centres = partition.centres(np.arange(10))[:, 0]
    u = np.sin(centres)[:, None]
    x = np.linspace(0, 2, 999)[:, None]
    found = controller(partition, u)(x, mode="interpolated")
    np.testing.assert_allclose(found[:, 0], np.interp(x[:, 0], centres, u[:, 0]), atol=1e-14)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_an_affine_law_is_met_between_the_outermost_centres(d):
    partition = grid(*[(-1.0, 2.0, 9, False)] * d)
    slope, rng = np.array([[0.3, -0.2, 0.1], [0.0, 0.25, 0.2]])[:, :d], np.random.default_rng(d)
    u = partition.centres(np.arange(partition.size)) @ slope.T + 1
    half = partition.width / 2
    x = partition.low + half + (partition.high - partition.low - 2 * half) * rng.random((500, d))
    found = controller(partition, u)(x, mode="interpolated")
    np.testing.assert_allclose(found, x @ slope.T + 1, atol=1e-13)


@pytest.mark.parametrize("seed", range(6))
def test_it_is_kuhns_triangulation_within_branches(seed):
    """Random laws with jumps and holes, on circles and intervals, against the plain search."""
    rng = np.random.default_rng(seed)
    d = 1 + seed % 3
    axes = [(-1.0, 1.0 + k, int(rng.integers(2, 6)), bool(rng.integers(2))) for k in range(d)]
    partition = grid(*axes)
    u = np.round(rng.random((partition.size, 2)), 1)
    missing = np.flatnonzero(rng.random(partition.size) < 0.2)
    law = controller(partition, u, missing)
    x = partition.low + (partition.high - partition.low) * rng.random((300, d))
    found = law(x, mode="interpolated")
    wanted = np.array([kuhn(partition, law, each) for each in x])
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert (np.isnan(found) == np.isnan(law(x))).all()  # where there is a control is the same


def test_a_jump_stays_a_jump():
    partition = grid((0.0, 1.0, 20, False), (0.0, 1.0, 20, False))
    u = np.where(partition.centres(np.arange(400)).sum(axis=1) > 1, 1.0, -1.0)[:, None]
    law, x = controller(partition, u), np.random.default_rng(0).random((2000, 2))
    np.testing.assert_array_equal(law(x, mode="interpolated"), law(x))


def test_where_neighbours_agree_nothing_is_rounded():
    partition = grid((0.0, 1.0, 7, True), (0.0, 1.0, 5, False))
    law = controller(partition, np.full((35, 1), 0.1))
    assert (law(np.random.default_rng(1).random((999, 2)), mode="interpolated") == 0.1).all()


def test_the_seam_of_a_circle_is_no_place():
    partition = grid((0.0, 1.0, 8, True))
    u = np.cos(2 * np.pi * partition.centres(np.arange(8)))
    law = controller(partition, u)
    across = law([[1 - 1e-9], [0.0], [1.0], [1e-9]], mode="interpolated")
    np.testing.assert_allclose(across, np.full((4, 1), (u[0] + u[7])[0] / 2), atol=1e-7)


def test_the_hull_of_the_neighbours_is_not_left():
    result = lm.solve(made(standard_map(25)))
    x = np.random.default_rng(0).random((5000, 2))
    u, plain = result.controller(x, mode="interpolated"), result.controller(x)
    assert (np.isnan(u) == np.isnan(plain)).all()
    on = ~np.isnan(u)
    assert (np.abs(u - plain)[on] <= 0.25 + 1e-12).all()  # a quarter of [-0.5, 0.5]
    assert (np.abs(u[on]) <= 0.5).all()
    assert (u[on] != plain[on]).mean() > 0.3


def test_what_cannot_be_interpolated_is_refused():
    result = lm.solve(made(steps()))
    with pytest.raises(lm.BadInput, match=r"mode: 'smooth' .* \"interpolated\""):
        result.controller([0.5], mode="smooth")
    finite = lm.solve(lm.from_matrices([[[0.5, 0.5], [0, 1]]], [[1.0], [0.0]], targets=[1]))
    with pytest.raises(lm.BadInput, match="mode: a finite model"):
        finite.controller([[0.0]], mode="interpolated")


# In closed loop -------------------------------------------------------------------------------


def test_runs_follow_the_interpolated_law():
    """Steps of the map by hand, under what the controller says in each state."""
    result = lm.solve(made(standard_map(25)))
    differs = False
    for x in ([0.1, 0.2], [0.9, 0.4], [0.33, 0.71]):
        run = result.path(x, mode="interpolated")
        u = result.controller(run.states[:-1], mode="interpolated")
        np.testing.assert_array_equal(run.controls, u)
        differs |= not np.array_equal(u, result.controller(run.states[:-1]))
        for (a, b), (v,), after in zip(run.states, u, run.states[1:], strict=False):
            kick = 0.25 * v * np.sin(2 * np.pi * a)
            np.testing.assert_allclose(after, [(a + b + kick) % 1, (b + kick) % 1], atol=1e-12)
    assert differs


def test_it_has_figures_of_its_own(tmp_path, capsys):
    result = lm.solve(made(standard_map(25)))
    plain, smooth = (result.simulate(500, mode=mode) for mode in ("constant", "interpolated"))
    assert plain == result.simulate(500)
    assert (plain.law, smooth.law) == ("constant", "interpolated")
    assert smooth.cost["mean"] != plain.cost["mean"]
    assert "interpolated between cells, not as certified" in smooth.text()
    assert "interpolated" not in plain.text()
    result.save(tmp_path / "out")
    command = ["simulate", str(tmp_path / "out"), "--starts", "500", "--interpolated"]
    assert cli.main([*command, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found.pop("interpolated") == smooth.to_dict()
    assert found == plain.to_dict()
    assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert out.index("500 runs") < out.index("interpolated between cells")
    assert cli.main([*command[:-1], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["interpolated"] is None


def test_a_local_feedback_stays():
    local = {"kind": "linear", "gain": {"u": {"x": 0.3, "y": 0.7}},
             "orbit": [{"x": 0.25, "y": 0.5}, {"x": 0.75, "y": 0.5}]}  # fmt: skip
    law = lm.solve(made(standard_map(20, local_controller=local))).controller
    cells = np.flatnonzero(law.local.attractor)
    x = law.partition.centres(cells) + 0.01
    np.testing.assert_array_equal(law(x, mode="interpolated"), law(x))


def test_an_affine_plant_is_followed_to_the_reference():
    """A law that is affine between centres drives x+ = x + u as the affine law does."""
    data = steps(
        system={"kind": "map", "next": {"x": "x + u"}},
        state_box={"x": {"low": -1, "high": 1, "cells": 41}},
        attractor={"cells": [[20]]},
        control_grid={"u": {"low": -0.5, "high": 0.5, "points": 41}},
    )
    result = lm.solve(made(data))
    centres = result.partition.centres(np.arange(41))
    law = controller(result.partition, -0.5 * centres, missing=[20])
    loop = ClosedLoop(result.problem, law, result.cell_status).by("interpolated")
    path = loop.path([0.9], 10)[:, 0]
    assert len(path) > 4
    np.testing.assert_allclose(path[:-1], 0.9 * 0.5 ** np.arange(len(path) - 1), rtol=1e-12)

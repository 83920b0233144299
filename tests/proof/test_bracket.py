"""Lower bounds of what any control law costs: closed forms, all controls tried, spoiled bounds."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from optimal import Plain
from problems import made, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline
from lmdsl.proof import proving
from lmdsl.proof.bounds.flights import refining
from lmdsl.proof.bounds.optimum import bracket, checking
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.results.directory.proved import loop_of


def walk(**more):
    """x+ = x + u on [0, 1], A = the first of 4 cells."""
    return {
        **steps(),
        "system": {"kind": "map", "next": {"x": "x + u"}},
        "control_grid": {"u": {"values": [-0.25, 0.0]}},
        **more,
    }


def loop_for(data):
    return loop_of(lm.solve(made(data)))


def bounded(data, rows=2**12, most=1e3, loop=None):
    """The bound on as many parts as so many rows allow, and its loop."""
    loop = loop_for(data) if loop is None else loop
    cells = np.arange(loop.partition.size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bracket, "FEW", rows)
        return bracket.bound(loop, most, cells, Deadline(), None, 2.0**-36), loop


def at(bound, loop, x):
    """The bound at states, shape (n, d)."""
    partition = loop.partition
    t = (x - partition.low) / (partition.high - partition.low)
    grid = Parts.of(partition, bound.split.astype(np.int64))
    index = np.minimum((t * grid.shape).astype(np.int64), grid.shape - 1)
    return bound.bound[(index * grid.stride).sum(axis=1)]


def few_boxes(patch):
    """Let boxes be bisected no further for the sake of their bounds."""
    patch.setattr(proving, "FEW", 0)
    patch.setattr(proving, "GROWN", 1)


def starts(loop, count, seed=0):
    """Random states of the box."""
    partition = loop.partition
    rng = np.random.default_rng(seed)
    return partition.low + rng.random((count, partition.dimension)) * (
        partition.high - partition.low
    )


def checked(bound, loop):
    arrays = {"optimum_split": bound.split, "optimum": bound.bound}
    return checking.checked(loop, arrays, lambda: None)[1]


def test_a_walk_costs_as_many_steps_as_cells():
    """V* = 1, 2, 3 in cells 1, 2, 3; one part in 2^9 of them touches the next cell."""
    bound, loop = bounded(walk(), rows=2**13)
    x = np.array([[0.3], [0.4], [0.6], [0.7], [0.8], [0.99]])
    np.testing.assert_allclose(at(bound, loop, x), [1, 1, 2, 2, 3, 3])
    assert bound.nonnegative
    assert bound.bound.max() <= 3
    assert checked(bound, loop) == []


@pytest.mark.parametrize(("gamma", "cost"), [(0.5, 2.0), (1.5, 2.0), (1.0, 0.5)])
def test_later_costs_count_by_powers_of_gamma(gamma, cost):
    data = walk(gamma=gamma, stage_cost=str(cost), terminal_cost="3 + 0*x")
    bound, loop = bounded(data, rows=2**13)
    for x, n in ((0.4, 1), (0.6, 2), (0.9, 3)):
        wanted = cost * sum(gamma**k for k in range(n)) + gamma**n * 3
        if gamma < 1:  # to wait for ever costs less
            wanted = min(wanted, cost / (1 - gamma))
        assert at(bound, loop, np.array([[x]]))[0] == pytest.approx(wanted, rel=1e-3)
        assert at(bound, loop, np.array([[x]]))[0] <= wanted
    assert checked(bound, loop) == []


@pytest.mark.parametrize("rows", [2**6, 2**12])
def test_of_a_free_stay_nothing_is_known(rows):
    """x+ = x + u, G = u^2: a part that stays touches the next one, and so on to A."""
    bound, loop = bounded(walk(stage_cost="u**2"), rows)
    assert at(bound, loop, np.array([[0.9]]))[0] == 0
    assert checked(bound, loop) == []


def test_finer_parts_give_better_bounds():
    data = walk(stage_cost="x**2 + 0.1", control_grid={"u": {"values": [-0.2, -0.1, 0.05]}})
    loop, x = loop_for(data), np.linspace(0.26, 0.99, 40)[:, None]
    best = np.zeros(len(x))
    for rows in (2**5, 2**8, 2**11, 2**14):
        bound, _ = bounded(data, rows, loop=loop)
        W = at(bound, loop, x)
        assert (best - 1e-9 <= W).all()
        best = W
    plain = Plain(data)
    true = np.array([plain.least({"x": float(t)}, 5) for t in x[:, 0]])
    assert (best <= true).all()
    assert np.mean(best) > 0.97 * np.mean(true)


PLANE = {
    "format": "lmdsl/1",
    "system": {"kind": "map", "next": {"x": "0.6*x + 0.3*y*u", "y": "0.5*y - 0.2*x + u"}},
    "state_box": {"x": {"low": -1, "high": 1, "cells": 6}, "y": {"low": -1, "high": 1, "cells": 6}},
    "attractor": {"cells": [[2, 2], [2, 3], [3, 2], [3, 3]]},
    "control_grid": {"u": {"values": [-0.3, 0.0, 0.3]}},
    "stage_cost": "x**2 + y**2 + 0.3*u**2",
    "sampling": {"kind": "grid", "per_axis": 2},
}

CASES = {
    "plane": PLANE,
    "gamma": {**PLANE, "gamma": 1.1},
    "terminal": {**PLANE, "terminal_cost": "0.5 + x**2"},
    "avoid": {**PLANE, "avoid": {"boxes": [{"x": [0.34, 0.65], "y": [-0.3, 0.3]}]}},
    "admissible": {**PLANE, "admissible": "u <= 0.1 or x > 0.2"},
    "clip": {**PLANE, "on_exit": "clip",
             "system": {"kind": "map", "next": {"x": "0.7*x + y*u", "y": "0.6*y - 0.2*x + 2*u"}}},
    "nodes": {**PLANE, "noise": {"w": {"values": [-0.05, 0.1], "weights": [0.7, 0.3]}},
              "system": {"kind": "map", "next": {"x": "0.6*x + 0.3*y*u + w", "y": "0.5*y + u"}}},
    "uniform": {**PLANE, "noise": {"w": {"uniform": {"low": -0.1, "high": 0.1, "points": 3}}},
                "system": {"kind": "map", "next": {"x": "0.6*x + 0.3*y*u + w", "y": "0.5*y + u"}}},
    "killed": {**PLANE, "discount": 0.8},
    "circle": {**PLANE, "state_box": {"x": {"low": -1, "high": 1, "cells": 6, "periodic": True},
                                      "y": {"low": -1, "high": 1, "cells": 6}},
               "system": {"kind": "map", "next": {"x": "x + 0.5*y + u", "y": "0.7*y - 0.2*x*u"}}},
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_no_law_that_is_found_costs_less(name):
    """All controls tried, a few steps ahead, from random points: a path costs no less."""
    data = CASES[name]
    bound, loop = bounded(data, rows=2**12)
    assert checked(bound, loop) == []
    plain, close, found = Plain(data), [], 0
    x = starts(loop, 60, seed=len(name))
    for state, W in zip(x, at(bound, loop, x), strict=True):
        values = dict(zip(plain.names, state.tolist(), strict=True))
        if plain.entered(values) or plain.enter(values) is None:
            continue
        true = plain.least(values, 3 if plain.noise else 5)
        if math.isfinite(true):
            found += 1
            assert true * (1 + 1e-12) >= W
            close.append(W / true)
    assert found > 20
    assert np.mean(close) > 0.2


@settings(max_examples=12, deadline=None)
@given(
    st.tuples(*[st.floats(-0.9, 0.9) for _ in range(4)]),
    st.tuples(st.floats(0, 1), st.floats(0, 1)),
    st.sampled_from([0.8, 1.0, 1.2]),
)
def test_random_maps(matrix, cost, gamma):
    a, b, c, d = (round(x, 3) for x in matrix)
    data = {
        **PLANE, "gamma": gamma, "stage_cost": f"{cost[0]:.3f}*x**2 + {cost[1]:.3f}*u**2",
        "system": {"kind": "map", "next": {
            "x": f"({a})*x + ({b})*y + 0.2*sin(3*y)*u", "y": f"({c})*x + ({d})*y + u",
        }},
    }  # fmt: skip
    result = lm.solve(made(data))
    if not (result.control_index >= 0).any():
        return
    bound, loop = bounded(data, rows=2**11, loop=loop_of(result))
    assert checked(bound, loop) == []
    plain, x = Plain(data), starts(loop, 25)
    for state, W in zip(x, at(bound, loop, x), strict=True):
        values = dict(zip(plain.names, state.tolist(), strict=True))
        if not plain.entered(values):
            assert plain.least(values, 4) * (1 + 1e-12) >= W


def test_paths_may_enter_on_the_way():
    """x' = u, cost rate 1, a long step: the path meets A, and pays until then only."""
    data = {
        **walk(), "control_grid": {"u": {"values": [-0.6, -0.1]}}, "cost_rate": "1",
        "system": {"kind": "ode", "derivative": {"x": "u"}, "step": 1.0},
    }  # fmt: skip
    del data["stage_cost"]
    bound, loop = bounded(data)
    assert checked(bound, loop) == []
    x = np.array([[0.3], [0.7], [0.95]])
    assert (at(bound, loop, x) <= (x[:, 0] - 0.25) / 0.6 + 1e-9).all()
    assert at(bound, loop, x)[2] == pytest.approx(1)  # no step from there reaches A
    whole = {**data, "stage_cost": "1"}
    del whole["cost_rate"]
    bound, loop = bounded(whole)
    assert at(bound, loop, x)[0] == pytest.approx(1)  # a step counts as one


def test_what_surely_leaves_is_no_choice():
    """Out of two controls one leaves at once: it does not count, however cheap."""
    data = walk(control_grid={"u": {"values": [-0.25, 2.0]}}, stage_cost="where(u > 1, 0, 1)")
    bound, loop = bounded(data, rows=2**13)
    assert at(bound, loop, np.array([[0.9]]))[0] == pytest.approx(3)


def test_costs_that_may_be_negative_are_said_to_be_assumed_not_to_be():
    bound, _ = bounded(walk(stage_cost="1 + 0*x"))
    assert bound.nonnegative
    samples = walk(stage_cost="x - 0.26")  # below 0 at the edge of cell 1, which no sample sees
    bound, _ = bounded(samples)
    assert not bound.nonnegative
    assert (bound.bound >= 0).all()


def spoiled(bound, change):
    W = bound.bound.copy()
    change(W)
    return bound._replace(bound=W)


@pytest.mark.parametrize("name", ["plane", "nodes", "terminal", "circle"])
def test_a_bound_that_is_a_little_too_good_is_refused(name):
    """Raised by 1e-6 anywhere: T W does not rise with it, but where a part meets itself."""
    bound, loop = bounded(CASES[name], rows=2**9)
    grid = Parts.of(loop.partition, bound.split.astype(np.int64))
    game = loop.game()
    rng, refused = np.random.default_rng(0), 0
    parts = np.flatnonzero(np.isfinite(bound.bound) & (bound.bound > 0))
    for i in rng.choice(parts, 25):

        def raised(W, i=i):
            W[i] *= 1 + 1e-6

        reasons = checked(spoiled(bound, raised), loop)
        inside = np.isfinite(game.entry[grid.cell(loop.partition, np.array([i]))[0]])
        refused += bool(reasons)
        if inside:
            assert reasons
    assert refused >= 23 if name != "nodes" else refused >= 15


def test_what_is_no_bound_is_refused():
    bound, loop = bounded(PLANE, rows=2**9)
    for change in (
        lambda W: W.__setitem__(0, np.nan), lambda W: W.__setitem__(0, np.inf),
        lambda W: W.__setitem__(0, -1.0), lambda W: np.multiply(W, 1.01, out=W),
        lambda W: W.__setitem__(slice(None), 1e6),
    ):  # fmt: skip
        assert checked(spoiled(bound, change), loop)
    assert checked(bound._replace(split=bound.split + 1), loop)
    assert checked(bound._replace(split=bound.split + 100), loop)
    with_terminal, other = bounded({**PLANE, "terminal_cost": "1 + 0*x"}, rows=2**9)
    assert checked(with_terminal, loop)  # of another problem
    assert checked(bound, other) == []


def test_brackets_are_kept_and_verified(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bracket, "FEW", 2**12)
    few_boxes(monkeypatch)
    folder = tmp_path / "out"
    result = lm.solve(made(PLANE))
    result.save(folder)
    assert main(["prove", str(folder), "--bracket", "--json", "--target", "0.9"]) == 0
    said = json.loads(capsys.readouterr().out)
    low, high = said["optimum"]
    assert 0 < low <= high == said["cost"][1]
    assert said["nonnegative"] is True
    assert main(["verify", str(folder), "--json"]) == 0
    assert "no control law costs less" in str(lm.verify(folder))
    proof = result.prove(0.9, bracket=True)
    below, above = proof.maps
    arrives = np.isfinite(below)
    assert below.shape == (36,)
    assert (below[arrives] <= above[arrives]).all()
    assert proof.parts == len(proof.bound.bound) == said["parts"]
    assert "what any control law costs there is at least" in str(proof)
    certificate = json.loads((folder / "certificate.json").read_text())
    certificate["proof"]["optimum"][0] *= 1.001
    (folder / "certificate.json").write_text(json.dumps(certificate))
    assert any("proof.optimum" in reason for reason in lm.verify(folder).reasons)


def test_without_a_bracket_nothing_is_said_of_laws(tmp_path):
    result = lm.solve(made(PLANE))
    proof = result.prove(0.9)
    assert (proof.optimum, proof.nonnegative, proof.parts, proof.maps) == (None,) * 4
    with pytest.raises(lm.BadInput, match="bracket"):
        result.prove(0.9, bracket="yes")


def test_time_that_is_too_short_leaves_a_bound():
    result = lm.solve(made(PLANE))
    proof = result.prove(0.9, 1e-6, bracket=True)
    assert proof.optimum is None or proof.optimum[0] >= 0
    bound = bracket.bound(loop_of(result), 10.0, np.arange(36), Deadline(1e-9), None, 0.0)
    assert checked(bound, loop_of(result)) == []


def test_maps_are_drawn(monkeypatch):
    """The picture holds the map, cell by cell."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(bracket, "FEW", 2**10)
    few_boxes(monkeypatch)
    result = lm.solve(made(PLANE))
    proof = result.prove(0.9, bracket=True)
    below, above = proof.maps
    for side, wanted in (("below", below), ("above", above), ("ratio", below / above)):
        ax = lm.plotting.bracket(result, proof, side)
        (picture,) = [image for image in ax.images if image.get_array().shape == (6, 6)][:1]
        drawn = np.ma.filled(picture.get_array(), np.nan).T
        np.testing.assert_allclose(drawn, wanted.reshape(6, 6))
    with pytest.raises(lm.BadInput, match="side"):
        lm.plotting.bracket(result, proof, "left")
    with pytest.raises(lm.BadInput, match="bracket=True"):
        lm.plotting.bracket(result, result.prove(0.9))
    with pytest.raises(lm.BadInput, match="another"):
        lm.plotting.bracket(lm.solve(made(walk())), proof)


def test_the_benchmark_runs(monkeypatch, tmp_path):
    """The bracket of the standard map on few cells: bounds on both sides of what runs cost."""
    pytest.importorskip("matplotlib")
    from benchmarks import bracket as benchmark

    monkeypatch.setattr(benchmark, "RUNS", 2_000)
    monkeypatch.setattr(bracket, "FEW", 2**14)
    monkeypatch.setattr(refining, "FEW", 2**12)
    found = benchmark.measured(20, None)
    row = found.row
    assert 0 < row.below < row.mean * 1.05
    assert row.mean < row.above * 1.05
    benchmark.drawn([found], tmp_path / "bracket.png")
    assert (tmp_path / "bracket.png").stat().st_size > 10_000

"""Parts of cells that are followed: sets against points, runs against bounds, spoiled bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import made, standard_map
from proved_points import exceptions
from test_bracket import CASES, PLANE, walk
from test_proof import line

import lmdsl as lm
from lmdsl.machine.deadline import Deadline
from lmdsl.model.successors.compiled import enclosing, tapes
from lmdsl.proof import proving
from lmdsl.proof.bounds.flights import affine, checking, refining
from lmdsl.proof.bounds.flights.following import Flights
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.results.directory.proved import loop_of

PENDULUM = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "derivative": {"x": "y", "y": "u - x - 0.5*y"}, "step": 0.4,
               "substeps": 2},
    "state_box": {"x": {"low": -1, "high": 1, "cells": 8}, "y": {"low": -1, "high": 1, "cells": 8}},
    "attractor": {"boxes": [{"x": [-0.25, 0.25], "y": [-0.25, 0.25]}]},
    "control_grid": {"u": {"values": [-0.5, 0.0, 0.5]}},
    "cost_rate": "x**2 + y**2 + u**2",
    "terminal_cost": "x**2",
    "sampling": {"kind": "grid", "per_axis": 3},
    "on_exit": "clip",
}  # fmt: skip

LOOPS = {
    **{name: CASES[name] for name in ("plane", "gamma", "terminal", "avoid", "clip", "circle")},
    "path": PENDULUM,
    "endpoint": {**PENDULUM, "system": {**PENDULUM["system"], "judged": "endpoint"}},
    "range of noise": {
        **PLANE, "noise": {"w": {"uniform": {"low": -0.05, "high": 0.05, "points": 1}}},
        "system": {"kind": "map", "next": {"x": "0.6*x + 0.3*y*u + w", "y": "0.5*y + u"}},
    },
    "torn": line("where(x > 0.6, x - 0.3 + 0.1*sin(9*x), x - 0.25)", stage_cost="1 + x"),
    "standard map": standard_map(20),
}  # fmt: skip


def proved(data, target=0.9, few=2**13):
    """A result and a proof of it whose parts are followed, however close the bounds are."""
    result = lm.solve(made(data))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refining, "FEW", few)
        patch.setattr(refining, "CLOSE", -1.0)
        patch.setattr(proving, "FEW", 0)
        patch.setattr(proving, "GROWN", 1)
        return result, result.prove(target)


@pytest.mark.parametrize("name", LOOPS)
def test_runs_cost_no_more_than_parts_say(name):
    result, proof = proved(LOOPS[name])
    assert proof.followed is not None
    assert proof.arrives > 0.3
    assert exceptions(result, proof, 4000, seed=len(name)) == {"arrives": 0, "lost": 0, "stays": 0}
    loop, arrays = loop_of(result), proof.arrays()
    _, reasons = checking.checked_above(loop, arrays, lambda: None)
    assert reasons == []


def test_what_is_torn_is_bounded_better_than_by_boxes():
    _, proof = proved(standard_map(20), target=0.5, few=2**15)
    arrives = proof.kind == 1
    volume = 2.0 ** -proof.split[arrives].sum(axis=1, dtype=float)
    boxes = (proof.cost_above[arrives] * volume).sum() / volume.sum()
    assert proof.cost[1] < 0.95 * boxes
    assert proof.cost[0] <= proof.cost[1]


def test_noise_of_several_parts_is_not_followed():
    _, proof = proved(CASES["nodes"])
    assert proof.followed is None
    assert "above" not in proof.arrays()


def test_bounds_that_are_too_good_are_refused():
    """A little less than what a run from a part costs, of any part: it is no bound, and found."""
    result, proof = proved(PLANE, few=2**13)
    loop, arrays = loop_of(result), proof.arrays()
    flights = Flights(loop)
    parts = Parts.of(loop.partition, proof.above.split.astype(np.int64))
    boxes = refining.begun(flights, arrays, parts)
    bound = proof.above.bound
    some = np.flatnonzero((bound < boxes) & np.isfinite(bound))
    assert len(some) > 100
    some = np.random.default_rng(0).choice(some, 20)
    partition = loop.partition
    x = partition.low + (parts.by_axis(some) + 0.5) * (partition.high - partition.low) / parts.shape
    runs = result.closed_loop.compiled.run(x, 100, np.random.default_rng(0), Deadline())
    for i, cost, outcome in zip(some, runs.cost, runs.outcome, strict=True):
        assert outcome == 0
        spoiled = bound.copy()
        spoiled[i] = np.float32(cost * (1 - 1e-5))
        above = proof.above._replace(bound=spoiled)
        assert checking.fault(flights, arrays, above, lambda: None) == i
    for value in (np.nan, -np.inf):
        spoiled = bound.copy()
        spoiled[some[0]] = value
        above = proof.above._replace(bound=spoiled)
        assert checking.fault(flights, arrays, above, lambda: None) == some[0]
    target = int(np.flatnonzero(loop.status == 0)[0])
    spoiled = bound.copy()
    inside = np.flatnonzero(parts.cell(loop.partition, np.arange(parts.size)) == target)[0]
    spoiled[inside] = -1.0
    above = proof.above._replace(bound=spoiled)
    assert checking.fault(flights, arrays, above, lambda: None) == inside


def test_what_is_no_bound_of_parts_is_refused():
    result, proof = proved(PLANE, few=2**9)
    loop, arrays = loop_of(result), proof.arrays()
    for split in (proof.above.split + 1, proof.above.split + 60):
        wrong = {**arrays, "above_split": split.astype(np.uint8)}
        above, reasons = checking.checked_above(loop, wrong, lambda: None)
        assert above is None
        assert "above_split" in reasons[0]
    noisy = loop_of(lm.solve(made(CASES["nodes"])))
    assert "noise" in checking.checked_above(noisy, arrays, lambda: None)[1][0]
    lower = {**arrays, "above": arrays["above"] * np.float32(0.5)}
    assert "may cost more" in checking.checked_above(loop, lower, lambda: None)[1][0]


def test_they_are_kept_and_verified(tmp_path):
    from lmdsl.results.directory import proved as directory

    result, proof = proved(PLANE, few=2**9)
    result.save(tmp_path / "out")
    directory.add(tmp_path / "out", result, proof)
    found = lm.verify(tmp_path / "out")
    assert found.holds, found.reasons
    assert directory.said_of(proof)["followed"] == proof.followed == len(proof.above.bound)


def test_a_time_limit_ends_it():
    result = lm.solve(made(walk(stage_cost="x + 0.1")))
    proof = result.prove(0.9)
    flights = Flights(loop_of(result))
    above = refining.refine(flights, {**proof.arrays(), "lower": 0 * proof.cost_below},
                            Deadline(1e-9), None)  # fmt: skip
    assert above is None or checking.fault(flights, proof.arrays(), above, lambda: None) < 0


@settings(max_examples=8, deadline=None)
@given(st.tuples(*[st.floats(-0.9, 0.9) for _ in range(4)]), st.sampled_from([0.7, 1.0, 1.3]))
def test_random_maps(matrix, gamma):
    """Bounds hold of random states of what arrives, and follow when they are checked."""
    a, b, c, d = (round(x, 3) for x in matrix)
    x, y = f"({a})*x + ({b})*y + 0.2*sin(3*y)*u", f"({c})*x + ({d})*y + u"
    data = {**PLANE, "gamma": gamma, "system": {"kind": "map", "next": {"x": x, "y": y}}}
    if not (lm.solve(made(data)).control_index >= 0).any():
        return
    result, proof = proved(data, target=0.5, few=2**11)
    assert exceptions(result, proof, 500) == {"arrives": 0, "lost": 0, "stays": 0}
    if proof.followed is not None:
        _, reasons = checking.checked_above(loop_of(result), proof.arrays(), lambda: None)
        assert reasons == []


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_sets_hold_the_images_of_their_points(seed):
    """Several steps of a map that turns, shears and bends: points of the first set stay in them."""
    rng = np.random.default_rng(seed)
    a, b, c, d, e = rng.uniform(-1.2, 1.2, 5).round(2).tolist()
    x, y = f"{a}*x + {b}*y + {e}*sin(x*y)", f"{c}*x + {d}*y + 0.3*where(x > 0.2, x - 0.2, 0)"
    data = {**PLANE, "system": {"kind": "map", "next": {"x": x, "y": y}}}
    problem = made(data)
    step, advance = tapes.step(problem), problem.step()
    low = rng.uniform(-1, 1, (40, 2))
    high = low + 10.0 ** rng.uniform(-6, -0.5, (40, 1)) * rng.random((40, 2))
    sets = affine.boxed(low.copy(), high.copy())
    points = low[:, None] + rng.random((40, 50, 2)) * (high - low)[:, None]
    points[:, :4] = np.stack([low, high, np.stack([low[:, 0], high[:, 1]], -1), low], 1)
    none = np.zeros((40, 0))
    for _ in range(6):
        given_ = enclosing.Given(sets.low, sets.high, np.zeros((40, 1)), none, none)
        found = enclosing.enclose(step, given_, sloped=True)
        affine.advance(sets, found, np.zeros((6, 2)))
        images = advance({"x": points[..., 0], "y": points[..., 1], "u": np.zeros((40, 50))})
        points = np.stack(images, axis=-1)
        assert (points >= sets.low[:, None]).all()
        assert (points <= sets.high[:, None]).all()
        away = points - sets.c[:, None]
        for k in range(40):  # in c + A [-1, 1]^2 + e: by least squares, where A has an inverse
            A = sets.A[k]
            if np.linalg.cond(A) < 1e6:
                xi = np.linalg.solve(A, away[k].T).T
                slack = np.abs(np.linalg.inv(A)) @ sets.e[k]
                assert (np.abs(xi) <= 1 + slack + 1e-6).all()

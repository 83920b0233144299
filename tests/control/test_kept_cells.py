"""Cells proved to be kept by a local controller: every state, and the map as computed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from local_controllers import ORBIT, linear_system, local_of
from problems import doubling, made, standard_map

import lmdsl as lm
from lmdsl.control.invariance import examine, keeping
from lmdsl.formulas.enclosures import Jet, apply
from lmdsl.formulas.intervals import Interval
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController
from lmdsl.model.sets import CellSets
from lmdsl.model.true_map import TrueMap


@pytest.mark.long
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_what_is_proved_holds_at_every_point(seed):
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 3))
    A = (rng.standard_normal((d, d)) * rng.choice([0.3, 0.8])).round(3).tolist()
    B = rng.standard_normal((d, 1)).round(3).tolist()
    data = linear_system(A, B, cells=int(rng.choice([4, 8])))
    if rng.random() < 0.5:
        data["on_exit"] = "clip"
    if rng.random() < 0.3:
        for axis in data["state_box"].values():
            axis["periodic"] = True
        data.pop("on_exit", None)
    if rng.random() < 0.7:
        bend = rng.choice(["sin(3*x0) - 3*x0", "abs(x0)", "0.3*x0**2", "min(x0, 0)*x0"])
        data["system"]["next"]["x0"] += f" + {float(rng.choice([0.3, 1.0]))!r}*({bend})"
    gain = {"u0": {f"x{i}": float(rng.standard_normal()) for i in range(d)}}
    data["local_controller"] = {"kind": "linear", "orbit": [[0] * d], "gain": gain}
    problem = made(data)
    local = local_of(problem)
    found = examine(problem, local)
    # An independent count: cells none of whose many points, rim included, leaves A.
    partition = local.partition
    cells = np.flatnonzero(local.attractor)
    ticks = np.linspace(0, 1, 41)
    offsets = np.stack(np.meshgrid(*[ticks] * d), axis=-1).reshape(-1, d)
    good = 0
    for cell in cells:
        corner = partition.low + np.array(partition.multi_index(np.array([cell]))).T[0] * 2 / (
            partition.cells
        )
        x = corner + offsets * partition.width
        u = np.clip(-sum(local.gain[0, 0, i] * x[:, i] for i in range(d)), -1, 1)
        values = {f"x{i}": x[:, i] for i in range(d)} | {"u0": u}
        target = partition.locate([np.broadcast_to(y, len(x)) for y in problem.step()(values)])
        good += bool(((target >= 0) & local.attractor[target]).all())
    assert found.proved <= good
    assert not (found.kept < found.samples and found.proved == found.cells)
    if good == 0:
        assert found.kept < found.samples


def test_a_contraction_is_proved_and_an_expansion_is_not():
    for factor, proved in ((0.5, 4), (0.999, 4), (1.001, 0)):
        rotation = (factor / np.sqrt(2) * np.array([[1, -1], [1, 1]])).tolist()
        for system, count in ((np.diag([factor, factor]).tolist(), proved), (rotation, None)):
            data = linear_system(system, [[0.0], [0.0]])
            data["local_controller"] = {"kind": "linear", "orbit": [[0, 0]], "gain": {}}
            problem = made(data)
            found = examine(problem, local_of(problem))
            if count is not None:
                assert found.proved == count


def test_the_law_has_no_jump_inside_a_cell_of_a_circle():
    # One cell straddles the far side of the circle from its orbit point.
    data = doubling(attractor={"cells": [[0], [1]]})
    data["system"]["next"] = {"x": "0.2 + 0*x"}
    data["state_box"]["x"]["cells"] = 3
    data["control_grid"] = {"u": {"values": [-9, 9]}}
    data["local_controller"] = {"kind": "linear", "orbit": [[0.2]], "gain": {"u": {"x": 1}}}
    local = local_of(made(data))
    x = np.linspace(0.34, 0.66, 33)[:, None]
    u = local(x, np.ones(33, dtype=np.int64))[:, 0]
    np.testing.assert_allclose(u, 0.2 - x[:, 0])


@pytest.mark.long
def test_a_long_enclosure_stops_in_time(monkeypatch):
    text = " + ".join(["0.001*sin(x0)"] * 150)
    data = linear_system([[0.5]], [[1.0]], cells=2000)
    data["attractor"] = {"boxes": [{"x0": [-0.9, 0.9]}]}
    data["system"] = {"kind": "ode", "derivative": {"x0": f"u0 - x0 + {text}"}, "step": 1e-6,
                      "substeps": 1000}  # fmt: skip
    data["local_controller"] = {"kind": "constant"}
    problem = made(data)
    found = examine(problem, local_of(problem))
    assert (found.cells, found.proved, found.kept) == (1800, 0, 10_000)  # nothing is claimed
    data["system"] = {"kind": "map", "next": {"x0": "0.5*x0"}}
    data["state_box"]["x0"]["cells"] = 100_000
    problem = made(data)
    assert examine(problem, local_of(problem)).proved == 90_000
    monkeypatch.setattr("lmdsl.control.invariance.WORK", 1e5)
    found = examine(problem, local_of(problem))
    assert 0 < found.proved < found.cells  # what the work allowed


def held(text, axis, cells, **more):
    """One axis, one map, A and the constant control."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": axis},
        "attractor": {"cells": [[k] for k in cells]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        "local_controller": {"kind": "constant"},
        **more,
    }


CIRCLE = {"low": 0, "high": 1, "cells": 10, "periodic": True}
SEAM = "where(x > 0.5, where(x > 0.9, 0.55, 0.99999999999), 0.05)"
CANCELLED = (
    "5.000001 + 140737206880349.36*(((5.1020070614639586e-14*(x - 5) + -4.095844186343325e-14) - "
    "(((5.1020070614639586e-14*(x - 5) + -4.095844186343325e-14) + 32.0) - 32.0)) - "
    "(-4.790265519712003e-15))"
)
FINE = {"low": -3, "high": 5, "cells": 10_000_000}


@pytest.mark.parametrize(
    ("text", "axis", "cells", "proved"),
    [
        # A state near `high` lies in the first cell; -1e-11 becomes 1 - 1e-11, and so on.
        (SEAM, CIRCLE, [0], 0),
        ("where(x > 0.5, where(x > 0.9, 0.05, 0.99999999999), 0.05)", CIRCLE, [0], 1),
        ("where(x > 0.9, 0.55, -1e-11)", CIRCLE, [0], 0),
        ("where(x > 0.5, 3.05, 0.05)", CIRCLE, [0], 1),  # whole turns
        ("0.05 + 0.5*floor(x)", CIRCLE, [0], 0),  # the state may be exactly 1
        ("0.05 + 2e6*(1 + x)", CIRCLE, [0], 0),  # too many turns away
        ("0.05 + 1e6 + 0*x", CIRCLE, [0], 1),
        # What is left of the sum is rounding: the real map keeps the cell, the computed does not.
        (
            f"where(abs(x - 5.5) < 0.6, {CANCELLED}, 5.5)",
            {"low": 0, "high": 10, "cells": 10},
            [5],
            0,
        ),
        ("5.5 + 5e15*((x + 32) - 32 - x)", {"low": 0, "high": 10, "cells": 10}, [5], 0),
        ("5.5 + 1e13*((x + 32) - 32 - x)", {"low": 0, "high": 10, "cells": 10}, [5], 1),
        # One double of the cell lies outside of [low + i width, low + (i + 1) width] by rounding.
        (
            "where(x == 4.931865599999997, 4.9318675999999995, 4.931865999999999)",
            FINE,
            [9914832],
            0,
        ),
        ("where(x < 4.9, 4.9318675999999995, 4.931865999999999)", FINE, [9914832], 1),
        ("4.931866 + 0.1*(x - 4.931866)", FINE, [9914832], 1),
    ],
)
def test_a_proof_is_of_every_state_and_of_the_map_as_computed(text, axis, cells, proved):
    problem = made(held(text, axis, cells))
    found = examine(problem, local_of(problem))
    assert found.proved == proved
    if proved == found.cells:
        assert found.kept == found.samples
    assert "proved to be kept (by the map as computed)" in found.sentence()


def states_at(partition, cell, rng):
    """States of a cell: inside, and up to the last double at its edges and across the seam."""
    low, high, _ = partition.domain(np.array([cell]))
    rows = []
    for a, b in zip(low, high, strict=True):
        share = rng.choice([0.0, 1e-9, 1e-6, 1 - 1e-6, 1 - 1e-9, 1.0, np.nan], (400, len(a)))
        share = np.where(np.isnan(share), rng.random(share.shape), share)
        x = a + share * (b - a)
        for _ in range(4):
            x = np.where(rng.random(x.shape) < 0.5, np.nextafter(x, rng.choice([-9.0, 9.0])), x)
        rows.append(x)
    x = partition.states(np.concatenate(rows))
    return x[partition.locate(list(x.T)) == cell]


def random_held(rng):
    """A map that keeps A, or nearly, on an axis that makes that hard to tell."""
    low = float(rng.choice([0.0, -1.0, 3.3, -np.pi, 1e5]))
    span = float(rng.choice([1.0, 2 * np.pi, 8.0, 1e-3]))
    n = int(rng.choice([3, 10, 1000, 10**6]))
    n = n if span / n > 1e-12 * (abs(low) + span) else 10
    kind = rng.choice(["interval", "circle", "clip"])
    width = span / n
    cell = int(rng.choice([0, n // 2, n - 1]))
    middle = low + (cell + 0.5) * width
    spread = float(rng.choice([0.3, 0.9, 0.99, 0.999999, 1.0, 1.000001]))
    turns = int(rng.choice([0, 0, 1, -3, 1000])) if kind == "circle" else 0
    away = f"(x - {middle!r})"
    if kind == "circle":  # the part near `high` of the first cell
        away = f"where(x - {middle!r} > {span / 2!r}, x - {middle!r} - {span!r}, x - {middle!r})"
    text = f"{middle + turns * span!r} + {spread!r}*{away}"
    bend = rng.random()
    if bend < 0.3:
        big = float(rng.choice([32.0, 1e6, 2.0**40]))
        size = float(width / (big * 2.0**-52) * rng.choice([0.01, 0.3, 1.0]))
        text += f" + {size!r}*(((x + {big!r}) - {big!r}) - x)"
    elif bend < 0.5:
        text += f" + {float(width) * 0.3!r}*sin({1 / width!r}*{away})"
    axis = {"low": low, "high": low + span, "cells": n, "periodic": kind == "circle"}
    return held(text, axis, [cell], on_exit="clip" if kind == "clip" else "forbid"), cell


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_no_state_of_a_proved_cell_leaves(seed):
    rng = np.random.default_rng(seed)
    proved = broken = 0
    for _ in range(1000 if seed else 300):
        data, cell = random_held(rng)
        problem = made(data)
        local = local_of(problem)
        found = examine(problem, local, samples=10)
        x = states_at(local.partition, cell, rng)
        images = problem.step()({"x": x[:, 0]})
        stays = (local.partition.locate(images) == cell).all()
        assert not (found.proved and not stays), data
        proved += found.proved
        broken += not stays
    assert min(proved, broken) > 0.2 * (1000 if seed else 300)


def test_the_law_is_enclosed_as_it_is_computed():
    data = standard_map(20, local_controller={"kind": "lqr", "orbit": ORBIT})
    data["state_box"]["x"].update(low=-0.5, high=0.5)
    data["attractor"] = {"cells": [[0, 9], [0, 10], [19, 10], [5, 10]]}
    data["local_controller"]["orbit"] = [{"x": -0.25, "y": 0.5}, {"x": 0.25, "y": 0.5}]
    data["attractor"]["cells"] += [[4, 9], [4, 10], [14, 10], [15, 9], [15, 10]]
    problem = made(data)
    local = local_of(problem)
    cells = np.flatnonzero(local.attractor)
    low, high, owner = local.partition.domain(cells)
    rng = np.random.default_rng(0)
    box = Interval(low, high)
    jets = [Jet.variable(Interval(low[:, i], high[:, i]), i, 2) for i in range(2)]

    def on_jets(operation, *operands):
        return apply(operation, [x if isinstance(x, Jet) else Jet.constant(x, 2) for x in operands])

    (law,) = local.law(jets, cells[owner], on_jets)
    assert np.isfinite(law.value.low).all()
    for _ in range(300):
        x = low + rng.random(low.shape) * (high - low)
        u = local(x, cells[owner])[:, 0]
        assert ((u >= law.value.low) & (u <= law.value.high)).all()
    assert box.low.shape == (len(cells) + 2, 2)  # two of the cells lie at the seam


def test_all_of_the_declared_noise_is_enclosed():
    """x+ = x/2 + w on A = [-1, 1], 20 cells: kept while |w| <= 1 - |x|/2, nodes or not."""

    def kept(noise):
        problem = made({
            "format": "lmdsl/1",
            "system": {"kind": "map", "next": {"x": "0.5*x + w + 0*u"}},
            "state_box": {"x": {"low": -2, "high": 2, "cells": 40}},
            "attractor": {"boxes": [{"x": [-1, 1]}]},
            "control_grid": {"u": {"values": [0]}},
            "noise": {"w": noise},
            "stage_cost": "1",
            "sampling": {"kind": "grid", "per_axis": 1},
            "local_controller": {"kind": "constant", "control": {"u": 0}},
        })  # fmt: skip
        found = lm.solve(problem).local_controller
        return found.proved, found.kept == found.samples

    assert kept({"uniform": {"low": -0.49, "high": 0.49, "points": 1}}) == (20, True)
    # The only node is 0, and keeps all; the ends keep cells with |x| < 0.6 alone: 12 of them.
    assert kept({"uniform": {"low": -0.69, "high": 0.69, "points": 1}}) == (12, True)
    assert kept({"uniform": {"low": -0.69, "high": 0.69, "points": 8}})[0] == 12
    assert kept({"normal": {"std": 0.23, "points": 1}}) == (20, True)
    assert kept({"normal": {"std": 0.23, "points": 1, "within": 2.0}}) == (20, True)
    assert kept({"normal": {"std": 0.23, "points": 1, "within": 3.0}}) == (12, True)
    assert kept({"normal": {"std": 0.23, "points": 3, "within": 3.0}})[0] == 12
    wide = kept({"normal": {"std": 0.4, "points": 3, "within": 0.1}})  # nodes at 0.69 count still
    assert wide[0] == 12


def test_states_of_cells_that_a_law_keeps_for_ever_never_leave_them():
    """A square about rest under linear feedback: its corners leave it, an inner part never does."""
    problem = made({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": "x + 0.3*y + w", "y": "y + 0.3*u"}},
        "state_box": {name: {"low": -1, "high": 1, "cells": 40} for name in "xy"},
        "attractor": {"boxes": [{"x": [-0.5, 0.5], "y": [-0.5, 0.5]}]},
        "control_grid": {"u": {"low": -2, "high": 2, "points": 3}},
        "noise": {"w": {"uniform": {"low": -0.01, "high": 0.01, "points": 2}}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        "local_controller": {"kind": "linear", "orbit": [[0, 0]],
                             "gain": {"u": {"x": 1.2, "y": 1.8}}},
    })  # fmt: skip
    partition = Partition.of(problem)
    attractor = CellSets.of(problem, partition).attractor
    law = LocalController.of(problem, partition, attractor)
    inside = keeping(problem, law)
    report = examine(problem, law)
    assert 0 < inside.sum() < report.proved < attractor.sum()  # others are kept for a step only
    rng, true_map = np.random.default_rng(2), TrueMap(problem, partition)
    cell = np.repeat(np.flatnonzero(inside), 4)
    place = np.stack(partition.multi_index(cell), axis=-1)
    x = partition.low + (place + rng.choice([0, 0.5, 1, 1e-12], place.shape)) * partition.width
    x, cell = partition.enter(x)
    x, cell = x[inside[cell]], cell[inside[cell]]
    for _ in range(100):
        u = law(x, cell)
        noise = [rng.choice([-0.01, 0.01], len(x))]
        x, cell = true_map.step(true_map.named(list(x.T), list(u.T), noise))
        assert inside[cell].all()

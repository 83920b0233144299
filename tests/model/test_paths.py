"""Steps judged on the way: thin obstacles, the first event, costs until A is entered."""

import json
import math

import numpy as np
import pytest
from random_problems import attempt

import lmdsl as lm
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus

DRIVE = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "derivative": {"x": "u"}, "step": 1.0},
    "state_box": {"x": {"low": 0, "high": 20, "cells": 20}},
    "attractor": {"cells": [[0]]},
    "control_grid": {"u": {"values": [-5]}},
    "stage_cost": "1",
    "sampling": {"kind": "grid", "per_axis": 1},
}


def drive(judged="path", **more):
    data = json.loads(json.dumps({**DRIVE, **more}))
    data["system"]["judged"] = judged
    return data


def ends(data, cell, control=0):
    problem = lm.Problem(**data)
    sampler = Sampler(problem, Partition.of(problem))
    block = Block(0, np.array([cell]), (control, control + 1))
    return sampler.outcomes(block)[0].ravel(), sampler.places(block).ravel()


# what is judged ---------------------------------------------------------------------------------


def test_a_thin_obstacle_is_not_jumped():
    sets = {"attractor": {"boxes": [{"x": [0, 5]}]}, "avoid": {"boxes": [{"x": [9, 10]}]}}
    seen = lm.solve(lm.Problem(**drive(**sets)))
    jumped = lm.solve(lm.Problem(**drive("endpoint", **sets)))
    assert jumped.cell_status[11] == CellStatus.STABILIZED
    assert all(seen.cell_status[10:15] == CellStatus.ESCAPES)
    assert all(seen.cell_status[15:20] >= CellStatus.ESCAPES)
    assert all(seen.cell_status[5:9] == CellStatus.STABILIZED)


def test_what_is_entered_on_the_way_is_entered():
    """From x = 3.5 the image -1.5 is outside; the attractor lies before it."""
    cell, place = ends(drive(), 3)
    assert cell == [0]
    assert 0 <= place[0] < 1
    assert np.isnan(ends(drive("endpoint"), 3)[0])


@pytest.mark.parametrize(("wall", "reached"), [([1, 2], False), ([7, 8], True)])
def test_the_first_event_decides(wall, reached):
    data = drive(attractor={"cells": [[4]]}, avoid={"boxes": [{"x": wall}]})
    data["control_grid"] = {"u": {"values": [-6]}}
    cell, _ = ends(data, 6)
    assert cell == [4 if reached or wall == [1, 2] else np.nan]
    data["attractor"], data["avoid"] = {"cells": [[1]]}, {"boxes": [{"x": [3, 4]}]}
    assert ends(data, 6)[0] == [3]  # avoid comes first


def test_the_start_is_not_judged():
    data = drive(avoid={"boxes": [{"x": [9, 10]}]}, control_grid={"u": {"values": [5]}})
    data["attractor"] = {"cells": [[19]]}
    cell, _ = ends(data, 9)  # begins in avoid
    assert cell == [14]


def test_under_clip_the_box_is_judged_at_the_end_alone():
    """A turn that swings out of the box and comes back."""
    turn = {
        "format": "lmdsl/1",
        "system": {
            "kind": "ode", "derivative": {"x": "-y", "y": "x"}, "step": math.pi, "substeps": 16,
        },
        "state_box": {
            "x": {"low": -1, "high": 1, "cells": 20}, "y": {"low": -1, "high": 0.5, "cells": 15},
        },
        "attractor": {"cells": [[0, 0]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
    }  # fmt: skip
    cell = 15 * 18 + 10  # x = 0.85, y = 0.05: on the way y is 0.85
    assert np.isnan(ends(turn, cell)[0])
    clipped, place = ends({**turn, "on_exit": "clip"}, cell)
    assert place == pytest.approx([-0.85, -0.05], abs=1e-4)
    assert clipped == [15 * 1 + 9]
    wall = {"avoid": {"boxes": [{"x": [-0.2, 0.2], "y": [0.4, 0.5]}]}}
    outside = ends({**turn, **wall, "on_exit": "clip"}, cell)[0]
    assert outside == clipped  # beyond the wall, and not moved to it


def test_circles_are_crossed():
    data = drive(attractor={"cells": [[18]]}, control_grid={"u": {"values": [-5]}})
    data["state_box"]["x"]["periodic"] = True
    cell, place = ends(data, 1)
    assert cell == [18]
    assert -2 < place[0] < -1  # not wrapped


def test_maps_have_no_path():
    with pytest.raises(lm.BadInput, match="judged"):
        lm.Problem(**drive(system={"kind": "map", "next": {"x": "x - 1"}}))


@pytest.mark.parametrize("seed", range(60))
def test_what_is_skipped_is_free(seed):
    """Places that cannot matter are not looked at: the answer is that of looking at all.

    So is that of looking at a few samples at a time.
    """
    data = attempt(np.random.default_rng(seed))
    if data["system"]["kind"] != "ode" or data["system"].get("judged") == "endpoint":
        return
    problem = lm.Problem(**data)
    sampler = Sampler(problem, Partition.of(problem))
    block = Block(0, np.arange(sampler.partition.size), (0, len(sampler.controls)))
    values = sampler.values(block)
    fast = sampler.images(block, values)
    costs, places = sampler.costs(block, values), sampler.places(block)
    sampler._entries.path.ground.room[:] = 0
    assert np.array_equal(sampler.images(block, values), fast, equal_nan=True)
    sampler._entries.path.most = 7
    assert np.array_equal(sampler.images(block, values), fast, equal_nan=True)
    assert np.array_equal(sampler.places(block), places, equal_nan=True)
    assert np.array_equal(sampler.costs(block, values), costs, equal_nan=True)


# what it costs ----------------------------------------------------------------------------------


def decay(**more):
    """x' = -x from the middle of a cell, judged on a fine grid."""
    data = {
        **DRIVE,
        "system": {"kind": "ode", "derivative": {"x": "-x"}, "step": 1.0, "substeps": 8},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 1000}},
        "attractor": {"boxes": [{"x": [0, 0.5]}]},
        "control_grid": {},
        "cost_rate": "x**2",
        **more,
    }
    data.pop("stage_cost")
    return lm.Problem(**data)


def test_a_rate_is_integrated_until_the_attractor():
    lp = lm.compile(decay())
    x = lp.partition.centres(lp.cells)[:, 0]
    # The whole step goes from x to x/e; the attractor begins at 1/2, found to within a part.
    until = (x**2 - 0.5**2) / 2
    assert np.all(lp.cost >= until - 1e-9)
    assert np.all(lp.cost <= until + 0.5**2 / 500 + 1e-9)
    whole = lm.compile(decay(system={**decay().system.model_dump(), "judged": "endpoint"}))
    assert whole.cost == pytest.approx((1 - math.exp(-2)) / 2 * x**2, rel=1e-5)


def test_a_rate_that_is_negative_on_the_way_is_refused():
    with pytest.raises(lm.BadInput, match=r"cost_rate: the cost rate is -0\.\d+ at x = "):
        lm.compile(decay(cost_rate="x - 0.6", attractor={"boxes": [{"x": [0, 0.4]}]}))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"stage_cost": "1", "cost_rate": "1"}, "cost_rate: stage_cost is given as well"),
        ({"stage_cost": None}, "stage_cost"),
        ({"terminal_cost": "u"}, "terminal_cost: .*'u' is a control, which has no value here"),
        ({"terminal_cost": "x - 19"}, "terminal_cost: the terminal cost is -"),
    ],
)
def test_costs_that_are_refused(more, words):
    data = {key: value for key, value in {**drive(), **more}.items() if value is not None}
    with pytest.raises(lm.BadInput, match=words):
        lm.compile(lm.Problem(**data))


def test_a_negative_cost_is_refused_whatever_else_is_paid():
    """Neither a stage cost nor a terminal cost makes up for a negative part."""
    for judged in ("path", "endpoint"):
        with pytest.raises(lm.BadInput, match="terminal_cost: the terminal cost is -"):
            lm.compile(lm.Problem(**drive(judged, stage_cost="1000", terminal_cost="x - 19")))
    box = {"boxes": [{"x": [0, 0.4]}]}
    with pytest.raises(lm.BadInput, match="cost_rate: the cost rate is -"):
        lm.compile(decay(cost_rate="x - 0.6", attractor=box, terminal_cost="1000"))


def test_a_map_has_no_rate():
    data = drive(cost_rate="1")
    del data["stage_cost"]
    data["system"] = {"kind": "map", "next": {"x": "x - 1"}}
    with pytest.raises(lm.BadInput, match="cost_rate: a map has no time between its steps"):
        lm.Problem(**data)


@pytest.mark.parametrize("gamma", [0.9, 1.0, 1.05])
def test_a_terminal_cost_is_paid_on_entering(gamma):
    data = drive("endpoint", terminal_cost="3 + x", gamma=gamma)
    data["system"] = {"kind": "map", "next": {"x": "x - 1"}}
    lp = lm.compile(lm.Problem(**data))
    assert lp.cost[0] == pytest.approx(1 + gamma * 3.5)
    assert lp.cost[1:] == pytest.approx(1.0)
    result = lm.solve(lp)
    assert result.value[2] == pytest.approx(1 + gamma + gamma**2 * 3.5)
    assert result.value[0] == 0


def test_a_terminal_cost_that_is_one_step_more():
    """A terminal cost of V on a larger attractor gives the values of the smaller one."""
    data = drive("endpoint", gamma=1.02)
    data["system"] = {"kind": "map", "next": {"x": "x - 1"}}
    small = lm.solve(lm.Problem(**data))
    steps = "floor(x)"
    data["attractor"] = {"boxes": [{"x": [0, 6]}]}
    data["terminal_cost"] = f"(1.02**({steps}) - 1)/0.02"
    large = lm.solve(lm.Problem(**data))
    assert large.value[6:] == pytest.approx(small.value[6:], rel=1e-12)


def riccati(cells):
    """Relative error of the mean cost of a scalar linear-quadratic problem with its own tail."""
    a, b, q, r = 1.2, 1.0, 1.0, 2.0
    p = 1.0
    for _ in range(200):
        p = q + a * a * p - (a * b * p) ** 2 / (r + b * b * p)
    data = {
        **DRIVE,
        "system": {"kind": "map", "next": {"x": f"{a}*x + {b}*u"}},
        "state_box": {"x": {"low": -1, "high": 1, "cells": cells}},
        "attractor": {"boxes": [{"x": [-0.1, 0.1]}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 2 * cells + 1}},
        "stage_cost": f"{q}*x**2 + {r}*u**2",
        "terminal_cost": f"{p!r}*x**2",
        "sampling": {"kind": "grid", "per_axis": 4},
    }
    result = lm.solve(lm.Problem(**data))
    assert result.certificate.verified
    x = result.partition.centres(np.arange(cells))[:, 0]
    outside = result.cell_status == CellStatus.STABILIZED
    width = 2 / cells
    mean = p * (x[outside] ** 2 + width**2 / 12)
    return abs(result.value[outside].sum() / mean.sum() - 1)


def test_a_quadratic_tail_comes_near_riccati():
    errors = [riccati(cells) for cells in (160, 320, 640)]
    assert errors[0] < 0.01
    assert errors[0] > errors[1] > errors[2]

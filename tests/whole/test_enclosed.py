"""Enclosed successors on published problems: no run is lost, and more cells are sure.

The other side is what symbolic tools do, written here in plain NumPy: the centre of a cell is
integrated, a growth bound is put around it, and the cells that this box meets are all reached
(edges are met by both cells: those tools leave it to rounding which).
"""

import numpy as np
import pytest
from problems import made
from test_corners import SMALL, WALLS, lost_and_reached, maze, slope

import lmdsl as lm

PLANNING = [(1.0, 1.2, 0.0, 9.0), (2.2, 2.4, 0.0, 5.0), (2.2, 2.4, 6.0, 10.0)]


def winning(data, status):
    """Return the cells outside A that a growth bound wins, as the car of G. Reissig et al. does."""
    boxes = list(data["state_box"].values())
    low, high = (np.array([box[end] for box in boxes]) for end in ("low", "high"))
    cells = np.array([box["cells"] for box in boxes])
    width, shape = (high - low) / cells, tuple(cells)
    centre = [low[k] + (np.arange(n) + 0.5) * width[k] for k, n in enumerate(cells)]
    mesh = np.stack([x.ravel() for x in np.meshgrid(*centre, indexing="ij")])
    target, unsafe = (status == 0).reshape(shape), (status == 5).reshape(shape)
    posts = []
    for v in np.linspace(*(data["control_grid"]["v"][key] for key in ("low", "high", "points"))):
        for s in np.linspace(
            *(data["control_grid"]["s"][key] for key in ("low", "high", "points"))
        ):
            x, h = mesh.ravel(), 0.3
            k1 = slope(0, x, v, s)
            k2 = slope(0, x + h / 2 * k1, v, s)
            k3 = slope(0, x + h / 2 * k2, v, s)
            k4 = slope(0, x + h * k3, v, s)
            end = (x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).reshape(3, -1)
            growth = abs(v) * np.sqrt(np.tan(s) ** 2 / 4 + 1) * h * width[2] / 2
            radius = (width / 2 + [growth, growth, 0.0])[:, None] * (1 + 1e-9)
            a, b = ((end + sign * radius - low[:, None]) / width[:, None] for sign in (-1, 1))
            out = ((a <= 0) | (b >= cells[:, None])).any(axis=0)
            ends = (np.clip(np.floor(x), 0, cells[:, None] - 1).astype(int) for x in (a, b))
            posts.append((*ends, out))
    return surely(posts, target, unsafe, cells)


def surely(posts, target, unsafe, cells):
    """Return the cells outside A from which A is reached, by what cells may meet; flat."""
    won, shape = target.copy(), target.shape
    while True:
        sums = np.zeros(cells + 1, dtype=int)
        sums[1:, 1:, 1:] = (~won).cumsum(0).cumsum(1).cumsum(2)
        new = won.copy()
        for first, last, out in posts:
            total = 0
            for corner in np.ndindex(2, 2, 2):
                at = [last[k] + 1 if c else first[k] for k, c in enumerate(corner)]
                total = total + (-1) ** (3 - sum(corner)) * sums[tuple(at)]
            new |= ((total == 0) & ~out).reshape(shape) & ~unsafe
        if (new == won).all():
            return (won & ~target).ravel()
        won = new


def enclosed(data, judged):
    return lm.solve(made({**data, "system": {**data["system"], "judged": judged},
                          "successors": "enclosed"}))  # fmt: skip


@pytest.mark.parametrize("judged", ["endpoint", pytest.param("path", marks=pytest.mark.long)])
def test_a_small_maze(judged):
    data = maze(*SMALL, per_axis=1, corners=False, controls=5)
    result = enclosed(data, judged)
    assert result.verified
    assert result.claims["safe"]
    assert result.simulate(10_000, 300, as_compiled=True).lost == 0
    if judged == "path":  # of the equation itself, by SciPy alone
        lost, reached = lost_and_reached(data, result, 100, 80)
        assert lost == 0
        assert reached > 80
    else:
        won = winning(data, result.cell_status)
        assert won.sum() > 500
        assert not (won & (result.sure_levels <= 0)).any()


@pytest.mark.long
@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "sure", "kept"), [("maze", 48_018, 53_000), ("planning", 19_563, 19_563)]
)
def test_published_problems(name, sure, kept):
    """As many cells as the winning sets of SCOTS on the same grids (48,018 and 19,563)."""
    if name == "maze":
        data = maze(10.0, WALLS, {"x": [9, 9.5], "y": [0, 0.5]}, 2, False)
    else:
        data = maze(10.0, PLANNING, {"x": [3, 3.6], "y": [0.3, 0.8]}, 2, False)
        data["state_box"]["x"] = {"low": 0.1, "high": 3.9, "cells": 19}
        data["state_box"]["y"] = {"low": 0.1, "high": 9.9, "cells": 49}
    result = enclosed(data, "endpoint")
    assert result.verified
    assert result.claims["safe"]
    assert result.sure_cells >= sure
    assert result.stabilizable_cells >= kept
    won = winning(data, result.cell_status)
    assert not (won & (result.sure_levels <= 0)).any()
    runs = result.simulate(100_000, 1_000, as_compiled=True)
    assert runs.lost == 0
    assert runs.reached > 99_000
    print(f"{name}: C {result.stabilizable_cells}, sure {result.sure_cells}, won {won.sum()}")


@pytest.mark.parametrize(
    ("cells", "kill", "runs"),
    [
        (80, 0.01, 20_000),
        pytest.param(799, 0.01, 100_000, marks=[pytest.mark.long, pytest.mark.full]),
    ],
)
def test_safety_of_the_boost_converter(cells, kill, runs):
    """The published safety of a DC-DC converter, killed at random; also on coarser cells."""
    linear = {
        1: ("0.9917012926388759*i + 0.16597414722248083", "0.9929178767321044*v"),
        2: ("0.9902950292942829*i - 0.032892318823717294*v + 0.16587291875265632",
            "0.03524177016826852*i + 0.992333178469695*v + 0.0029450833173848515"),
    }  # fmt: skip
    i, v = (f"where(mode == 1, {linear[1][k]}, {linear[2][k]})" for k in range(2))
    result = lm.solve(made({
        "format": "lmdsl/1",
        "let": {"j": i},
        "system": {"kind": "map", "next": {
            "i": f"where(kill == 1, {1.15 - 0.2 / cells!r}, where(j < 1.15, 99, j))",
            "v": f"where(kill == 1, 5.65, {v})"}},
        "state_box": {"i": {"low": 1.15 - 0.4 / cells, "high": 1.55, "cells": cells + 1},
                      "v": {"low": 5.45, "high": 5.85, "cells": cells}},
        "attractor": {"boxes": [{"i": [1.15 - 0.4 / cells, 1.15]}]},
        "control_grid": {"mode": {"values": [1, 2]}},
        "noise": {"kill": {"values": [0, 1], "weights": [1 - kill, kill]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        "successors": "enclosed",
    }))  # fmt: skip
    assert result.verified
    assert result.claims["safe"]
    assert result.sure_cells == 0  # nothing but chance ends a run
    assert result.simulate(runs, 3_000, as_compiled=True).lost == 0


# An aircraft that lands, as published with SCOTS ----------------------------------------------

AIRCRAFT = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "parameters": {"mg": 588600.0, "mi": 1.6666666666666667e-05},
               "derivative": {
                   "V": "mi*(T*cos(al) - (2.7 + 3.08*(1.25 + 4.2*al)**2)*V**2 - mg*sin(g))",
                   "g": "(1/(60000*V))*(T*sin(al) + 68.6*(1.25 + 4.2*al)*V**2 - mg*cos(g))",
                   "h": "V*sin(g)"},
               "step": 0.25, "substeps": 1, "judged": "endpoint"},
    "state_box": {"V": {"low": 58, "high": 83, "cells": 91},
                  "g": {"low": -0.05235987755982989, "high": 0, "cells": 33},
                  "h": {"low": 0, "high": 56, "cells": 84}},
    "attractor": {"where": "V >= 63 and V <= 75 and h <= 2.5 and V*sin(g) >= -0.91"},
    "control_grid": {"T": {"values": [0, 32000]},
                     "al": {"low": 0, "high": 0.13744467859455345, "points": 8}},
    "stage_cost": "0.25",
    "sampling": {"kind": "grid", "per_axis": 2},
    "successors": "enclosed",
}  # fmt: skip


def landing(low, high):
    """The cells low..high-1 of the published grid, on each axis."""
    box = {}
    for (name, axis), a, b in zip(AIRCRAFT["state_box"].items(), low, high, strict=True):
        width = (axis["high"] - axis["low"]) / axis["cells"]
        ends = [axis["low"] + a * width, axis["low"] + b * width]
        box[name] = {"low": ends[0], "high": ends[1], "cells": b - a}
    return {**AIRCRAFT, "state_box": box}


def won_by_growth(data, status):
    """The published growth bound, its matrix for every control."""
    boxes = list(data["state_box"].values())
    low, high = (np.array([box[end] for box in boxes]) for end in ("low", "high"))
    cells = np.array([box["cells"] for box in boxes])
    width, shape = (high - low) / cells, tuple(cells)
    centre = [low[k] + (np.arange(n) + 0.5) * width[k] for k, n in enumerate(cells)]
    mesh = np.stack([x.ravel() for x in np.meshgrid(*centre, indexing="ij")])
    posts, (mg, mi) = [], AIRCRAFT["system"]["parameters"].values()
    for T, al in np.ndindex(2, 8):
        T, al = 32_000 * T, al * 0.13744467859455345 / 7
        lift, drag = 68.6 * (1.25 + 4.2 * al), 2.7 + 3.08 * (1.25 + 4.2 * al) ** 2
        L = np.array([[-0.00191 * drag, 9.81, 0], [0.002933 + 0.004802 * al, 0.003623, 0],
                      [0.07483, 83.22, 0]])  # fmt: skip

        def rate(x, T=T, al=al, lift=lift, drag=drag):
            V, g, _ = x
            return np.array([
                mi * (T * np.cos(al) - drag * V**2 - mg * np.sin(g)),
                (T * np.sin(al) + lift * V**2 - mg * np.cos(g)) / (60_000 * V),
                V * np.sin(g),
            ])  # fmt: skip

        end, radius = stepped(rate, mesh), stepped(lambda r, L=L: L @ r, width / 2)[:, None]
        a, b = ((end + sign * radius - low[:, None]) / width[:, None] for sign in (-1, 1))
        first, last = np.floor(a + 1e-9), np.ceil(b - 1e-9) - 1
        out = ((first < 0) | (last >= cells[:, None])).any(axis=0)
        ends = (np.clip(x, 0, cells[:, None] - 1).astype(int) for x in (first, last))
        posts.append((*ends, out))
    target, unsafe = (status == 0).reshape(shape), (status == 5).reshape(shape)
    return surely(posts, target, unsafe, cells)


def stepped(rate, x, h=0.25):
    """A step of the classical Runge-Kutta method."""
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@pytest.mark.parametrize(
    "part",
    [
        ((17, 20, 0), (62, 33, 8)),
        pytest.param(((0, 0, 0), (91, 33, 84)), marks=[pytest.mark.long, pytest.mark.full]),
    ],
)
def test_an_aircraft_lands_from_where_a_growth_bound_lands_it(part):
    data = landing(*part)
    result = lm.solve(made(data))
    assert result.verified
    assert result.claims["safe"]
    won = won_by_growth(data, result.cell_status)
    assert won.sum() > 100
    assert not (won & (result.sure_levels <= 0)).any()
    runs = result.simulate(100_000, 1_000, as_compiled=True)
    assert (runs.lost, runs.reached) == (0, 100_000)
    print(f"sure {result.sure_cells}, growth bound {won.sum()}")


def won_by_corners(partition, target, controls):
    """The most cells that can be won: of each, all corners are, a millionth inside of it."""
    rate = made(AIRCRAFT).step().field
    side = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    x = partition.centres(np.arange(partition.size))[:, None] + (1 - 1e-6) * side * partition.width
    x = np.moveaxis(x, -1, 0)
    images = []
    for T, al in controls:
        end = stepped(
            lambda x, u=(T, al): np.array(
                rate(dict(zip(("V", "g", "h", "T", "al"), (*x, *u), strict=True)))
            ),
            x,
        )
        images.append(partition.locate(list(end)))
    won = np.append(target, False)  # the last: outside
    while True:
        more = won.copy()
        for image in images:
            more[:-1] |= won[image].all(axis=-1)
        if (more == won).all():
            return won[:-1] & ~target
        won = more


@pytest.mark.parametrize(
    "part",
    [
        ((17, 20, 0), (62, 33, 8)),
        pytest.param(((0, 0, 0), (91, 33, 84)), marks=[pytest.mark.long, pytest.mark.full]),
    ],
)
def test_no_other_cell_can_surely_be_won(part):
    """Of every other one a corner loses under each control. (SCOTS is recorded with 169 cells.)"""
    lp = lm.compile(made(landing(*part)))
    won = won_by_corners(lp.partition, lp.cell_status == 0, lp.controls)
    np.testing.assert_array_equal(won, lp.sure_levels > 0)


@pytest.mark.long
@pytest.mark.full
def test_an_aircraft_lands_along_its_path():
    data = landing((0, 0, 0), (91, 33, 84))
    result = lm.solve(made({**data, "system": {**data["system"], "judged": "path"}}))
    assert result.verified
    assert result.simulate(100_000, 1_000, as_compiled=True).lost == 0

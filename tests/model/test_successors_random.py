"""Enclosed successors of random problems: no covered image of any state of C is lost.

Every function of the language, circles and their seams, noise at its ends, jumps, poles, far turns,
images on edges, tiny and huge units. An image or a point of a path is judged by plain evaluation.
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import lmdsl as lm
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import counting
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import parse_problem

pytestmark = pytest.mark.long  # in other versions it would find nothing else

ONE = (
    "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt",
    "abs", "sign", "floor", "ceil",
)  # fmt: skip
NAMES = ("x", "y", "u", "w")


def formulas():
    leaf = st.one_of(
        st.sampled_from(NAMES), st.floats(-2, 2).map(lambda v: repr(round(v, 2)))
    )  # fmt: skip

    def grown(inner):
        return st.one_of(
            st.tuples(st.sampled_from(ONE), inner).map(lambda t: f"{t[0]}({t[1]})"),
            st.tuples(st.sampled_from(("min", "max", "atan2", "mod")), inner, inner).map(
                lambda t: f"{t[0]}({t[1]}, {t[2]})"
            ),
            st.tuples(inner, st.sampled_from("+-*/"), inner).map(
                lambda t: f"(({t[0]}) {t[1]} ({t[2]}))"
            ),
            st.tuples(inner, st.sampled_from(("2", "3", "0.5", "-1"))).map(
                lambda t: f"({t[0]})**{t[1]}"
            ),
            st.tuples(inner, st.sampled_from(("<", "<=", ">", "==")), inner, inner, inner).map(
                lambda t: f"where(({t[0]}) {t[1]} ({t[2]}), {t[3]}, {t[4]})"
            ),
        )

    return st.recursive(leaf, grown, max_leaves=5)


@st.composite
def problems(draw):
    unit = draw(st.sampled_from((1.0, 1.0, 1.0, 1e-9, 1e9, 1e-300, 1e150)))
    axes = {}
    for name in "xy":
        low = draw(st.sampled_from((-1.0, 0.0, -1.3, 1000.0)))
        high = low + draw(st.sampled_from((1.0, 2.0, 1.7)))
        cells = draw(st.integers(1, 8))
        periodic = draw(st.booleans())
        axes[name] = {"low": low * unit, "high": high * unit, "cells": cells, "periodic": periodic}
    axis = axes["y"]
    step = (axis["high"] - axis["low"]) / axis["cells"]
    moved = st.sampled_from(("2*x", f"x + {step!r}", "-x", "x*1e5", "x + 1e6", "0.5*x"))
    some = st.tuples(st.sampled_from((0.3, 0.6)), st.sampled_from((0.1, 0.4)), formulas()).map(
        lambda t: f"{t[0]}*x + {t[1] * unit!r}*({t[2]})"
    )
    nexts = {"x": draw(some | moved), "y": f"0.5*y + {0.2 * unit!r}*({draw(formulas())})"}
    noise = draw(
        st.sampled_from((
            {"values": [-0.1, 0.0, 0.3], "weights": [0.2, 0.8, 0.0]},
            {"uniform": {"low": -0.2, "high": 0.1, "points": 2}},
            {"normal": {"std": 0.05, "points": 2, "within": 3}},
        ))
    )  # fmt: skip
    half = (axis["low"] + axis["high"]) / 2
    data = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": nexts},
        "state_box": axes,
        "attractor": {"cells": [[0, draw(st.integers(0, axis["cells"] - 1))]]},
        "control_grid": {"u": {"values": draw(st.sampled_from(([0.0], [-0.3, 0.2, 0.25])))}},
        "noise": {"w": noise},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": draw(st.integers(1, 2)), "corners": True},
        "successors": "enclosed",
        "on_exit": draw(st.sampled_from(("forbid", "clip"))),
    }
    if draw(st.booleans()) and axis["cells"] > 1:
        data["attractor"] = {"boxes": [{"y": [half, axis["high"]]}]}
    return data


def states_of(partition, cell, count, rng):
    """Return states located in a cell, many at its edges and at seams."""
    index = np.array([int(k[0]) for k in partition.multi_index(np.array([cell]))])
    offsets = rng.random((count, len(index)))
    special = np.array([0.0, 1.0, 0.9e-9, -0.9e-9, 1 - 1.1e-9, -1e-9, 1 - 1e-9, 0.5])
    chosen = rng.random(offsets.shape) < 0.5
    offsets[chosen] = rng.choice(special, size=int(chosen.sum()))
    x = partition.low + (index + offsets) * partition.width
    seam = partition.periodic & (index == 0) & (rng.random(offsets.shape) < 0.3)
    ends = np.where(
        rng.random(offsets.shape) < 0.5, partition.high, np.nextafter(partition.high, -np.inf)
    )
    states, located = partition.enter(np.where(seam, ends, x))
    return states[located == cell]


def covered(noise, count, rng):
    """Return noise that enclosures cover, often at its ends."""
    values, weights = noise.nodes()
    drawn = rng.choice(values[weights > 0], size=count)
    if hasattr(noise, "values"):
        return drawn
    if hasattr(noise, "uniform"):
        ends = (noise.uniform.low, noise.uniform.high)
    else:
        ends = (-noise.normal.within * noise.normal.std, noise.normal.within * noise.normal.std)
    chosen = rng.random(count)
    drawn = np.where(chosen < 0.4, rng.uniform(*ends, count), drawn)
    return np.where(chosen > 0.7, rng.choice(ends, size=count), drawn)


@settings(
    max_examples=60, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)  # fmt: skip
@given(data=problems())
def test_no_covered_image_of_a_state_of_c_is_lost(data):
    try:
        problem = parse_problem(data)
        lp = lm.compile(problem)
    except lm.BadInput:  # a constant part is not a number, no cell of the attractor
        assume(False)
    partition, rng = lp.partition, np.random.default_rng(0)
    sets, true_map = CellSets.of(problem, partition), TrueMap(problem, partition)
    allowed, sure = sets.attractor.copy(), lp.sure_levels
    allowed[lp.cells] = True
    best = {}
    for pair in range(len(lp.control)):
        cell = int(lp.cells[lp.cell[pair]])
        x = states_of(partition, cell, 25, rng)
        u = np.repeat(lp.controls[[lp.control[pair]]], len(x), axis=0)
        w = [covered(noise, len(x), rng) for noise in problem.noise.values()]
        _, reached = partition.enter(true_map.images(x, u, w))
        assert (reached >= 0).all(), (x[reached < 0], u[0])
        assert allowed[reached].all(), (x[~allowed[reached]], u[0])
        worst = np.where(sure[reached] < 0, np.inf, sure[reached]).max(initial=0)
        best[cell] = min(best.get(cell, np.inf), worst)
    for cell, level in best.items():
        assert sure[cell] < 0 or level < sure[cell]  # some control leads to lower levels only
    if lp.n:
        result = lm.solve(lp)
        assert result.certificate.safe is not False


def test_sums_over_many_circles_heed_the_limit():
    """On d circles they have 2^d entries for each cell: tables can be far larger than the model."""
    names = "abcdfghi"
    problem = parse_problem({
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {name: f"0.5*{name}" for name in names}},
        "state_box": {n: {"low": -1, "high": 1, "cells": 2, "periodic": True} for n in names},
        "attractor": {"cells": [[0] * len(names)]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "random", "points": 1},
        "successors": "enclosed",
    })  # fmt: skip
    partition, calls = Partition.of(problem), []
    cells = np.arange(partition.size) % 3 == 0
    found = counting.table(cells, partition, lambda: calls.append(1))
    assert len(calls) == partition.dimension
    assert found.sums[-1] == 2**partition.dimension * cells.sum()
    with pytest.raises(TimeLimitReached):
        counting.table(cells, partition, lambda: Deadline(0.0).raise_if_over("here"))

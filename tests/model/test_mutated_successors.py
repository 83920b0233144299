"""Enclosures with something left out: what is compiled then loses runs, and is not confirmed.

Each mutation is blind in both places, where pairs survive and where claim 7 is judged, so that the
result calls itself verified; ``verify``, which has its sight again, refuses it.
"""

from __future__ import annotations

import numpy as np
import pytest
from problems import made

import lmdsl as lm
from lmdsl.formulas import enclosures, intervals
from lmdsl.formulas.enclosures import Jet
from lmdsl.model.discretization import noise_parts
from lmdsl.model.successors import domains, enclosing
from lmdsl.model.successors.compiled.stretches import CompiledEncloser


def declared(text, cells=8, attractor=0, avoid=(), circle=False, **more):
    """x+ = text on [0, cells], cells of width 1; no control; one sample a cell."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": {"low": 0, "high": cells, "cells": cells, "periodic": circle}},
        "attractor": {"cells": [[attractor]]},
        "avoid": {"boxes": [{"x": [a, a + 1]} for a in avoid]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        "successors": "enclosed",
        **more,
    }


def without_the_seam(patch):
    made_of = domains._domain

    def blind(*given):
        domain = made_of(*given)
        if domain.circle:  # the other side of the seam is this side again
            domain.low[-1], domain.high[-1] = domain.low[0], domain.high[0]
        return domain

    patch.setattr(domains, "_domain", blind)


def without_edges(patch):
    patch.setattr(domains, "_firsts", lambda axis, index: axis.low + index * axis.width)


def noise_at_its_nodes(patch):
    def middles(problem):
        least, most = noise_parts(problem)
        return (least + most) / 2, (least + most) / 2

    patch.setattr(enclosing, "noise_parts", middles)


def ends_only(patch):
    stretches = CompiledEncloser.stretches

    def last(encloser, *given):
        yield [*stretches(encloser, *given)][-1]

    patch.setattr(CompiledEncloser, "stretches", last)
    patch.setattr(enclosing.Encloser, "path", lambda *_: iter(()))


def exact_arithmetic(patch):
    """Nothing is rounded outward, nor added to the mean value form for what rounds."""
    patch.setattr(CompiledEncloser, "of", lambda encloser, path: None)
    patch.setattr(intervals, "_widened", lambda low, high, *_: intervals.Interval(low, high))

    def blind(box, centre, away):
        return enclosures.enclosure(Jet(box.value, box.slope, 0.0), centre, away)

    patch.setattr(enclosing, "enclosure", blind)


# x + 1e-9 w is where the next cell begins, and (high - 1e-9 w, high] belongs to the first.
CASES = {
    "seam": (
        without_the_seam,
        declared("where(x > 7.9999999995, 4.5, 2.5)", attractor=2, avoid=[4], circle=True),
        0,
    ),
    "edge": (
        without_edges,
        declared("where(x >= 5, 2.5, where(x > 4.9999999, 6.5, 2.5))", attractor=2, avoid=[6]),
        5,
    ),
    "noise": (
        noise_at_its_nodes,
        declared("2.5 + w", attractor=2, avoid=[3],
                 noise={"w": {"uniform": {"low": -0.4, "high": 0.6, "points": 2}}}),
        5,
    ),
    "path": (  # the middles of cells move straight past the wall, what is beside them bulges
        ends_only,
        declared(
            "", attractor=None, system={
                "kind": "ode", "derivative": {"x": "-4", "y": "y - 1.5"}, "step": 1.0},
            state_box={"x": {"low": 0, "high": 8, "cells": 8},
                       "y": {"low": 0, "high": 4, "cells": 4}},
        ) | {"attractor": {"boxes": [{"x": [0, 3]}]},
             "avoid": {"boxes": [{"x": [3, 4], "y": [2, 3]}]}},
        5 * 4 + 1,
    ),
    "rounding": (  # the sum with 2^52 rounds to whole numbers, what is above 5.4 upwards
        exact_arithmetic,
        declared("where(abs(x - 5.5) < 0.6, 1.9 + 0.5*((x + 0.1 + 4503599627370496) - "
                 "4503599627370501), 2.5)", attractor=2, avoid=[1]),
        5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_is_left_out_is_missed(name, tmp_path):
    mutate, data, cell = CASES[name]
    problem = made(data)
    whole = lm.compile(problem)
    assert cell not in whole.cells
    with pytest.MonkeyPatch.context() as patch:
        mutate(patch)
        blind = lm.solve(problem)
        assert cell in blind.lp.cells
        assert blind.verified
        assert blind.claims["safe"] is True
        blind.save(tmp_path / "out")
        assert lm.verify(tmp_path / "out").holds
    found = lm.verify(tmp_path / "out")
    assert not found.holds
    assert not found.same_model
    assert any("cell_status differs" in reason for reason in found.reasons)


@pytest.mark.parametrize("name", CASES)
def test_the_judge_alone_sees_it(name):
    """A policy that uses what was kept blindly is not safe: claim 7 knows nothing of compiling."""
    mutate, data, cell = CASES[name]
    with pytest.MonkeyPatch.context() as patch:
        mutate(patch)
        blind = lm.compile(made(data))
    result = lm.solve(blind)
    assert not result.verified
    assert result.claims["safe"] is False
    assert np.isin(cell, blind.cells)

"""To reach a set and stay there, declared at once and proved: a published converter, a pendulum.

Not one run of the map as compiled is lost, all arrive, and none leaves again.
"""

from __future__ import annotations

import pytest
from problems import made

import lmdsl as lm


def converter(cells):
    """A boost converter, whose published regulation keeps (i, v) in [1.1, 1.6] x [5.4, 5.9]."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {
            "i": "where(mode == 1, 0.99170129263887596*i + 0.16597414722248083, "
                 "0.99029502942829728*i - 0.032892318823717293*v + 0.16587291875265633)",
            "v": "where(mode == 1, 0.99291787673210441*v, 0.035241770168268523*i + "
                 "0.99233317846969549*v + 0.0029450833173848517)"}},
        "state_box": {"i": {"low": 0.65, "high": 1.65, "cells": cells},
                      "v": {"low": 4.95, "high": 5.95, "cells": cells}},
        "attractor": {"boxes": [{"i": [1.1, 1.6], "v": [5.4, 5.9]}]},
        "control_grid": {"mode": {"values": [1, 2]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        "successors": "enclosed",
        "local_controller": {"kind": "hold"},
    }  # fmt: skip


def pendulum(cells, **system):
    """A pendulum that is swung up, and held about the top; of the documentation."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "inverted_pendulum", "parameters": {"m": 1, "l": 1, "g": 9.81, "d": 0.1},
                   "step": 0.1, **system},
        "state_box": {
            "theta": {"low": -3.141592653589793, "high": 3.141592653589793, "cells": cells,
                      "periodic": True},
            "omega": {"low": -9, "high": 9, "cells": cells}},
        "attractor": {"boxes": [{"theta": [-0.5, 0.5], "omega": [-1.2, 1.2]}]},
        "control_grid": {"u": {"low": -3, "high": 3, "points": 9}},
        "stage_cost": "1 - cos(theta) + 0.02*omega**2 + 0.01*u**2",
        "sampling": {"kind": "grid", "per_axis": 2},
        "successors": "enclosed",
        "local_controller": {"kind": "hold"},
    }  # fmt: skip


def reached_and_held(data, runs, share):
    result = lm.solve(made(data))
    assert result.verified
    assert result.claims["safe"] is True
    assert result.coverage.share > share
    report = result.local_controller
    assert report.proved == report.holding == report.cells > 0
    found = result.simulate(runs, 1_000, as_compiled=True, hold=100)
    assert (found.lost, found.cycling) == (0, 0)
    assert found.reached == found.held.stayed == runs
    return result


def test_a_boost_converter():
    reached_and_held(converter(150), 2_000, 0.88)


def test_a_pendulum():
    reached_and_held(pendulum(112, judged="endpoint", substeps=1), 2_000, 0.5)


@pytest.mark.long
@pytest.mark.full
@pytest.mark.parametrize("cells", [400, 1_000])
def test_a_boost_converter_at_length(cells):
    result = reached_and_held(converter(cells), 100_000, 0.93)
    assert result.sure_cells == result.stabilizable_cells
    proof = result.prove(0.99)
    assert proof.arrives > 0.99
    assert proof.lost == proof.stays == 0
    assert proof.holds is True


@pytest.mark.long
@pytest.mark.full
def test_a_pendulum_along_its_path():
    result = reached_and_held(pendulum(128), 100_000, 0.93)
    assert result.sure_cells == result.stabilizable_cells

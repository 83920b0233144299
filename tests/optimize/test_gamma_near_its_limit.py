"""Solving near gamma_bar and beyond it: few policies, proved refusals, the corner that limits."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from brackets import check_vectors, integrator
from corners import corner
from models import random_lp
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.optimize.feasibility import (
    gamma_bar,
    spectral_radius,
    stopping,
)


@pytest.mark.parametrize(("cells", "g"), [(30, 2.2), (50, 2.4), (50, 2.5001), (50, 5), (50, 1e6)])
def test_gamma_near_and_far_beyond_its_limit(cells, g):
    result = lm.solve(made(standard_map(cells, gamma=g)))
    limits = gamma_bar.bracket(lm.compile(made(standard_map(cells))))
    assert not limits.low <= g <= limits.high
    expected = "verified" if g < limits.low else "not_stabilizable"
    assert result.status == expected, result.message


def test_long_ways_take_few_policies(monkeypatch):
    """Howard's iteration on the vectors of the classes, not hundreds of stopping policies."""
    lp, calls = lm.compile(made(integrator(60))), []
    for module, name in ((spectral_radius, "of_policy"), (stopping, "_stopped")):
        inner = getattr(module, name)

        def counted(*args, inner=inner):
            calls.append(inner)
            return inner(*args)

        monkeypatch.setattr(module, name, counted)
    found = gamma_bar.bracket(lp)
    assert found.high <= found.low * (1 + 1e-6)
    assert len(calls) < 90
    calls.clear()
    below = lm.solve(replace(lp, gamma=found.low * (1 - 1e-4)))
    assert below.status == "verified", below.message
    for far in (found.high * (1 + 1e-4), 5.0):
        above = lm.solve(replace(lp, gamma=far))
        assert above.status == "not_stabilizable", above.message
        assert above.gamma_bar[1] <= above.gamma_bar[0] * (1 + 1e-6)
    assert len(calls) < 300
    check_vectors(lp, found)


@pytest.mark.parametrize("seed", range(10))
def test_improving_a_policy_never_lowers_its_limit(seed):
    lp = random_lp(np.random.default_rng(seed), cells=8, controls=4, absorb=0.3)
    if not lp.n:
        return
    first = spectral_radius.of_policy(lp, lp.tree[1])
    better = spectral_radius.improved(lp, first)
    assert better.limit >= first.limit * (1 - 1e-12)
    proved = spectral_radius.prove_low(lp, better)
    assert proved is not None
    assert proved[0] <= better.limit * (1 + 1e-12)


def test_solve_just_below_and_above():
    found = lm.gamma_max(made(standard_map(10)))
    below = lm.solve(made(standard_map(10, gamma=found.low * (1 - 1e-2))))
    assert below.status == "verified", below.message
    above = lm.solve(made(standard_map(10, gamma=found.high * (1 + 1e-4))))
    assert above.status == "not_stabilizable"
    low, high = above.gamma_bar
    assert low == pytest.approx(found.low, rel=1e-6)
    assert high == pytest.approx(found.high, rel=1e-6)


def test_command_line(tmp_path, capsys):
    file = tmp_path / "p.json"
    file.write_text(json.dumps(steps()))
    assert main(["gamma-max", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "gamma_bar": ["inf", "inf"], "stabilizable_cells": 3, "limiting": None, "beyond": None,
        "note": "",
    }  # fmt: skip
    file.write_text(json.dumps(doubling()))
    assert main(["gamma-max", str(file)]) == 0
    assert "gamma_bar lies in" in capsys.readouterr().out
    file.write_text(json.dumps(steps(avoid={"boxes": [{"x": [0.25, 0.5]}]})))
    assert main(["gamma-max", str(file), "--json"]) == 3
    assert json.loads(capsys.readouterr().out) == {
        "gamma_bar": None, "stabilizable_cells": 0, "limiting": None, "beyond": None,
        "note": "no cell is stabilizable",
    }  # fmt: skip
    assert main(["gamma-max", str(file)]) == 3
    assert capsys.readouterr().out == "no cell is stabilizable, so there is no gamma_bar\n"


def test_no_cell_is_not_a_bad_input():
    found = lm.gamma_max(made(steps(avoid={"boxes": [{"x": [0.25, 0.5]}]})))
    assert found.low == found.high == found.stabilizable == 0
    assert len(found.policy) == 0
    assert found.to_dict()["gamma_bar"] is None


def test_one_hard_corner_can_be_left_out(tmp_path):
    problem = made(corner(2.5))
    assert lm.solve(problem).status == "not_stabilizable"
    result = lm.solve(problem, restrict_to_gamma=True)
    assert result.status == "verified", result.message
    assert result.cell_status.tolist() == [0, 1, 1, 6, 1, 6]
    g = 2.5
    np.testing.assert_allclose(result.value[[1, 2, 4]], [1, 1 + g, 2 + g * (1 + g)])
    assert result.control_index.tolist()[4] == 1
    assert np.isinf(result.value[[3, 5]]).all()
    assert (result.witness[[3, 5]] > 0).all()
    result.save(tmp_path / "out")
    assert lm.verify(tmp_path / "out").holds
    assert lm.verify(tmp_path / "out", exact=True).holds
    # Negative control: a cell wrongly left out is not proved infeasible.
    with np.load(tmp_path / "out" / "solution.npz") as stored:
        arrays = dict(stored)
    arrays["cell_status"][4] = 6
    np.savez(tmp_path / "out" / "solution.npz", **arrays)
    assert not lm.verify(tmp_path / "out").holds
    feasible = lm.solve(made(corner(1.5)), restrict_to_gamma=True)
    assert feasible.cell_status.tolist() == [0, 1, 1, 1, 1, 1]


CORNER_TEXT = """gamma_bar lies in [1.99999999..., 2.0000000...]
  limited by 1 of 5 stabilizable cells: 1 in x in [3, 4]
  with those that cannot avoid them 2 cells: 1 in x in [3, 4]; 1 in x in [5, 6]
  this corner limits gamma_bar for all; --restrict-to-gamma (restrict_to_gamma=True) solves on the \
cells for which gamma is feasible"""


def test_the_hard_corner_is_named(tmp_path, capsys):
    found = lm.gamma_max(made(corner(1.0)))
    assert re.fullmatch(re.escape(CORNER_TEXT).replace(r"\.\.\.", r"\d*"), found.text())
    assert found.limiting.cells.tolist() == [3]
    assert found.beyond.cells.tolist() == [3, 5]
    assert found.corner
    file = tmp_path / "corner.json"
    file.write_text(json.dumps(corner(1.0)))
    assert main(["gamma-max", str(file), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    box = {"cells": 1, "regions": [{"box": {"x": [3.0, 4.0]}, "cells": 1}], "elsewhere": 0}
    assert data["limiting"] == box
    assert data["beyond"]["cells"] == 2
    assert main(["solve", str(file), "--gamma", "2.5", "--out", str(tmp_path / "out")]) == 3
    said = capsys.readouterr().out
    assert "gamma = 2.5 is not below gamma_bar, which lies in [2, 2]" in said
    assert (
        "no control makes the cost finite from 2 cells (1 in x in [3, 4]; 1 in x in [5, 6]); "
        "gamma_bar is limited by 1 cell (1 in x in [3, 4]); this corner limits gamma_bar for all; "
        "lower gamma, or solve on the other 3 cells with --restrict-to-gamma"
    ) in said
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.beyond_gamma.cells.tolist() == [3, 5]
    assert loaded.to_dict()["beyond_gamma"] == data["beyond"]
    stored = json.loads((tmp_path / "out" / "certificate.json").read_text())
    assert stored["beyond_gamma"] == data["beyond"]
    kept = lm.solve(made(corner(2.5)), restrict_to_gamma=True)
    assert kept.to_dict()["beyond_gamma"] == data["beyond"]
    assert lm.solve(made(corner(1.5))).to_dict()["beyond_gamma"] is None


def test_all_cells_are_no_corner():
    found = lm.gamma_max(made(doubling()))
    assert not found.corner
    assert "corner" not in found.text()
    refused = lm.solve(made(doubling(3)))
    assert "corner" not in refused.message
    assert refused.message.endswith("; lower gamma")


def test_restriction_leaves_nothing():
    assert lm.solve(made(doubling(3)), restrict_to_gamma=True).status == "not_stabilizable"

"""The bracket of gamma_bar: closed forms, enumeration, reducible structures, the graph test."""

from __future__ import annotations

import json

import numpy as np
import pytest
from models import brute_force, build, random_lp
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl import gamma
from lmdsl.bounds import exactly_below
from lmdsl.cli import main
from lmdsl.gamma import check_high, check_low
from lmdsl.rows import Rows, Shares
from lmdsl.sampling import Nodes


def chain(stays: list[int], samples: int = 10) -> lm.StabilizationLP:
    """Classes of two cells that swap with probability stay/samples, else go to the next class.

    gamma_bar = samples / max(stays): the spectral radius of a class is stay/samples.
    """
    shares = Shares.of(samples, Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64)))
    n = 2 * len(stays)
    rows = []
    for c, stay in enumerate(stays):
        for own in (0, 1):
            below = n if c == 0 else 2 * (c - 1)
            rows.append({2 * c + 1 - own: stay, below: samples - stay})
    pointer = np.cumsum([0] + [len(r) for r in rows]).astype(np.int64)
    compact = Rows(
        pointer,
        np.array([j for r in rows for j in r], dtype=np.int32),
        np.array([v - 1 for r in rows for v in r.values()], dtype=np.uint8),
        shares,
        n,
    )
    ones = np.ones(n)
    return build(np.arange(n + 1, dtype=np.int64), np.zeros(n, dtype=np.int32), compact, ones, 1.0)


@pytest.mark.parametrize(
    ("stays", "true"),
    [
        ([9], 10 / 9),
        ([9, 3], 10 / 9),
        ([3, 9], 10 / 9),
        ([9, 9], 10 / 9),
        ([9] * 6, 10 / 9),
        ([5, 9, 1, 9, 5], 10 / 9),
        ([1, 1, 1], 10),
    ],
)
def test_reducible_structures_close_the_bracket(stays, true):
    lp = chain(stays)
    found = gamma.bracket(lp)
    assert found.low <= true * (1 + 1e-15)
    assert found.high >= true * (1 - 1e-15)
    assert found.high <= found.low * (1 + 1e-6)
    assert found.note == ""
    _check_vectors(lp, found)


def _check_vectors(lp, found):
    """Both ends in exact arithmetic."""
    from dataclasses import replace
    from fractions import Fraction

    at = replace(lp, gamma=found.high)
    assert all(exactly_below(at, k, found.w_high, found.high, None) for k in range(lp.K))
    assert (found.w_high >= 0).all()
    assert found.w_high.any()
    w = [Fraction(float(x)) for x in found.w_low]
    for i, k in enumerate(found.pair):
        row = lp.rows.exact(int(k))
        ahead = sum(w[j] * s for j, s in row if j < lp.n) / lp.rows.shares.total
        assert Fraction(found.low) * ahead <= w[i]


def test_doubling_map():
    found = lm.gamma_max(made(doubling()))
    assert found.low <= 2 <= found.high
    assert found.high - found.low < 1e-12


def test_infinite_exactly_when_the_levels_exhaust():
    found = lm.gamma_max(made(steps()))
    assert found.low == found.high == np.inf
    lp = lm.compile(made(steps()))
    assert lp.control[found.pair].tolist() == [1, 1, 1]
    # With one control that can only stay with probability 1/2, the graph test fails.
    data = steps()
    data["system"]["next"] = {"x": "where(x < 0.75, x - 0.25*u, x - 0.25*u*w)"}
    data["noise"] = {"w": {"values": [0, 1], "weights": [0.5, 0.5]}}
    found = lm.gamma_max(made(data))
    assert found.low <= 2 <= found.high <= found.low * (1 + 1e-6)


@pytest.mark.parametrize("seed", range(60))
def test_against_all_policies(seed):
    lp = random_lp(np.random.default_rng(seed), cells=5, controls=3, absorb=0.4)
    if not lp.n:
        return
    _, rho = brute_force(lp)
    found = gamma.bracket(lp)
    if np.isinf(found.low):
        assert rho < 1e-4  # a nilpotent matrix; eigenvalues of one are not exactly 0 in doubles
        return
    assert found.low <= (1 + 1e-9) / rho
    assert found.high >= (1 - 1e-9) / rho
    assert found.high <= found.low * (1 + 1e-6)
    _check_vectors(lp, found)


def test_spoiled_vectors_are_refused():
    lp = chain([9, 5])
    found = gamma.bracket(lp)
    for value in (0.0, -1.0, np.nan, np.inf):
        w = found.w_low.copy()
        w[0] = value
        assert check_low(lp, found.pair, w) is None
    assert check_high(lp, np.zeros(lp.n)) is None
    assert check_high(lp, -found.w_high) is None
    w = found.w_high.copy()
    w[int(np.argmax(w))] *= 2
    assert check_high(lp, w) > found.high * 1.5


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
    assert json.loads(capsys.readouterr().out) == {"gamma_bar": ["inf", "inf"]}
    file.write_text(json.dumps(doubling()))
    assert main(["gamma-max", str(file)]) == 0
    assert "gamma_bar lies in" in capsys.readouterr().out
    file.write_text(json.dumps(steps(avoid={"boxes": [{"x": [0.25, 0.5]}]})))
    assert main(["gamma-max", str(file), "--json"]) == 3
    assert json.loads(capsys.readouterr().out) == {"gamma_bar": None}


def corner(gamma_value: float) -> dict:
    """Six cells: 1 and 2 reach A = cell 0 surely; 3 escapes itself with probability 1/2 a step.

    4 chooses between going through 3 and going to 2 for a higher price; 5 must go through 3.
    gamma_bar = 2, and only 3 and 5 limit it.
    """
    half = "where(w > 0, x, x - 1)"
    formula = f"where(x < 3, x - 1, where(x < 4, {half}, where(x < 5, x - 1 - u, x - 2)))"
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": formula}},
        "state_box": {"x": {"low": 0, "high": 6, "cells": 6}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0, 1]}},
        "noise": {"w": {"values": [-1, 1], "weights": [0.5, 0.5]}},
        "stage_cost": "1 + u",
        "sampling": {"kind": "grid", "per_axis": 1},
        "gamma": gamma_value,
    }


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


def test_restriction_leaves_nothing():
    assert lm.solve(made(doubling(3)), restrict_to_gamma=True).status == "not_stabilizable"

"""The bracket of gamma_bar: closed forms, enumeration, reducible structures, the graph test."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from corners import corner
from models import brute_force, build, dense, mdp, random_lp
from problems import doubling, made, standard_map, steps
from scipy.sparse.linalg import eigs

import lmdsl as lm
from lmdsl.certificate.bounds import exactly_below
from lmdsl.cli import main
from lmdsl.common import types
from lmdsl.model.discretization import Nodes
from lmdsl.model.grid.directions import Directions
from lmdsl.model.rows import Rows, Shares
from lmdsl.optimize.feasibility import (
    gamma_bar,
    perron,
    slowest_growth,
    spectral_radius,
    stopping,
)
from lmdsl.optimize.feasibility.infeasible import check_high
from lmdsl.optimize.feasibility.spectral_radius import check_low
from lmdsl.optimize.linear import classes, equations


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
        ([9] * 30, 10 / 9),
        ([9, 5] * 15, 10 / 9),
        ([9] * 80, 10 / 9),
    ],
)
def test_reducible_structures_close_the_bracket(stays, true):
    lp = chain(stays)
    found = gamma_bar.bracket(lp)
    assert found.low <= true * (1 + 1e-15)
    assert found.high >= true * (1 - 1e-15)
    assert found.high <= found.low * (1 + 1e-6)
    assert found.note == ""
    _check_vectors(lp, found)


def loops(n: int, stay: int = 9, samples: int = 10) -> lm.StabilizationLP:
    """Cells in series that stay with probability stay/samples, a little more under control 1."""
    cells = []
    for i in range(n):
        choices = [({i: k, i - 1: samples - k}, 1.0) for k in {stay, min(stay + 1, samples - 1)}]
        cells.append(choices)
    return mdp(cells, samples, 1.0)


@pytest.mark.parametrize("n", [1, 3, 40, 90])
def test_equal_slow_classes_in_series(n):
    """The vector of low grows over up to 500 decades; high needs no growth at all."""
    lp = loops(n, 90, 100)
    found = gamma_bar.bracket(lp)
    assert found.low <= 100 / 90 <= found.high * (1 + 1e-15)
    assert found.high <= found.low * (1 + 1e-6)
    assert found.note == ""
    assert lp.control[found.policy].tolist() == [0] * n
    assert len(found.limiting) == len(found.beyond) == n
    assert n < 40 or found.w_low.max() > 1e200 * found.w_low.min()
    _check_vectors(lp, found)


@pytest.mark.parametrize(("n", "up", "down"), [(100, 5, 90), (150, 1, 20), (60, 40, 59)])
def test_one_class_whose_vectors_fall_over_many_decades(n, up, down):
    """A walk up and down a line; rho of the tridiagonal matrix, up to the wall at the top."""
    cells = []
    for i in range(n):
        above, stay = (i + 1, 100 - up - down) if i + 1 < n else (i, 0)
        row = {above: up + (100 - up - down if i + 1 == n else 0), i - 1: down}
        cells.append([({**row, **({i: stay} if stay else {})}, 1.0)])
    lp = mdp(cells, 100, 1.0)
    found = gamma_bar.bracket(lp)
    assert found.high <= found.low * (1 + 1e-6)
    P = dense(lp)
    scale = (up / down) ** (np.arange(n) / 2)  # makes all but the last row symmetric
    rho = np.linalg.eigvals(scale[:, None] * P / scale).real.max()
    assert found.low * (1 - 1e-9) <= 1 / rho <= found.high * (1 + 1e-9)
    _check_vectors(lp, found)


def test_a_bracket_that_doubles_cannot_close_says_so():
    found = gamma_bar.bracket(loops(300, 90, 100))
    assert found.low <= 100 / 90 <= found.high
    assert 1e-6 < found.high / found.low - 1 < 1e-2
    assert "leave the range of doubles" in found.note
    assert found.note in found.text()
    _check_vectors(loops(300, 90, 100), found)


@pytest.mark.parametrize("g", [1.11, 1.1111, 100 / 90, 1.2])
def test_solve_around_the_limit_of_a_long_chain(g):
    """Never a false yes: it is verified, or says that the numbers do not allow it, or refuses."""
    result = lm.solve(replace(loops(40, 90, 100), gamma=g))
    if Fraction(g) < Fraction(10, 9):
        assert result.status in ("verified", "unverified")
    else:  # the double nearest to 10/9 is larger than 10/9
        assert result.status == "not_stabilizable"
        assert result.gamma_bar[1] <= result.gamma_bar[0] * (1 + 1e-6)


def test_ended_early():
    found = gamma_bar.bracket(chain([9, 5]), stop=lambda: True)
    assert found.low <= 10 / 9
    assert found.high == np.inf
    assert found.note == "the work was ended before the bracket closed"
    assert found.limiting is found.beyond is None


def _check_vectors(lp, found):
    """Both ends in exact arithmetic, and that the cells named are those of the vectors."""
    at = replace(lp, gamma=found.high)
    assert all(exactly_below(at, k, found.w_high, found.high, None) for k in range(lp.K))
    assert (found.w_high >= 0).all()
    assert found.w_high.any()
    np.testing.assert_array_equal(found.beyond.cells, lp.cells[found.w_high > 0])
    assert set(found.limiting.cells) <= set(found.beyond.cells)
    assert len(found.limiting) > 0
    w = [Fraction(float(x)) for x in found.w_low]
    for i, k in enumerate(found.policy):
        row = lp.rows.exact(int(k))
        ahead = sum(w[j] * s for j, s in row if j < lp.n) / lp.rows.shares.total
        assert Fraction(found.low) * ahead <= w[i]


@pytest.mark.parametrize("width", [1e-8, 1e-2, 0.5])
def test_the_width_asked_for(width):
    for made_lp in (chain([9, 5]), lm.compile(made(standard_map(20)))):
        found = lm.gamma_max(made_lp, width=width)
        assert found.high <= found.low * (1 + width)
        assert found.note == ""
        exact = gamma_bar.bracket(made_lp)
        assert found.low <= exact.high
        assert found.high >= exact.low
        _check_vectors(made_lp, found)


@pytest.mark.parametrize("width", [0, -1.0, 1e-9, 2, np.nan, "1", True, None])
def test_a_width_that_is_none(width):
    with pytest.raises(lm.BadInput, match="width"):
        lm.gamma_max(made(doubling()), width=width)


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_the_rate_of_a_large_class_needs_no_factors(shift, monkeypatch):
    """A walk with jumps: 1,500 cells in one class, which sparse factors would fill."""
    rng = np.random.default_rng(3)
    n = equations.KRYLOV + 500
    target = np.concatenate([(np.arange(n) + 1) % n, rng.integers(0, n, 3 * n)])
    weight = rng.random(4 * n) + shift
    M = sp.csr_array((weight, (np.tile(np.arange(n), 4), target)), (n, n))
    M = sp.csr_array(M / (1.1 * M.sum(axis=1).max()))
    monkeypatch.setattr(classes, "solve_by_class", None)
    x, rate, least = perron._perron(M, types.never, 0.0, Directions.line(n))
    assert (x > 0).all()
    assert least <= rate <= least * (1 + 1e-9)
    assert rate == pytest.approx(abs(eigs(M, k=1, return_eigenvectors=False)[0]), rel=1e-9)
    early = perron._perron(M, types.never, 2 * rate, Directions.line(n))
    assert rate < early[1] < 2 * rate


@pytest.mark.parametrize(("cells", "g"), [(30, 2.2), (50, 2.4), (50, 2.5001), (50, 5), (50, 1e6)])
def test_gamma_near_and_far_beyond_its_limit(cells, g):
    result = lm.solve(made(standard_map(cells, gamma=g)))
    limits = gamma_bar.bracket(lm.compile(made(standard_map(cells))))
    assert not limits.low <= g <= limits.high
    expected = "verified" if g < limits.low else "not_stabilizable"
    assert result.status == expected, result.message


def integrator(cells: int, gamma_value: float = 1.0) -> dict:
    """A double integrator at a short step: transport over many cells, vectors over many decades."""
    return {
        "system": {"kind": "double_integrator", "parameters": {"h": 2.4 / cells}},
        "state_box": {
            "x": {"low": -2, "high": 2, "cells": cells},
            "v": {"low": -1.5, "high": 1.5, "cells": cells * 3 // 4},
        },
        "attractor": {"points": [{"x": 0, "v": 0}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 5}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 4},
        "on_exit": "clip",
        "gamma": gamma_value,
    }


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
    _check_vectors(lp, found)


@pytest.mark.parametrize("seed", range(10))
def test_improving_a_policy_never_lowers_its_limit(seed):
    lp = random_lp(np.random.default_rng(seed), cells=8, controls=4, absorb=0.3)
    if not lp.n:
        return
    first = spectral_radius.of_policy(lp, lp.tree[1])
    better = slowest_growth.improved(lp, first)
    assert better.limit >= first.limit * (1 - 1e-12)
    proved = spectral_radius.prove_low(lp, better)
    assert proved is not None
    assert proved[0] <= better.limit * (1 + 1e-12)


def test_ended_anywhere_it_keeps_what_is_proved():
    lp = lm.compile(made(integrator(40)))
    whole = gamma_bar.bracket(lp)
    for most in range(0, 300, 23):
        left = iter(range(most))
        found = gamma_bar.bracket(lp, stop=lambda left=left: next(left, None) is None)
        assert found.low <= whole.high
        assert found.high >= whole.low


def test_doubling_map():
    found = lm.gamma_max(made(doubling()))
    assert found.low <= 2 <= found.high
    assert found.high - found.low < 1e-12


def test_infinite_exactly_when_the_levels_exhaust():
    found = lm.gamma_max(made(steps()))
    assert found.low == found.high == np.inf
    lp = lm.compile(made(steps()))
    assert lp.control[found.policy].tolist() == [1, 1, 1]
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
    found = gamma_bar.bracket(lp)
    if np.isinf(found.low):
        assert rho < 1e-4  # a nilpotent matrix; eigenvalues of one are not exactly 0 in doubles
        return
    assert found.low <= (1 + 1e-9) / rho
    assert found.high >= (1 - 1e-9) / rho
    assert found.high <= found.low * (1 + 1e-6)
    _check_vectors(lp, found)


def test_spoiled_vectors_are_refused():
    lp = chain([9, 5])
    found = gamma_bar.bracket(lp)
    for value in (0.0, -1.0, np.nan, np.inf):
        w = found.w_low.copy()
        w[0] = value
        assert check_low(lp, found.policy, w) is None
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

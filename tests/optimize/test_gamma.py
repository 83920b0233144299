"""The bracket of gamma_bar: closed forms, enumeration, reducible structures, the graph test."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from brackets import check_vectors, integrator
from models import brute_force, build, dense, mdp, random_lp
from problems import doubling, made, standard_map, steps
from scipy.sparse.linalg import eigs

import lmdsl as lm
from lmdsl.common import types
from lmdsl.model.discretization import Nodes
from lmdsl.model.grid.directions import Directions
from lmdsl.model.rows import Rows, Shares
from lmdsl.optimize.feasibility import (
    gamma_bar,
    perron,
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
    check_vectors(lp, found)


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
    check_vectors(lp, found)


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
    check_vectors(lp, found)


def test_a_bracket_that_doubles_cannot_close_says_so():
    found = gamma_bar.bracket(loops(300, 90, 100))
    assert found.low <= 100 / 90 <= found.high
    assert 1e-6 < found.high / found.low - 1 < 1e-2
    assert "leave the range of doubles" in found.note
    assert found.note in found.text()
    check_vectors(loops(300, 90, 100), found)


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
    found = gamma_bar.bracket(chain([9, 5]), time_up=lambda: True)
    assert found.low <= 10 / 9
    assert found.high == np.inf
    assert found.note == "the work was ended before the bracket closed"
    assert found.limiting is found.beyond is None


@pytest.mark.parametrize("width", [1e-8, 1e-2, 0.5])
def test_the_width_asked_for(width):
    for made_lp in (chain([9, 5]), lm.compile(made(standard_map(20)))):
        found = lm.gamma_max(made_lp, width=width)
        assert found.high <= found.low * (1 + width)
        assert found.note == ""
        exact = gamma_bar.bracket(made_lp)
        assert found.low <= exact.high
        assert found.high >= exact.low
        check_vectors(made_lp, found)


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


def test_ended_anywhere_it_keeps_what_is_proved():
    lp = lm.compile(made(integrator(40)))
    whole = gamma_bar.bracket(lp)
    for most in range(0, 300, 23):
        left = iter(range(most))
        found = gamma_bar.bracket(lp, time_up=lambda left=left: next(left, None) is None)
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
    check_vectors(lp, found)


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

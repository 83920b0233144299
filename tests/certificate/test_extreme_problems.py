"""Problems with numbers from the smallest double to the largest: solved without a false word."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from extremes import LARGEST, Model, numbers
from models import build
from problems import made
from truth import truly

import lmdsl as lm
from lmdsl.certificate import sums
from lmdsl.certificate.claims import Witness
from lmdsl.certificate.judge import exact_verdict, verdict
from lmdsl.model import stabilizable_set
from lmdsl.model.discretization import Nodes
from lmdsl.model.rows import Rows, Shares
from lmdsl.optimize.feasibility import first_policy, spectral_radius
from lmdsl.results.result import CostFrom

# What makes the witnesses ---------------------------------------------------------------------


def stabilizable(seed):
    """Return a random model of such numbers, None where it is not all stabilizable."""
    model = Model(np.random.default_rng(seed))
    found = stabilizable_set.stabilizable(model.lp.pair_pointer, model.lp.rows)
    return model if found.inside.all() and found.surviving.all() else None


def made_witness(seed):
    """Solve a model; what is verified is true, the rest says why not."""
    model = stabilizable(seed)
    if model is None:
        return None
    lp = model.lp
    result = lm.solve(lp)
    json.dumps(result.to_dict(), allow_nan=False)
    if result.verified:
        on = lp.cells
        pair = np.array([lp.column(k, result.control_index[k]) for k in on])
        witness = Witness(pair, *(x[on] for x in vectors_of(result)))
        choice = (pair - lp.pair_pointer[:-1]).tolist()
        truth = truly(model.model, model.gamma, lp.weight, choice, witness, 1)
        assert all(truth.values()), (seed, truth)
    else:
        assert result.message
    return result.status


def vectors_of(result):
    return result.witness, result.value, result.lower, result.measure


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_solving_ends_without_a_false_word():
    met = [made_witness(seed) for seed in range(60)]
    assert met.count("verified") > 10, met
    assert met.count("not_stabilizable") > 2, met


@pytest.mark.long
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_solving_ends_at_length():
    for seed in range(100, 300):
        made_witness(seed)


@pytest.mark.long
def test_a_gamma_out_of_sight_is_decided_soon(monkeypatch):
    """From 1 up to 1e300 by exponents: bisection of the numbers took a thousand proofs a policy."""
    asked = []
    proof = first_policy.stability_vector

    def counted(*args, **more):
        asked.append(1)
        return proof(*args, **more)

    monkeypatch.setattr(first_policy, "stability_vector", counted)
    for gamma in (1e17, 1e300, LARGEST):
        for model in filter(None, map(stabilizable, range(40))):
            before = len(asked)
            first_policy.stabilizing(replace(model.lp, gamma=gamma))
            assert len(asked) - before < 2000
    assert len(asked) > 100


def test_a_limit_beyond_the_doubles_is_not_called_infinite():
    """One cell stays with probability about 5e-324: its limit is above the largest double."""
    weights = np.array([1.0, 5e-324])
    shares = Shares.of(1, Nodes(np.zeros((2, 1)), weights, np.arange(2)))
    rows = Rows(np.array([0, 2]), np.array([1, 0], np.int32), np.array([0, 1], np.uint8), shares, 1)
    lp = build(np.array([0, 1]), np.zeros(1, np.int32), rows, np.ones(1), 1.0)
    low = spectral_radius.check_low(lp, np.array([0]), np.ones(1))
    assert low == pytest.approx(LARGEST)
    assert low < np.inf
    free = replace(lp, rows=replace(rows, target=np.array([1, 1], np.int32)))
    assert spectral_radius.check_low(free, np.array([0]), np.ones(1)) == np.inf


# From end to end ------------------------------------------------------------------------------


def one_axis(cells, step, controls, cost, **more):
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": step}},
        "state_box": {"x": {"low": 0, "high": cells, "cells": cells}},
        "attractor": {"cells": [[0]]},
        "control_grid": {"u": {"values": [0, 1]}} if controls else {},
        "stage_cost": cost,
        "sampling": {"kind": "grid", "per_axis": 1},
        **more,
    }


def tampered(result, folder, scalars, **vectors):
    """Save a result, put other vectors in C and numbers in their place, and verify it twice."""
    result.save(folder)
    arrays = dict(np.load(folder / "solution.npz"))
    for name, values in vectors.items():
        arrays[name][result.cell_status == 1] = values
    np.savez(folder / "solution.npz", **arrays)
    path = folder / "certificate.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | scalars))
    return [lm.verify(folder, exact=exact) for exact in (False, True)]


def test_no_gap_is_lost_at_the_largest_double(tmp_path):
    result = lm.solve(
        made(one_axis(2, "0.5", True, "where(u < 0.5, 1e300, 1.7e308)", name="dear", gamma=1.0))
    )
    assert result.status == "verified", result.message
    stated = {"status": "verified", "cost": LARGEST, "gap": 0.0}
    for found in tampered(result, tmp_path / "out", stated, value=LARGEST):
        assert not found.holds
        assert found.certificate.gap > 0.99


def test_a_row_that_rounds_to_infinity_bounds_nothing(tmp_path):
    """Staying costs nothing at gamma 0.5, so nothing above 0 is a lower bound."""
    noise = {"w": {"values": list(range(11)), "weights": [1 / 11] * 11}}
    step = "where(u < 0.5, 0.5, 1.5 + w)"
    cost = "where(u < 0.5, 1.7e300, 0)"
    result = lm.solve(made(one_axis(12, step, True, cost, noise=noise, gamma=0.5)))
    assert result.status != "verified"
    stated = {"status": "verified", "lower_bound": LARGEST, "cost": LARGEST, "gap": 0.0}
    for found in tampered(result, tmp_path / "out", stated, lower=LARGEST, value=LARGEST):
        assert not found.holds
        assert not found.certificate.lower_bound


def test_a_refusal_that_rounds_to_infinity_proves_nothing():
    noise = {"w": {"values": list(range(11)), "weights": [1 / 11] * 11}}
    lp = lm.compile(made(one_axis(12, "where(u < 0.5, 0.5, 1.5 + w)", True, "1", noise=noise)))
    columns = np.flatnonzero(lp.control == 1)
    lp = replace(lp.part(columns, np.arange(lp.n)), gamma=0.9)
    for w in (np.full(lp.n, LARGEST), np.full(lp.n, 1.79e308), np.ones(lp.n)):
        for judge_by in (verdict, exact_verdict):
            assert not judge_by(lp, Witness(None, refusal=w), 1e-6).refusal
            assert judge_by(replace(lp, gamma=1.0), Witness(None, refusal=w), 1e-6).refusal


def test_the_smallest_cost_is_not_reported_as_nothing():
    """5e-324 in every cell: 0.4 + 0.4 + 0.2 is above 1 as doubles, so the bound is 1e-323."""
    weights = {"weights": [0, 0.4, 0.4, 0.2, 0]}
    cost = "where(x > 4, 1e300, 5e-324)"
    result = lm.solve(made(one_axis(5, "0.5", False, cost, measure=weights)))
    assert (result.cost, result.lower_bound) == (1e-323, 5e-324)
    assert result.status == "unverified"
    assert "below the normal range" in result.message
    result = lm.solve(made(one_axis(2, "0.5", False, "5e-324")))
    assert (result.cost, result.lower_bound, result.gap) == (5e-324, 5e-324, 0.0)
    assert result.verified


@pytest.mark.parametrize("n", [3, 1_500])
def test_conditional_costs_are_outward(n):
    rng = np.random.default_rng(n)
    for _ in range(30):
        m, x = (np.resize(numbers(rng, 7, 0.3), n) for _ in range(2))
        if not 0 < m.max() < 1e300:
            continue
        pairs = list(zip(m.tolist(), x.tolist(), strict=True))
        exact = sum(Fraction(a) * Fraction(b) for a, b in pairs) / sum(
            Fraction(a) for a, _ in pairs
        )
        up, down = sums.mean(m, x, np.inf), sums.mean(m, x, -np.inf)
        assert Fraction(down) <= exact <= Fraction(min(up, LARGEST))
        assert up <= down * (1 + 1e-12) + 1e-323
    result = lm.solve(made(one_axis(3, "0.5", False, "5e-324")))
    assert result.cost_from({"x": (1, 3)}) == CostFrom(5e-324, 5e-324, 1.0)


def test_a_cost_beyond_the_doubles_is_no_bound():
    lp = lm.compile(made(one_axis(4, "0.5", False, "1")))
    lp = replace(lp, weight=np.array([0.5, 0.5, 2.0**-52]))
    V = np.full(lp.n, LARGEST)
    for judge_by in (verdict, exact_verdict):
        proof = judge_by(lp, Witness(lp.pair_pointer[:-1], V, V, V, V), 1e-6)
        assert not proof.upper_bound
        assert proof.cost is None
        assert proof.gap is None
        assert any("upper bound" in reason for reason in proof.reasons)


@pytest.mark.parametrize("n", [3, 1_500])
def test_sums_of_extreme_numbers_are_outward(n):
    rng = np.random.default_rng(n)
    for _ in range(30):
        m, x, y = (np.resize(numbers(rng, 7, 0.3), n) for _ in range(3))
        m = m / m.max() if 0 < m.max() < 1e300 else np.full(n, 1 / n)
        exact = sum(Fraction(a) * Fraction(b) for a, b in zip(m.tolist(), x.tolist(), strict=True))
        up, down = sums.weighted(m, x, np.inf), sums.weighted(m, x, -np.inf)
        assert Fraction(down) <= exact
        assert up == np.inf or Fraction(up) >= exact
        assert (up == 0) == (exact == 0)
        y = np.minimum(x, y)
        exact_y = sum(
            Fraction(a) * Fraction(b) for a, b in zip(m.tolist(), y.tolist(), strict=True)
        )
        gap = sums.gap_above(m, x, y)
        assert Fraction(gap) >= ((exact - exact_y) / exact if exact else 0)

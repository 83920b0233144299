"""Certificates of numbers from the smallest double to the largest: no check says a false yes.

``PYTHONPATH=tests/helpers python tests/certificate/test_extremes.py 64000`` tries so many.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from models import build
from problems import made
from truth import truly

import lmdsl as lm
from lmdsl.certificate import sums
from lmdsl.certificate.checks import check
from lmdsl.certificate.claims import CLAIMS, Witness
from lmdsl.certificate.exact_checks import check_exactly
from lmdsl.model import stabilizable_set
from lmdsl.model.discretization import Nodes
from lmdsl.model.rows import Rows, Shares
from lmdsl.optimize.feasibility import first_policy, spectral_radius
from lmdsl.results.result import CostFrom

LARGEST = sys.float_info.max
NUMBERS = [
    5e-324, 1e-323, 1e-310, 2.3e-308, 1e-300, 1e-200, 1e-154, 1e-17, 0.1, 0.5, 1.0, 3.0, 1e17,
    1e154, 1e200, 1e300, 8e307, 1.7e308, LARGEST,
]  # fmt: skip
GAMMAS = [5e-324, 1e-300, 1e-17, 0.5, 0.9, 1.0, 1 + 2**-52, 1.3, 2.0, 1e17, 1e300, LARGEST]
WEIGHTS = [
    [1.0], [0.5, 0.5], [0.1] * 11, [0.1, 0.2, 0.7], [1.0, 1e-17], [1.0, 5e-324], [0.5, 0.5, 5e-324],
    [1.0, *[1e-17] * 10], [0.3, 1e-300, 0.7],
]  # fmt: skip
"""Eleven times LARGEST / 11 rounds to infinity."""
TOLERANCE = 1e-6


def script():
    """Load the stand-alone checker."""
    path = Path(__file__).parents[2] / "tools/check_certificate.py"
    spec = importlib.util.spec_from_file_location("check_certificate", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SCRIPT = script()


def number(rng, zero=0.1):
    if rng.random() < zero:
        return 0.0
    if rng.random() < 0.5:
        return float(rng.choice(NUMBERS))
    return float(rng.random() * 10.0 ** rng.integers(-323, 308))


def numbers(rng, n, zero=0.1):
    """Return numbers of one kind, or each of its own."""
    if rng.random() < 0.3:
        return np.full(n, LARGEST if rng.random() < 0.3 else number(rng, 0.0))
    return np.array([number(rng, zero) for _ in range(n)])


class Model:
    """A random model, twice: as the product stores it, and as exact fractions."""

    def __init__(self, rng):
        n = self.n = int(rng.choice([1, 2, 3, 4, 12]))
        weights = np.array(WEIGHTS[2 if n == 12 else rng.integers(len(WEIGHTS))])
        if len(weights) == 1:  # no noise, some samples
            points = int(rng.integers(1, 8))
            self.shares = Shares.of(points, Nodes(np.zeros((1, 0)), weights, np.zeros(1, int)))
            group, start = np.zeros(points, int), [0]
            sample = [Fraction(1, points)] * points
        else:
            values, group = np.unique(weights, return_inverse=True)
            order = list(dict.fromkeys(group.tolist()))  # groups by first appearance
            group = np.array([order.index(g) for g in group])
            nodes = Nodes(np.zeros((len(weights), 1)), weights, group)
            self.shares = Shares.of(1, nodes)
            start = np.cumsum([0, *np.bincount(group)])[:-1].tolist()
            sample = [Fraction(w) / sum(map(Fraction, weights.tolist())) for w in weights.tolist()]
            del values
        spread = n > 4 and rng.random() < 0.7
        self.gamma = float(rng.choice(GAMMAS))
        self.model, target, code, pointer = [], [], [], [0]
        controls = rng.integers(1, 4, n)
        for i in range(n):
            self.model.append([])
            for _ in range(controls[i]):
                some = rng.integers(-1, n, 2)
                goes = rng.choice(some, len(group)) if rng.random() < 0.5 else some[0] + 0 * group
                if spread:
                    goes = rng.permutation(n)[: len(group)]
                row = {}
                for j in np.unique(goes):
                    row[int(j)] = sum(s for s, to in zip(sample, goes, strict=True) if to == j)
                    for g in np.unique(group[goes == j]):
                        target.append(n if j < 0 else j)
                        code.append(start[g] + int(((goes == j) & (group == g)).sum()) - 1)
                pointer.append(len(target))
                self.model[i].append((row, number(rng, 0.3)))
        rows = Rows(
            np.array(pointer), np.array(target, np.int32), np.array(code, np.uint8), self.shares, n
        )
        cost = np.array([cost for choices in self.model for _, cost in choices])
        control = np.concatenate([np.arange(c) for c in controls]).astype(np.int32)
        m = np.array([min(number(rng), 0.5 / n) for _ in range(n)])
        m[rng.integers(n)] = 0.0
        m[m.argmin()] = 1 - m.sum()
        self.lp = replace(
            build(np.cumsum([0, *controls]), control, rows, cost, 1.0), gamma=self.gamma, weight=m
        )

    def backup(self, i, k, x, rate, cost=True):
        row, paid = self.model[i][k]
        mean = sum((Fraction(x[j]) * s for j, s in row.items() if j >= 0), Fraction(0))
        return Fraction(rate) * mean + (Fraction(paid) if cost else 0)


def near(rng, value):
    """Round a fraction up, down, or another unit off."""
    x = min(sums.rounded_up(value), LARGEST)
    for _ in range(int(rng.choice([0, 0, 0, 0, 1, 2]))):
        x = math.nextafter(x, 0.0)
    return x


def settled(rng, model, x, pick, right, rounds=8):
    """Bring x close to an inequality by a few passes: pick of x and the rounded right-hand side."""
    x = x.tolist()
    for _ in range(int(rng.choice([0, 2, rounds]))):
        for i in range(model.n):
            x[i] = pick(x[i], near(rng, right(i, x)))
    return np.array(x)


def drawn_witness(rng, model):
    """Return a witness whose inequalities hold closely, or fail closely, or are nonsense."""
    n, g = model.n, max(model.gamma, 1.0)
    choice = [int(rng.integers(len(c))) for c in model.model]
    pair = model.lp.pair_pointer[:-1] + choice

    def all_pairs(cost):
        def right(i, x):
            some = range(len(model.model[i]))
            return min(model.backup(i, k, x, model.gamma, cost) for k in some)

        return right

    if rng.random() < 0.25:
        w = settled(rng, model, numbers(rng, n), min, all_pairs(False))
        return choice, Witness(None, w, W=numbers(rng, n))
    w = settled(
        rng, model, numbers(rng, n, 0.0), lambda a, b: max(a, math.nextafter(b, LARGEST)),
        lambda i, x: model.backup(i, choice[i], x, g, False),
    )  # fmt: skip
    V = settled(
        rng, model, numbers(rng, n), max, lambda i, x: model.backup(i, choice[i], x, model.gamma)
    )
    above = numbers(rng, n) if rng.random() < 0.3 else V
    W = settled(rng, model, above, min, all_pairs(True))
    mu = numbers(rng, n)
    if rng.random() < 0.7:
        m, mu = model.lp.weight, model.lp.weight.copy()
        for _ in range(20):
            inflow = [0.0] * n
            for i in range(n):
                for j, s in model.model[i][choice[i]][0].items():
                    if j >= 0:
                        inflow[j] += model.gamma * (float(s) * float(mu[i]))
            mu = np.minimum(m + np.minimum(inflow, LARGEST), LARGEST)
    vectors = {"w": w, "V_up": V, "W": W, "mu": mu}
    if rng.random() < 0.3:
        name = str(rng.choice(list(vectors)))
        changed = vectors[name].copy()
        i = rng.integers(n)
        changed[i] = rng.choice(
            [math.nextafter(changed[i], math.inf), number(rng), LARGEST, np.nan]
        )
        vectors[name] = changed
    return choice, Witness(pair, **vectors)


def told(model, choice, witness, proof):
    """Return what the stand-alone checker says of a certificate: claim by number to yes or no."""
    lp, refusal = model.lp, witness.policy is None
    stated = {"contraction": proof.contraction, "cost": proof.cost, "lower_bound": proof.lower}
    head = {
        "format": "lmdsl-certificate/1",
        "kind": "refusal" if refusal else "policy",
        "gamma": model.gamma.hex(),
        "total": lp.rows.shares.total,
        "cells": lp.n,
        "pairs": lp.K,
        "tolerance": TOLERANCE.hex(),
        **{k: None if v is None else float(v).hex() for k, v in stated.items()},
    }
    names = ("w",) if refusal else ("w", "V_up", "W", "mu")
    cells = [
        {
            "policy": choice[i],
            "m": float(lp.weight[i]).hex(),
            **{name: float(getattr(witness, name)[i]).hex() for name in names},
        }
        for i in range(lp.n)
    ]
    pairs = [
        [int(lp.cell[k]), int(lp.control[k]), float(lp.cost[k]).hex(), lp.rows.exact(k)]
        for k in range(lp.K)
    ]
    verdict, lines = SCRIPT.check(iter([json.dumps(x) for x in [head, *cells, *pairs]]))
    assert all(isinstance(line, str) for line in lines)
    return {claim: why is None for claim, why in verdict.items()}


def is_rounded_up(found, value):
    """Say whether a double is the least one not below a fraction."""
    if found == np.inf:
        return value > Fraction(LARGEST)
    return Fraction(found) >= value and (
        found == -LARGEST or value > Fraction(math.nextafter(found, -math.inf))
    )


def judge(rng):
    """Judge one witness four times; return the claims that hold."""
    model = Model(rng)
    lp = model.lp
    choice, witness = drawn_witness(rng, model)
    fast, exact = check(lp, witness, TOLERANCE), check_exactly(lp, witness, TOLERANCE)
    alone = told(model, choice, witness, exact)
    if witness.policy is None:
        w = witness.w.tolist()
        truth = any(w) and all(
            Fraction(w[i]) <= model.backup(i, k, w, model.gamma, False)
            for i in range(model.n)
            for k in range(len(model.model[i]))
        )
        assert fast.refusal == exact.refusal == alone[6] == truth
        assert exact.lower_bound == fast.lower_bound
        return {"refusal"} if truth else set()
    truth = truly(model.model, model.gamma, lp.weight, choice, witness, 1)

    def mean(x):
        pairs = zip(lp.weight.tolist(), x.tolist(), strict=True)
        return sum((Fraction(m) * Fraction(v) for m, v in pairs), Fraction(0))

    cost = lower = None
    if truth["upper_bound"]:
        cost = mean(witness.V_up)
        truth["upper_bound"] = cost <= Fraction(LARGEST)
    if truth["lower_bound"]:
        lower = mean(witness.W)
    for claim, name in enumerate(CLAIMS, 1):
        assert getattr(exact, name) == alone[claim] == truth[name], name
        assert truth[name] or not getattr(fast, name), name
    assert fast.lower_bound == exact.lower_bound
    gap = None
    if truth["upper_bound"]:
        assert is_rounded_up(exact.cost, cost)
        assert fast.cost is None or fast.cost >= exact.cost
    if truth["lower_bound"]:
        assert is_rounded_up(-exact.lower, -lower)
        assert fast.lower <= exact.lower
    if truth["upper_bound"] and truth["lower_bound"]:
        gap = (cost - lower) / cost if cost else Fraction(0)
        if 0 < exact.cost < sys.float_info.min:
            gap = max(gap, 1 - Fraction(exact.lower) / Fraction(exact.cost))
        assert is_rounded_up(exact.gap, max(gap, Fraction(0)))
        assert fast.gap is None or fast.gap >= exact.gap
    assert alone[5] == (exact.gap is not None and exact.gap <= TOLERANCE)
    assert alone[5] == (gap is not None and gap <= Fraction(TOLERANCE))
    if truth["stabilizing"]:
        w, g = witness.w.tolist(), max(model.gamma, 1.0)
        rate = max(model.backup(i, k, w, g, False) / Fraction(w[i]) for i, k in enumerate(choice))
        assert is_rounded_up(exact.contraction, rate)
        assert fast.contraction is None or fast.contraction >= exact.contraction
    for proof in (fast, exact):
        assert proof.verified == (not proof.reasons)
    assert exact.verified or not fast.verified
    assert exact.verified == all(alone.values())
    held = {name for name in CLAIMS if truth[name]}
    return (
        held | ({"verified"} if exact.verified else set()) | ({"fast"} if fast.verified else set())
    )


def tried(seeds):
    """Judge witnesses; return how often each claim held."""
    count = dict.fromkeys((*CLAIMS, "refusal", "verified", "fast"), 0)
    for seed in seeds:
        try:
            for name in judge(np.random.default_rng(seed)):
                count[name] += 1
        except Exception as error:
            raise AssertionError(f"seed {seed}") from error
    return count


@pytest.mark.long
def test_no_check_says_yes_where_fractions_say_no():
    count = tried(range(700))
    assert min(count.values()) > 3, count


@pytest.mark.long
def test_no_check_says_yes_at_length():
    tried(range(10_000, 13_000))


# What makes the witnesses -------------------------------------------------------------------


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


# From end to end ----------------------------------------------------------------------------


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
        for judge_by in (check, check_exactly):
            assert not judge_by(lp, Witness(None, w), 1e-6).refusal
            assert judge_by(replace(lp, gamma=1.0), Witness(None, w), 1e-6).refusal


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
    for judge_by in (check, check_exactly):
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


if __name__ == "__main__":
    print(tried(range(int(sys.argv[1]))))

"""Negative controls: spoil one thing, and the claim it breaks must be refused."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import dense, random_lp
from problems import doubling, made, standard_map, steps
from truth import CLAIMS

import lmdsl as lm
from lmdsl.certificate.bounds import exactly_below, holds_for_all
from lmdsl.certificate.claims import Witness
from lmdsl.certificate.judge import exact_verdict, verdict
from lmdsl.model.rows import Rows
from lmdsl.optimize import witness
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.policies import evaluation, iteration


@pytest.fixture(scope="module")
def solved():
    """The standard map on 20 x 20 cells, its witness and certificate."""
    lp = lm.compile(made(standard_map(20)))
    found = first_policy.stabilizing(lp)
    done = iteration.iterate(lp, found.policy, evaluation.evaluate(lp, found.policy))
    verified = witness.certify(lp, done.policy, 1e-6, done.value)
    assert verified.certificate.verified
    return lp, verified.witness


def judged(lp, witness, **changes):
    """Judge twice, fast and in rational arithmetic; the fast check may only be stricter."""
    changed = replace(witness, **changes)
    fast, exact = verdict(lp, changed, 1e-6), exact_verdict(lp, changed, 1e-6)
    for claim in ("stabilizing", "upper_bound", "lower_bound", "measure", "refusal"):
        assert getattr(exact, claim) >= getattr(fast, claim), claim
    for name, outward in (("cost", 1), ("contraction", 1), ("gap", 1), ("lower", -1)):
        loose, tight = getattr(fast, name), getattr(exact, name)
        if loose is not None:
            assert outward * loose >= outward * tight, name
    return fast if fast.verified else exact


def spoiled(array, i, value):
    array = array.copy()
    array[i] = value
    return array


def test_the_unspoiled_witness_passes(solved):
    lp, witness = solved
    proof = judged(lp, witness)
    assert proof.verified
    assert proof.reasons == ()
    assert proof.gap < 1e-9
    assert proof.contraction < 1


@pytest.mark.parametrize("i", [0, 17, 391])
def test_spoiled_upper_bound(solved, i):
    lp, witness = solved
    lower = spoiled(witness.V_up, i, witness.V_up[i] * (1 - 1e-9))
    assert not judged(lp, witness, V_up=lower).upper_bound
    assert not judged(lp, witness, V_up=spoiled(witness.V_up, i, -1.0)).upper_bound
    assert not judged(lp, witness, V_up=spoiled(witness.V_up, i, np.nan)).upper_bound
    assert not judged(lp, witness, V_up=spoiled(witness.V_up, i, np.inf)).upper_bound
    assert not judged(lp, witness, V_up=None).verified


@pytest.mark.parametrize("i", [0, 17, 391])
def test_spoiled_lower_bound(solved, i):
    lp, witness = solved
    assert not judged(lp, witness, W=spoiled(witness.W, i, witness.W[i] * (1 + 1e-9))).lower_bound
    assert not judged(lp, witness, W=spoiled(witness.W, i, np.nan)).lower_bound
    too_low = judged(lp, witness, W=0.9 * witness.W)
    assert too_low.lower_bound
    assert not too_low.verified
    assert "above the tolerance" in too_low.reasons[0]


@pytest.mark.parametrize("i", [0, 17, 391])
def test_spoiled_stability_vector(solved, i):
    lp, witness = solved
    for value in (0.0, -1.0, np.nan, np.inf, witness.w[i] * 1e-3):
        assert not judged(lp, witness, w=spoiled(witness.w, i, value)).stabilizing
    assert not judged(lp, witness, w=np.ones(lp.n)).stabilizing


@pytest.mark.parametrize("i", [0, 17, 391])
def test_spoiled_measure(solved, i):
    lp, witness = solved
    assert not judged(lp, witness, mu=spoiled(witness.mu, i, witness.mu[i] + 1e-8)).measure
    assert not judged(lp, witness, mu=spoiled(witness.mu, i, -1e-30)).measure
    assert not judged(lp, witness, mu=spoiled(witness.mu, i, np.nan)).measure


@pytest.mark.long
def test_spoiled_policy(solved):
    lp, witness = solved
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(50):
        i = int(rng.integers(lp.n))
        k = int(rng.integers(lp.pair_pointer[i], lp.pair_pointer[i + 1]))
        if k == witness.policy[i]:
            continue
        proof = judged(lp, witness, policy=spoiled(witness.policy, i, k))
        assert not proof.measure
        refused += not proof.upper_bound
    assert refused > 40
    # A column of another cell is no policy at all.
    moved = spoiled(witness.policy, 0, lp.pair_pointer[1])
    assert not judged(lp, witness, policy=moved).verified
    assert not judged(lp, witness, policy=witness.policy[:-1]).verified


def test_spoiled_matrix_and_cost(solved):
    lp, witness = solved
    k = int(witness.policy[100])
    rows = lp.rows
    e = int(rows.pointer[k])
    worst = int(np.argmax(witness.V_up))
    target = rows.target.copy()
    target[e] = worst
    bad = replace(lp, rows=Rows(rows.pointer, target, rows.code, rows.shares, rows.columns))
    assert not judged(bad, witness).verified
    cost = lp.cost.copy()
    cost[k] += 1e-6
    assert not judged(replace(lp, cost=cost), witness).upper_bound
    cost = lp.cost.copy()
    cost[k] -= 1e-6
    assert not judged(replace(lp, cost=cost), witness).lower_bound


def test_gamma_of_another_problem(solved):
    lp, witness = solved
    assert not judged(replace(lp, gamma=1.03), witness).verified
    assert not judged(replace(lp, gamma=1.01), witness).verified


def test_a_policy_that_stays_is_never_stabilizing():
    lp = lm.compile(made(steps(1.0, cost="u")))
    stay = lp.pair_pointer[:-1].copy()
    for w in (np.ones(lp.n), np.arange(1.0, lp.n + 1), np.full(lp.n, 1e300)):
        assert not verdict(lp, Witness(stay, w), 1e-6).stabilizing
    assert evaluation.stability_vector(lp, stay) == (None, None)


def test_shares_that_round_below_one_prove_nothing():
    # 0.1 + 0.2 + 0.7 < 1 in doubles: summed, they would "prove" that staying forever is stable.
    data = steps(1.0)
    data["system"]["next"] = {"x": "x - 0.25*u + 0*w"}
    data["noise"] = {"w": {"values": [0, 1, 2], "weights": [0.1, 0.2, 0.7]}}
    lp = lm.compile(made(data))
    for k in range(lp.K):
        assert sum(share for _, share in lp.rows.exact(k)) == lp.rows.shares.total
    stay = lp.pair_pointer[:-1].copy()
    assert not verdict(lp, Witness(stay, np.ones(lp.n)), 1e-6).stabilizing


def test_refusal_needs_a_true_vector():
    lp = lm.compile(made(doubling(2.0)))
    assert verdict(lp, Witness(None, refusal=np.ones(1)), 1e-6).refusal
    lower = lm.compile(made(doubling(np.nextafter(2.0, 0))))
    assert not verdict(lower, Witness(None, refusal=np.ones(1)), 1e-6).refusal
    assert not verdict(lp, Witness(None, refusal=np.zeros(1)), 1e-6).refusal
    assert not verdict(lp, Witness(None, refusal=-np.ones(1)), 1e-6).refusal
    assert not verdict(lp, Witness(None, refusal=np.full(1, np.nan)), 1e-6).refusal


def test_a_refusal_is_never_a_verification():
    lp = lm.compile(made(doubling(3.0)))
    assert not verdict(lp, Witness(None, refusal=np.ones(1)), 1e-6).verified


@settings(max_examples=300, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), gamma=st.sampled_from([0.9, 1.0, 1.1, 1.7]))
def test_claim_1_never_holds_for_an_unstable_policy(seed, gamma):
    rng = np.random.default_rng(seed)
    lp = random_lp(rng, cells=6, gamma=gamma, absorb=0.5)
    if not lp.n:
        return
    pair = rng.integers(lp.pair_pointer[:-1], lp.pair_pointer[1:])
    g = max(gamma, 1.0)
    rho = g * max(abs(np.linalg.eigvals(dense(lp)[pair])))
    w, _ = evaluation.stability_vector(lp, pair)
    if rho >= 1 + 1e-9:
        assert w is None
        guess = np.exp(rng.normal(size=lp.n))
        assert not verdict(lp, Witness(pair, guess), 1e-6).stabilizing
    elif rho <= 1 - 1e-6:
        assert w is not None


@settings(max_examples=200, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), scale=st.sampled_from([1e-9, 1.0, 1e9]))
def test_fast_bounds_agree_with_rationals(seed, scale):
    rng = np.random.default_rng(seed)
    lp = random_lp(rng, cells=5, gamma=float(rng.choice([1.0, 1.1])), zero=0.3)
    if not lp.n:
        return
    lp = replace(lp, cost=lp.cost * scale)
    result = lm.solve(lp)
    if not np.isfinite(result.value).all():
        return
    exact = result.lower[lp.cells]
    for x in (exact, np.nextafter(exact, np.inf), exact * (1 + 1e-15), exact * (1 - 1e-15)):
        truth = all(exactly_below(lp, k, x, lp.gamma, lp.cost) for k in range(lp.K))
        assert holds_for_all(lp, x, lp.gamma, lp.cost) == truth


def test_exact_backup_by_hand():
    lp = lm.compile(made(doubling(1.1)))
    from lmdsl.certificate.bounds import exact_backup

    value = exact_backup(lp, 0, np.array([3.0]), lp.gamma, lp.cost)
    assert value == Fraction(1.1) * 3 / 2 + 1


@settings(max_examples=200, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), decades=st.sampled_from([0, 3, 200]))
def test_directed_sums_are_exact(seed, decades):
    from lmdsl.certificate.sums import weighted

    rng = np.random.default_rng(seed)
    m = rng.random(7)
    V = rng.random(7) * 10.0 ** rng.integers(-decades, decades + 1, size=7)
    exact = sum(Fraction(a) * Fraction(b) for a, b in zip(m.tolist(), V.tolist(), strict=True))
    up, down = weighted(m, V, np.inf), weighted(m, V, -np.inf)
    assert Fraction(down) <= exact <= Fraction(up)
    assert up <= np.nextafter(down, np.inf)


def test_the_largest_doubles_are_refused_without_overflow():
    lp = lm.compile(made(steps()))
    pair, ones = lp.tree[1], np.ones(lp.n)
    huge = np.full(lp.n, 1.7e308)
    for vectors in ({"mu": huge}, {"V_up": huge}, {"W": huge}, {"w": huge}):
        witness = replace(Witness(pair, ones, ones, ones, ones), **vectors)
        for judge in (verdict, exact_verdict):
            assert not judge(lp, witness, 1e-6).verified


def test_vectors_of_another_length_prove_nothing():
    lp = lm.compile(made(steps()))
    result = lm.solve(lp)
    pair = lp.pair_pointer[:-1] + result.control_index[lp.cells]
    for short in (np.ones(0), np.ones(1), np.ones(lp.n - 1), np.ones(lp.n + 1), np.ones((lp.n, 1))):
        proof = verdict(lp, Witness(pair, short, short, short, short), 1e-6)
        assert not any(getattr(proof, name) for name in CLAIMS)
        assert not verdict(lp, Witness(None, refusal=short), 1e-6).refusal

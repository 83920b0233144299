"""Certificates of numbers from the smallest double to the largest: no check says a false yes.

``PYTHONPATH=tests/helpers python tests/certificate/test_extremes.py 64000`` tries so many.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from extremes import LARGEST, Model, number, numbers
from truth import CLAIMS, truly

from lmdsl.certificate import sums
from lmdsl.certificate.claims import Witness
from lmdsl.certificate.judge import exact_verdict, verdict

TOLERANCE = 1e-6


def script():
    """Load the stand-alone checker."""
    path = Path(__file__).parents[2] / "tools/check_certificate.py"
    spec = importlib.util.spec_from_file_location("check_certificate", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SCRIPT = script()


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
        return choice, Witness(None, W=numbers(rng, n), refusal=w)
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
    names = {"w": "refusal"} if refusal else {name: name for name in ("w", "V_up", "W", "mu")}
    cells = [
        {
            "policy": choice[i],
            "m": float(lp.weight[i]).hex(),
            **{key: float(getattr(witness, name)[i]).hex() for key, name in names.items()},
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
    fast, exact = verdict(lp, witness, TOLERANCE), exact_verdict(lp, witness, TOLERANCE)
    alone = told(model, choice, witness, exact)
    if witness.policy is None:
        w = witness.refusal.tolist()
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


# From end to end ------------------------------------------------------------------------------

if __name__ == "__main__":
    print(tried(range(int(sys.argv[1]))))

"""Laws every answer obeys, on random finite models.

`test_laws` runs 9 laws on 30 examples each, about 700 models; `test_laws_at_length` (marked long)
on 90 each, about 2,100 more. `test_no_false_claim_passes` judges 4,000 spoiled witnesses, and
`test_backends_agree_or_say_why` compares backends on 200 models. Models counted are those solved:
drawn and transformed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import mdp, random_lp
from truth import CLAIMS, SAMPLES, truly

import lmdsl as lm
from lmdsl.certificate.claims import Witness
from lmdsl.certificate.judge import exact_verdict, verdict

GAMMAS = [0.9, 1.0, 1.0, 1.02, 1.1]

# Models as plain lists: per cell a list of ({successor: count}, cost), successor -1 is A.


def drawn(rng, gamma=None, zero=0.0, cells=None):
    """Return a random model whose controls are numbered 0, 1, ... in every cell."""
    while True:
        size = int(rng.integers(1, 7)) if cells is None else cells
        lp = random_lp(rng, cells=size, samples=SAMPLES, zero=zero)
        if lp.n:
            return listed(lp), float(rng.choice(GAMMAS)) if gamma is None else gamma


def listed(lp):
    model = []
    for first, last in zip(lp.pair_pointer[:-1], lp.pair_pointer[1:], strict=True):
        model.append(
            [
                ({-1 if j == lp.n else j: c for j, c in lp.rows.exact(k)}, float(lp.cost[k]))
                for k in range(first, last)
            ]
        )
    return model


class Solved:
    """A solved model, its arrays on C."""

    def __init__(self, model, gamma, backend="policy-iteration"):
        self.lp = lp = mdp(model, SAMPLES, gamma)
        self.result = result = lm.solve(lp, backend)
        self.status = result.status
        self.verified = result.verified
        self.V, self.W = result.value[lp.cells], result.lower[lp.cells]
        self.mu, self.w = result.measure[lp.cells], result.witness[lp.cells]
        self.choice = result.control_index[lp.cells]

    @property
    def policy(self):
        return self.lp.pair_pointer[:-1] + self.choice

    def strict(self):
        """Return the cells whose best control beats every other by more than rounding."""
        lp = self.lp
        Q = lp.gamma * (lp.P @ self.V) + lp.cost
        found = []
        for first, last in zip(lp.pair_pointer[:-1], lp.pair_pointer[1:], strict=True):
            near = np.sort(Q[first:last])
            found.append(last - first == 1 or near[1] > near[0] + 1e-7 * (near[0] + self.V.max()))
        return np.array(found)


def assert_close(a, b, rtol=1e-9):
    np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(b).max(initial=0.0))


def assert_at_least(a, b):
    assert (a >= b - 1e-9 * np.abs(b).max(initial=0.0)).all()


def assert_same(a, b, order, choices):
    """Assert that b is a with its cells moved to `order` and its controls renamed."""
    assert a.status == b.status
    if not a.verified:
        return
    assert_close(b.V[order], a.V)
    assert_close(b.W[order], a.W)
    strict = a.strict()
    assert (b.choice[order] == choices)[strict].all()
    if strict.all():
        assert_close(b.mu[order], a.mu)
        assert b.result.cost == pytest.approx(a.result.cost, rel=1e-9)


def permuted_cells(rng):
    model, gamma = drawn(rng, zero=0.2)
    order = rng.permutation(len(model))
    moved = [None] * len(model)
    for i, choices in enumerate(model):
        moved[order[i]] = [
            ({-1 if j < 0 else int(order[j]): c for j, c in row.items()}, g) for row, g in choices
        ]
    a, b = Solved(model, gamma), Solved(moved, gamma)
    assert_same(a, b, order, a.choice)


def permuted_controls(rng):
    model, gamma = drawn(rng, zero=0.2)
    orders = [rng.permutation(len(choices)) for choices in model]
    moved = [[choices[k] for k in order] for choices, order in zip(model, orders, strict=True)]
    a, b = Solved(model, gamma), Solved(moved, gamma)
    renamed = a.choice
    if a.verified:
        names = [np.argsort(order)[k] for order, k in zip(orders, a.choice, strict=True)]
        renamed = np.array(names)
    assert_same(a, b, np.arange(len(model)), renamed)


def scaled(model, factor):
    return [[(row, g * factor) for row, g in choices] for choices in model]


def scaled_costs(rng):
    model, gamma = drawn(rng, zero=0.2)
    a = Solved(model, gamma)
    power = 2.0 ** int(rng.integers(-60, 61))
    b = Solved(scaled(model, power), gamma)
    assert a.status == b.status
    if a.verified:
        assert_close(b.V, a.V * power, 1e-13)
        assert_close(b.W, a.W * power, 1e-13)
        np.testing.assert_array_equal(a.choice, b.choice)
        assert b.result.cost == pytest.approx(a.result.cost * power, rel=1e-13)
    factor = 10.0 ** float(rng.uniform(-9, 9))
    c = Solved(scaled(model, factor), gamma)
    assert a.status == c.status
    if a.verified:
        assert_close(c.V, a.V * factor)
        assert_close(c.W, a.W * factor)
        assert (a.choice == c.choice)[a.strict()].all()


def doubled_states(rng):
    model, gamma = drawn(rng, cells=int(rng.integers(1, 5)))

    def split(row):
        found = {}
        for j, count in row.items():
            if j < 0:
                found[-1] = count
                continue
            first = int(rng.integers(count + 1))
            found.update({2 * j + i: c for i, c in ((0, first), (1, count - first)) if c})
        return found

    twice = [[(split(row), g) for row, g in choices] for choices in model for _ in range(2)]
    a, b = Solved(model, gamma), Solved(twice, gamma)
    assert a.status == b.status
    if a.verified:
        for copy in (0, 1):
            assert_close(b.V[copy::2], a.V)
            assert_close(b.W[copy::2], a.W)
            assert (b.choice[copy::2] == a.choice)[a.strict()].all()
        if a.strict().all():
            assert_close(b.mu[::2].sum() + b.mu[1::2].sum(), a.mu.sum())


def doubled_control(rng):
    model, gamma = drawn(rng)
    more = [[*choices, choices[int(rng.integers(len(choices)))]] for choices in model]
    a, b = Solved(model, gamma), Solved(more, gamma)
    assert a.status == b.status
    if a.verified:
        assert_close(b.V, a.V)
        assert_close(b.W, a.W)
        assert_close(b.mu, a.mu)
        np.testing.assert_array_equal(a.choice, b.choice)


def one_more_control(rng):
    model, gamma = drawn(rng, gamma=float(rng.choice([1.0, 1.02, 1.1])))
    n = len(model)
    hits = rng.integers(-1, n, size=SAMPLES)
    row = {int(j): int((hits == j).sum()) for j in np.unique(hits)}
    place = int(rng.integers(n))
    more = list(model)
    at = int(rng.integers(len(model[place]) + 1))
    new = (row, float(rng.random() * 10.0 ** rng.integers(-3, 3)))
    more[place] = [*model[place][:at], new, *model[place][at:]]
    a, b = Solved(model, gamma), Solved(more, gamma)
    if a.verified:
        assert b.verified
        assert (a.V >= b.W).all()
        assert_at_least(a.V, b.V)


def dearer_by_a_constant(rng):
    model, _ = drawn(rng, zero=0.3)
    c = float(rng.random() * 10.0 ** rng.integers(-3, 3))
    dearer = [[(row, g + c) for row, g in choices] for choices in model]
    a, b = Solved(model, 1.0), Solved(dearer, 1.0)
    assert a.status == b.status == "verified"
    assert_at_least(b.V, a.V + c)
    # No dearer than keeping the old policy: c times its expected time to A.
    P = a.lp.P[a.policy]
    time = np.linalg.solve(np.eye(a.lp.n) - P.toarray(), np.ones(a.lp.n))
    assert_at_least(a.V + c * time, b.V)
    # Constant costs: the value is the shortest expected time, and A cannot be reached sooner.
    assert (time >= 1 - 1e-9).all()


def larger_gamma(rng):
    model, gamma = drawn(rng, zero=0.2)
    larger = gamma * float(1 + rng.random() * 10.0 ** rng.integers(-6, 0))
    a, b = Solved(model, gamma), Solved(model, larger)
    if a.verified and b.verified:
        assert (b.V >= a.W).all()
        assert_at_least(b.V, a.V)
        assert b.result.cost >= a.result.lower_bound
    if gamma >= 1:
        assert a.verified or not b.verified


def measure_and_value(rng):
    model, gamma = drawn(rng, zero=0.2)
    a = Solved(model, gamma)
    if not a.verified:
        return
    lp, P = a.lp, a.lp.P[a.policy].toarray()
    cost = lp.cost[a.policy] @ a.mu
    assert cost == pytest.approx(lp.weight @ a.V, rel=1e-9, abs=1e-300)
    assert a.mu @ (1 - lp.gamma * P.sum(axis=1)) == pytest.approx(1, abs=1e-9 * a.mu.sum())
    assert a.result.lower_bound <= cost * (1 + 1e-9)
    assert (a.W <= a.V).all()


LAWS = [
    permuted_cells,
    permuted_controls,
    scaled_costs,
    doubled_states,
    doubled_control,
    one_more_control,
    dearer_by_a_constant,
    larger_gamma,
    measure_and_value,
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**20))
def test_laws(law, seed):
    law(np.random.default_rng(seed))


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
@settings(max_examples=90, deadline=None, derandomize=True)
@given(seed=st.integers(2**20, 2**40))
def test_laws_at_length(law, seed):
    law(np.random.default_rng(seed))


# Claims -------------------------------------------------------------------------------------


HOSTILE = [0.0, -0.0, -1.0, 5e-324, -5e-324, 1e300, 1.7e308, np.inf, -np.inf, np.nan]


def spoil(rng, x):
    """Return an array changed by anything from an ulp to nonsense."""
    x = x.copy()
    i = rng.integers(len(x))
    how = rng.integers(6)
    if how == 0:
        x[i] = np.nextafter(x[i], rng.choice([-np.inf, np.inf]))
    elif how == 1:
        for _ in range(int(rng.integers(1, 9))):
            x[i] = np.nextafter(x[i], np.inf)
    elif how == 2:
        x[i] *= 1 + rng.choice([-1, 1]) * 10.0 ** rng.uniform(-17, 2)
    elif how == 3:
        x *= 1 + rng.choice([-1, 1]) * 10.0 ** rng.uniform(-17, 2)
    elif how == 4:
        x[i] = rng.choice(HOSTILE)
    else:
        x += rng.normal(size=len(x)) * 10.0 ** rng.uniform(-20, 2)
    return x


@pytest.mark.long
def test_no_false_claim_passes():
    """Fast and exact checks against the definition; 4,000 spoiled witnesses."""
    rng = np.random.default_rng(5)
    tried = dict.fromkeys(CLAIMS, 0)
    refused, judged = dict(tried), 0
    while judged < 4000:
        model, gamma = drawn(rng, zero=0.2)
        a = Solved(model, gamma)
        if not a.verified:
            continue
        whole = Witness(a.policy, a.w, a.V, a.W, a.mu)
        for _ in range(50):
            witness = whole
            with np.errstate(all="ignore"):
                for name in rng.choice(["w", "V_up", "W", "mu", "policy"], rng.integers(1, 3)):
                    if name == "policy":
                        pair = a.policy.copy()
                        pair[rng.integers(len(pair))] = rng.integers(-1, a.lp.K + 1)
                        witness = replace(witness, policy=pair)
                    else:
                        witness = replace(witness, **{name: spoil(rng, getattr(witness, name))})
            fast, exact = verdict(a.lp, witness, 1e-6), exact_verdict(a.lp, witness, 1e-6)
            choice = witness.policy - a.lp.pair_pointer[:-1]
            truth = truly(model, gamma, a.lp.weight, choice.tolist(), witness)
            for name in CLAIMS:
                assert getattr(exact, name) == truth[name], name
                assert not getattr(fast, name) or truth[name], name
                tried[name] += 1
                refused[name] += not truth[name]
            assert not fast.verified or exact.verified
            judged += 1
    assert all(judged / 20 < refused[name] < judged for name in CLAIMS), refused


# Backends -----------------------------------------------------------------------------------


@pytest.mark.long
def test_backends_agree_or_say_why():
    """The same status, cost, values and controls as policy iteration, or a reason.

    Costs with zeros and gammas up to and beyond gamma_bar, so that some models are refused.
    """
    rng = np.random.default_rng(11)
    met = dict.fromkeys(("verified", "not_stabilizable", "unverified"), 0)
    for k in range(200):
        model, gamma = drawn(rng, gamma=float(rng.choice([0.9, 1.0, 1.02, 1.3, 2.0])), zero=0.2)
        a = Solved(model, gamma)
        met[a.status] += 1
        for backend in ("highs", "clarabel", "cvxpy")[: 3 if k % 4 == 0 else 2]:
            agree_or_say_why(a, Solved(model, gamma, backend), len(model), gamma)
    assert met["verified"] > 100, met
    assert min(met.values()) > 1, met


def agree_or_say_why(a, b, n, gamma):
    assert a.status == b.status, (a.result, b.result)
    if a.verified:
        assert_same(a, b, np.arange(n), a.choice)
        assert b.result.cost >= a.result.lower_bound
        assert a.result.cost >= b.result.lower_bound
    elif a.status == "not_stabilizable":
        # Decided before any backend is asked, by a vector that anyone can check.
        assert b.result.cause == a.result.cause == "gamma"
        assert b.result.certificate.refusal
    else:
        # A discounted optimum may stay away from A for ever; nothing else goes unverified.
        assert gamma < 1
        assert "never reaches the attractor" in a.result.message
        assert "never reaches the attractor" in b.result.message

"""Finite models: exact rows, layouts, costs, what is refused, and chains by elimination."""

from __future__ import annotations

import json
import math
import pickle
import re
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array, csr_array, csr_matrix

import lmdsl as lm

THIRD = Fraction(1, 3)


def rows_of(problem):
    """The given rows as {(state, action): {target: share}}, exact."""
    rows = problem.system.rows
    found = {}
    for k in range(rows.pairs):
        span = slice(rows.pointer[k], rows.pointer[k + 1])
        found[int(rows.cell[k]), int(rows.control[k])] = {
            int(j): Fraction(rows.numerator[c], rows.denominator[c])
            for j, c in zip(rows.target[span], rows.code[span], strict=True)
        }
    return found


# exactness -------------------------------------------------------------------------------------


def test_fractions_are_kept():
    P = [[[THIRD, 1 - THIRD], [0, 1]], [[Decimal("0.1"), "9/10"], [1, "0"]]]
    problem = lm.from_matrices(P, [[1, 1], [1, 1]], [1], layout="states")
    assert rows_of(problem) == {
        (0, 0): {0: THIRD, 1: 2 * THIRD},
        (0, 1): {0: Fraction(1, 10), 1: Fraction(9, 10)},
        (1, 0): {1: 1},
        (1, 1): {0: 1},
    }
    lp = lm.compile(problem)
    assert [Fraction(c, lp.rows.total(0)) for _, c in lp.rows.exact(0)] == [THIRD, 2 * THIRD]
    assert lp.rows.shares.total is None


@given(st.lists(st.lists(st.floats(0, 1), min_size=3, max_size=3).filter(lambda r: sum(r) > 1e-300),
                min_size=3, max_size=3))  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_floats_are_divided_exactly_by_their_sum(rows):
    """Whatever doubles add up to about 1: shares are p / sum(p) as rationals, from 1 to 1e-300."""
    scaled = [[p / math.fsum(row) for p in row] for row in rows]
    if not all(abs(math.fsum(row) - 1) <= 1e-9 for row in scaled):
        return
    found = rows_of(lm.from_matrices(np.array(scaled), np.ones(3), [0]))
    for s, row in enumerate(scaled):
        total = sum(map(Fraction, row))
        assert found[s, 0] == {j: Fraction(p) / total for j, p in enumerate(row) if p}


def test_shares_are_rounded_correctly():
    rng = np.random.default_rng(0)
    P = rng.dirichlet(np.full(6, 0.05), size=6)
    rows = lm.from_matrices(P, np.ones(6), [0]).system.rows
    exact = [Fraction(n, d) for n, d in zip(rows.numerator, rows.denominator, strict=True)]
    assert rows.values().tolist() == [float(x) for x in exact]


def test_rows_below_one_escape_and_above_are_refused():
    problem = lm.from_matrices([[0.5, 0.4], [0, 1]], [1, 1], [1])
    assert rows_of(problem)[0, 0][-1] == 1 - Fraction(0.5) - Fraction(0.4)
    found = lm.solve(problem)
    assert (found.status, found.cell_status.tolist()) == ("not_stabilizable", [2, 0])
    assert str(lm.explain(problem).why(0).moves[0]) == (
        "action = 0 loses 10 %: its row sums to so much less than 1"
    )
    assert "every action may escape or enter avoid" in str(lm.explain(problem))
    assert "true map" not in str(lm.explain(problem))
    for row in ([0.5, 0.6], [THIRD, 1]):
        with pytest.raises(
            lm.BadInput, match=r"^P: state 0, action 0: .* more than 1; divide every row"
        ):
            lm.from_matrices([row, [0, 1]], [1, 1], [1])
    with pytest.raises(lm.BadInput, match="sum to exactly 1"):
        lm.from_matrices([[THIRD, Fraction("0.6666666666")], [0, 1]], [1, 1], [1])


def test_a_discount_that_is_multiplied_in():
    P = np.array([[0.5, 0.5], [0.2, 0.8]])
    known = lm.solve(lm.from_matrices(P, [1, 2], discount=0.9))
    given_ = lm.solve(lm.from_matrices(0.9 * P, [1, 2], discount=0.9))
    np.testing.assert_allclose(given_.value, known.value, rtol=1e-12)
    mixed = 0.9 * P
    mixed[1] = P[1]  # then the first row lacks a tenth, which is an escape
    assert lm.solve(lm.from_matrices(mixed, [1, 2], discount=0.9)).cell_status.tolist() == [2, 4]


# layouts ---------------------------------------------------------------------------------------


def test_layouts_agree():
    """The same model in every layout, and sparse in every form, has one digest."""
    rng = np.random.default_rng(2)
    S, A = 5, 3
    P = rng.dirichlet(np.ones(S), size=(A, S))
    P[0, 2] = 0  # no pair
    cost = rng.random((S, A))
    flat = P.transpose(1, 0, 2).reshape(S * A, S)
    state, action = np.repeat(np.arange(S), A), np.tile(np.arange(A), S)
    mixed = rng.permutation(S * A)
    table = {s: {a: [(p, j, cost[s, a], False) for j, p in enumerate(P[a, s])]
                 for a in range(A) if P[a, s].any()} for s in range(S)}  # fmt: skip
    forms = [
        (P, cost, "auto"),
        (P.tolist(), cost.tolist(), "states"),
        ([csr_array(matrix) for matrix in P], cost, "auto"),
        ([csr_matrix(matrix) for matrix in P], csr_array(cost), "auto"),
        (P.transpose(1, 0, 2), cost, "product"),
        (flat, cost, "auto"),
        (coo_array(flat), cost.ravel(), "pairs"),
        ((flat[mixed], state[mixed], action[mixed]), cost.ravel()[mixed], "auto"),
        ((csr_array(flat), state, action), cost, "pairs"),
        (table, None, "auto"),
        (table, cost, "gymnasium"),
    ]
    digests = {
        lm.compile(lm.from_matrices(p, c, [4], discount=0.9, layout=layout)).digest
        for p, c, layout in forms
    }
    assert len(digests) == 1


def test_a_shape_that_fits_two_is_refused():
    P = np.full((2, 2, 2), 0.5)
    with pytest.raises(lm.BadInput, match=r"^layout: shape .* fits two layouts"):
        lm.from_matrices(P, [1, 1], [0])
    one = lm.from_matrices(P, [1, 1], [0], layout="states")
    assert lm.solve(one).status == "verified"
    with pytest.raises(lm.BadInput, match=r"^cost: 2 numbers may be of the states or of the pairs"):
        lm.from_matrices((P[0], [0, 0], [0, 1]), [1, 1], discount=0.9)


def test_costs_of_states_pairs_and_transitions():
    P = np.array([[[0.5, 0.5], [0, 1]], [[0.25, 0.75], [1, 0]]])
    each = np.array([[[1, 3], [9, 9]], [[4, 8], [9, 9]]])
    found = lm.from_matrices(P, each, [1], layout="states").system.rows.cost
    np.testing.assert_array_equal(found, [2, 7, 9, 9])
    found = lm.from_matrices(P, [1, 2], [1], layout="states").system.rows.cost
    np.testing.assert_array_equal(found, [1, 1, 2, 2])
    found = lm.from_matrices(P, [[1, math.inf], [2, 3]], [1], layout="states").system.rows
    np.testing.assert_array_equal(found.cost, [1, 2, 3])  # an infinite cost is no pair
    assert lm.compile(lm.from_matrices(P, [1, 2], [1], layout="states")).K == 2


@pytest.mark.parametrize(("P", "cost", "more", "words"), [
    ([[0.5, -0.5], [0, 1]], [1, 1], {}, "P: state 0, action 0, to state 1: the probability -0.5"),
    ([[0.5, math.nan], [0, 1]], [1, 1], {}, "P: state 0, action 0, to state 1: the probability n"),
    ([["a", 1], [0, 1]], [1, 1], {}, "P: 'a' is no number"),
    ([["1e99999999", 1], [0, 1]], [1, 1], {}, "P: '1e99999999' is no fraction"),
    ([[1j, 1], [0, 1]], [1, 1], {}, "P: holds complex128"),
    ([[0.5, 0.5], [1]], [1, 1], {}, "P: is no array"),
    ([[0.5, 0.5], [1], [1]], [1, 1], {}, "P: is no array"),
    ([[0.5, 0.5]] * 3, [1, 1], {}, "P: 3 rows for 2 states"),
    (np.zeros((2, 3, 4)), [1, 1], {}, "P: shape (2, 3, 4) fits no layout"),
    ([csr_array((2, 3))], [1, 1], {}, "P: the matrix of action 0 has shape (2, 3)"),
    ([], [1, 1], {}, "P: shape (0,) fits no layout"),
    ("missing.drn", None, {}, "P: cannot read"),
    ([[0.5, 0.5], [0, 1]], [1, -2], {}, "cost: state 1, action 0: -2.0; a cost is finite"),
    ([[0.5, 0.5], [0, 1]], [1, math.nan], {}, "cost: state 1, action 0: nan"),
    ([[0.5, 0.5], [0, 1]], [1, 2, 3], {}, "cost: has shape (3,)"),
    ([[0.5, 0.5], [0, 1]], None, {}, "cost: give the costs"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"targets": [2]}, "targets: states are 0..1, not [2]"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"targets": "goal"}, "targets: 'goal' is a label"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"targets": 1}, "targets: 1 stands for one; write a list"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"maximise": "no"}, "maximise: 'no' is not accepted"),
    ([[0.5, 0.5], [0, 1]], np.ma.masked_equal([1, 2], 1), {}, "cost: the numbers are masked"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"targets": [0.5]}, "targets: [0.5] are no states"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"targets": ()}, "targets: no target"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"avoid": [1]},
     "avoid: state 1 is both attractor and avoid"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"maximise": True}, "gamma: 1.0 times the discount"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"layout": "rows"}, "layout: 'rows' is unknown"),
    ([[0.5, 0.5], [0, 1]], [1, 2], {"discount": 1}, "discount"),
    ({0: {0: [(1.0, 0)]}}, None, {}, "P: P[0][0] holds (1.0, 0)"),
    ({0: {0: [(1.0, -1, 0, True)]}}, None, {}, "P: -1 is not a whole number"),
    ({}, None, {}, "P: there is no state"),
    ((np.eye(3)[:2], [0, 0], [1, 1]), [1, 1], {}, "P: state 0, action 1 stands twice"),
    ((np.eye(3)[:2], [0, 5], [0, 0]), [1, 1], {}, "P: there is no state 5; they are 0..2"),
    ((np.eye(2), [0, 1], [0.0, 0.0]), [1, 1], {}, "P: s_indices and a_indices"),
])  # fmt: skip
def test_what_is_refused_is_named(P, cost, more, words):
    with pytest.raises(lm.BadInput, match="^" + re.escape(words)):
        lm.compile(lm.from_matrices(P, cost, **{"targets": [1], **more}))


def test_what_a_finite_model_has_no_place_for(tmp_path):
    problem = lm.from_matrices([[0.5, 0.5], [0, 1]], [1, 0], [1])
    axis = problem.state_box["state"].replaced(cells=3)
    noise = {"w": {"values": [0], "weights": [1]}}
    for change, words in (
        ({"state_box": {"state": axis}}, "state_box: 3 cells; the matrices have 2"),
        ({"noise": noise}, "noise: a finite model has none"),
        ({"control_grid": {"action": {"values": [0, 1]}}}, "control_grid: 2 controls"),
        ({"on_exit": "clip"}, "on_exit: 'clip' moves images into the box, and a finite model"),
        ({"sampling": {"kind": "random", "points": 1}}, "sampling: a finite model is not sampled"),
        ({"sampling": {"kind": "grid", "per_axis": 2}}, "sampling: a finite model is not sampled"),
        ({"stage_cost": None, "cost_rate": "1"}, "cost_rate: a finite model has no time"),
    ):
        with pytest.raises(lm.BadInput, match=re.escape(words)):
            problem.replaced(**change)
    with pytest.raises(lm.BadInput, match="holds no matrices"):
        problem.save(tmp_path / "problem.json")
    with pytest.raises(lm.BadInput, match=r"use lmdsl\.from_matrices"):
        lm.Problem.model_validate({"format": "lmdsl/1", "system": {"kind": "matrices"}})
    with pytest.raises(lm.BadInput, match="no map"):
        lm.plotting.portrait(problem)


def test_keys_of_a_problem_apply():
    """Costs beside the matrices, an end that costs, admissible pairs, avoid."""
    P = np.array([[[0, 1, 0], [0, 0, 1], [0, 0, 1]], [[0, 0, 1], [0, 0, 1], [0, 0, 1]]])
    problem = lm.from_matrices(P, np.array([[1, 5], [1, 5], [0, 0]]), [2])
    assert lm.solve(problem).value.tolist() == pytest.approx([2, 1, 0])
    more = problem.replaced(stage_cost="state + 10*action", terminal_cost="state*4", gamma=0.5)
    # V1 = 1 + 1 + 0.5*8, V0 = 1 + 0 + 0.5 V1
    assert lm.solve(more).value.tolist() == pytest.approx([4, 6, 0])
    with pytest.raises(lm.BadInput, match=r"^stage_cost: the stage cost is -9.0 at state = 1, ac"):
        lm.compile(problem.replaced(stage_cost="-10*state"))
    with pytest.raises(lm.BadInput, match=r"terminal cost is -0\.5 at state = 2"):
        lm.compile(problem.replaced(terminal_cost="-0.5"))  # whatever else is paid
    other = problem.replaced(admissible="state > 0 or action == 1")
    assert lm.solve(other).value.tolist() == pytest.approx([5, 1, 0])
    unsafe = lm.from_matrices(P, np.array([[1, 5], [1, 5], [0, 0]]), [2], avoid=[1])
    found = lm.solve(unsafe)
    assert found.value.tolist() == pytest.approx([5, math.inf, 0])
    assert found.cell_status.tolist() == [1, 5, 0]
    assert problem == pickle.loads(pickle.dumps(problem)) != unsafe
    assert hash(problem) == hash(problem.replaced(name=""))


# chains by elimination --------------------------------------------------------------------------


def solved(matrix, right):
    """Gauss-Jordan elimination in fractions."""
    rows = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for i in range(len(rows)):
        pivot = next(r for r in range(i, len(rows)) if rows[r][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for r in range(len(rows)):
            if r != i and rows[r][i]:
                f = rows[r][i]
                rows[r] = [x - f * y for x, y in zip(rows[r], rows[i], strict=True)]
    return [row[-1] for row in rows]


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 0.7, 1.1]), st.sampled_from([0.5, 0.9]))
@settings(max_examples=25, deadline=None)
def test_chains_by_elimination(seed, gamma, b):
    """V = (I - gamma b P)^-1 G with denominators of each row's own; the bounds hold exactly."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    counts = rng.integers(0, 50, size=(n, n)) + np.eye(n, dtype=int)
    P = [[Fraction(int(c), int(row.sum())) for c in row] for row in counts]
    cost = rng.integers(0, 9, size=n).astype(float)
    goal = [0] if rng.random() < 0.5 else []
    problem = lm.from_matrices(P, cost, goal, gamma=gamma, discount=b)
    result = lm.solve(problem)
    assert result.status == "verified", result.message
    on = [s for s in range(n) if s not in goal]
    rate = Fraction(gamma) * Fraction(b)
    matrix = [[Fraction(int(i == j)) - rate * P[i][j] for j in on] for i in on]
    V = solved(matrix, [Fraction(cost[i]) for i in on])
    for i, exact in zip(on, V, strict=True):
        assert Fraction(float(result.lower[i])) <= exact <= Fraction(float(result.value[i]))
    if goal:
        assert result.value[0] == 0
    if gamma == 1:
        absorbed = solved(matrix, [rate * sum(P[i][j] for j in goal) for i in on])
        mean = sum(absorbed) / len(on)
        assert 1 - result.ended_by_discount == pytest.approx(float(mean), abs=1e-9)


def test_the_best_of_all_policies():
    """Every policy of small random models, by elimination: costs and rewards."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        S, A, b = 3, 2, 0.8
        P = rng.dirichlet(np.ones(S), size=(A, S))
        figure = rng.normal(size=(S, A))
        cost = lm.solve(lm.from_matrices(P, np.abs(figure), discount=b, layout="states"))
        reward = lm.solve(
            lm.from_matrices(P, figure, [2], discount=b, layout="states", maximise=True)
        )
        costs, rewards = [], []
        for policy in np.ndindex(*(A,) * S):
            rows = P[list(policy), np.arange(S)]
            paid = np.abs(figure)[np.arange(S), list(policy)]
            costs.append(np.linalg.solve(np.eye(S) - b * rows, paid))
            earned = figure[:2][np.arange(2), list(policy[:2])]
            rewards.append(np.linalg.solve(np.eye(2) - b * rows[:2, :2], earned))
        np.testing.assert_allclose(cost.value, np.min(costs, axis=0), rtol=1e-9)
        np.testing.assert_allclose(reward.rewards[:2], np.max(rewards, axis=0), rtol=1e-9)


def test_states_are_called_by_their_numbers():
    P = np.zeros((1, 6, 6))
    P[0, :3, 0] = P[0, 3, 2] = P[0, 4, 4] = P[0, 5, 5] = 1
    problem = lm.from_matrices(P, np.ones(6), [0])
    found = lm.explain(problem)
    assert "2 in state 4 to 5" in str(found)
    assert "state in [" not in str(found)
    assert found.why(5).text().startswith("state 5: trapped")
    assert "[3.5, 5.5]" in json.dumps(found.to_dict())
    with pytest.raises(lm.BadInput, match=r"the density is -2\.0 in state 0; it must be finite"):
        lm.compile(problem.replaced(measure={"density": "state - 2"}))
    other = problem.replaced(state_box={"x": {"low": 0, "high": 6, "cells": 6}})
    assert "x in [4, 6]" in str(lm.explain(other))

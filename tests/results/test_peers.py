"""Finite models of other tools: their documented examples, and their tables by hand."""

from __future__ import annotations

import re
from fractions import Fraction

import numpy as np
import pytest
from certificate_files import checked, exported
from problems import doubling, made, steps
from scipy.sparse import csr_array
from tables import STORM, frozen_lake, taxi, value_iteration

import lmdsl as lm
from lmdsl.results.exports import export_drn
from lmdsl.results.result import Result


def good(result, folder):
    """The result is verified, saved, read, verified again, and checked by the script."""
    assert result.status == "verified", result.message
    result.save(folder / "out")
    read = Result.load(folder / "out")
    assert read.problem == result.problem
    assert read.reward == result.reward
    for exact in (False, True):
        found = lm.verify(folder / "out", exact=exact)
        assert found.holds, found.text()
        assert found.same_model
    status, said = checked(exported(result, folder))
    assert status == 0, said
    return result


# QuantEcon's DiscreteDP ------------------------------------------------------------------------

R_PRODUCT = [[5, 10], [-1, -float("inf")]]
Q_PRODUCT = [[(0.5, 0.5), (0, 1)], [(0, 1), (0.5, 0.5)]]
R_PAIRS, Q_PAIRS = [5, 10, -1], [(0.5, 0.5), (0, 1), (0, 1)]
INDICES = ([0, 0, 1], [0, 1, 0])


@pytest.mark.parametrize("form", ["product", "pairs", "sparse pairs"])
def test_quantecon_documented_example(form, tmp_path):
    """DiscreteDP's docstring: sigma = [0, 0], v = [-8.57142857, -20.] at beta = 0.95."""
    if form == "product":
        problem = lm.from_matrices(
            Q_PRODUCT, R_PRODUCT, discount=0.95, layout="product", maximise=True
        )
    else:
        Q = csr_array(np.array(Q_PAIRS)) if "sparse" in form else Q_PAIRS
        problem = lm.from_matrices((Q, *INDICES), R_PAIRS, discount=0.95, maximise=True)
    result = good(lm.solve(problem), tmp_path)
    assert result.control_index.tolist() == [0, 0]
    np.testing.assert_allclose(result.rewards, [-8.57142857, -20.0], rtol=1e-8)
    assert result.reward == pytest.approx((-8.57142857 - 20) / 2)
    assert result.pairs == 3  # the reward of minus infinity is no pair
    assert "discounted, no target" in result.message


# pymdptoolbox ----------------------------------------------------------------------------------


def forest(S=3, r1=4.0, r2=2.0, p=0.1):
    """mdptoolbox.example.forest: wait, or cut."""
    P = np.zeros((2, S, S))
    P[0, :, 0] = p
    P[0, np.arange(S - 1), np.arange(1, S)] = 1 - p
    P[0, -1, -1] = 1 - p
    P[1, :, 0] = 1
    R = np.zeros((S, 2))
    R[-1, 0], R[:, 1], R[0, 1], R[-1, 1] = r1, 1, 0, r2
    return P, R


@pytest.mark.parametrize("sparse", [False, True])
def test_pymdptoolbox_documented_example(sparse, tmp_path):
    """PolicyIteration(P, R, 0.9) of the forest: policy (0, 0, 0), V as documented."""
    P, R = forest()
    matrices = [csr_array(matrix) for matrix in P] if sparse else P
    result = good(lm.solve(lm.from_matrices(matrices, R, discount=0.9, maximise=True)), tmp_path)
    assert result.control_index.tolist() == [0, 0, 0]
    documented = [26.244000000000014, 29.484000000000016, 33.484000000000016]
    np.testing.assert_allclose(result.rewards, documented, rtol=1e-9)


def test_rewards_of_transitions(tmp_path):
    """(A, S, S) rewards, dense and sparse, mean the expected reward of a pair."""
    P, R = forest(5)
    each = np.repeat(R.T[:, :, None], 5, axis=2)
    each[0, :, 0] -= 1.0  # a fire costs
    mean = R.copy()
    mean[:, 0] -= 0.1
    expected = lm.solve(lm.from_matrices(P, mean, discount=0.9, maximise=True))
    for rewards in (each, [csr_array(matrix) for matrix in each]):
        found = lm.solve(lm.from_matrices(P, rewards, discount=0.9, maximise=True))
        np.testing.assert_allclose(found.rewards, expected.rewards, rtol=1e-9)


# madupite --------------------------------------------------------------------------------------


@pytest.mark.parametrize("sparse", [False, True])
def test_madupite_layout(sparse):
    """Row s A + a is state s under action a, costs (S, A), minimised."""
    rng = np.random.default_rng(1)
    S, A = 7, 3
    P = rng.dirichlet(np.ones(S), size=(S, A))
    P[:, :, 2] += P[:, :, 3]
    P[:, :, 3] = 0
    cost = rng.random((S, A))
    rows = P.reshape(S * A, S)
    found = lm.solve(lm.from_matrices(csr_array(rows) if sparse else rows, cost, discount=0.9))
    product = lm.solve(lm.from_matrices(P, cost, discount=0.9, layout="product"))
    states = lm.solve(lm.from_matrices(P.transpose(1, 0, 2), cost, discount=0.9, layout="states"))
    assert found.lp.digest == product.lp.digest == states.lp.digest
    V = np.zeros(S)
    for _ in range(1000):
        V = (cost + 0.9 * P @ V).min(axis=1)
    np.testing.assert_allclose(found.value, V, rtol=1e-9)


# Gymnasium -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["4x4", "8x8"])
def test_frozen_lake(name, tmp_path):
    P = frozen_lake(name)
    problem = lm.from_matrices(P, discount=0.99, maximise=True)
    result = good(lm.solve(problem), tmp_path)
    V, Q = value_iteration(P, 0.99)
    S = len(P)
    assert result.cells == S + 1  # one more, for all that terminates
    np.testing.assert_allclose(result.rewards[:S], V, atol=1e-9)
    chosen = Q[np.arange(S), result.control_index[:S]]
    np.testing.assert_allclose(chosen, V, atol=1e-9)
    runs = result.simulate(4000, 10_000, seed=1)
    assert runs.lost == 0
    away = abs(runs.cost["mean"] - result.cost)  # every run pays for what it misses after its end
    assert runs.reached == 4000
    assert away <= 4 * runs.cost["standard_error"]
    # Where all but the goal's own reward is 0, the reward is the discounted chance to get there.
    assert 0 <= result.reward <= 1


def test_ending_early_never_looks_cheap():
    """A hole beside a long way to the goal: R - r alone would jump into the hole."""
    P = {0: {0: [(1.0, 1, 0.0, False)], 1: [(1.0, 2, 0.0, True)]},
         1: {0: [(1.0, 2, 1.0, True)]}, 2: {0: [(1.0, 2, 0.0, True)]}}  # fmt: skip
    result = lm.solve(lm.from_matrices(P, discount=0.9, maximise=True))
    assert result.control_index[0] == 0
    np.testing.assert_allclose(result.rewards, [0.9, 1.0, 0.0, 0.0], atol=1e-12)


def test_taxi(tmp_path):
    P = taxi()
    result = good(lm.solve(lm.from_matrices(P, discount=0.95, maximise=True)), tmp_path)
    V, _ = value_iteration(P, 0.95)
    np.testing.assert_allclose(result.rewards[:500], V, atol=1e-8)
    runs = result.simulate(500, 200)
    assert (runs.reached, runs.lost) == (500, 0)


@pytest.mark.parametrize("name", ["FrozenLake-v1", "Taxi"])
def test_the_tables_are_those_of_the_package(name):
    gymnasium = pytest.importorskip("gymnasium")
    if name == "Taxi":
        name = max(key for key in gymnasium.registry if key.startswith("Taxi-v"))
    P = gymnasium.make(name).unwrapped.P
    mine = frozen_lake() if "Lake" in name else taxi()
    ours, theirs = (
        lm.solve(lm.from_matrices(table, discount=0.9, maximise=True)) for table in (mine, P)
    )
    np.testing.assert_allclose(ours.rewards, theirs.rewards, rtol=1e-9)
    assert ours.lp.digest == theirs.lp.digest


# Storm -----------------------------------------------------------------------------------------


NOISE = {"w": {"values": [0.1, -0.2, 0.02], "weights": [0.1, 0.2, 0.7]}}
WALK = {"kind": "map", "next": {"x": "0.9*x - 0.25*u + w"}}
NOISY = steps(cost="1 + x**2", system=WALK, noise=NOISE, on_exit="clip",
              state_box={"x": {"low": -2, "high": 2, "cells": 40}},
              attractor={"cells": [[19], [20]]})  # fmt: skip


@pytest.mark.parametrize("data", [steps(), doubling(), NOISY, {**NOISY, "discount": 0.9}])
def test_our_own_drn_read_back(data, tmp_path):
    """The same pairs, exact rows and costs; the digest is that of the same model written again."""
    lp = lm.compile(made(data))
    export_drn(lp, tmp_path / "model.drn")
    labels = ["attractor"] + ["ended"] * ("discount" in data)
    problem = lm.from_matrices(tmp_path / "model.drn", targets=labels)
    again = lm.compile(problem)
    assert (again.n, again.K) == (lp.n, lp.K)
    np.testing.assert_array_equal(again.control, lp.control)
    np.testing.assert_array_equal(again.pair_pointer, lp.pair_pointer)
    np.testing.assert_array_equal(again.cost, lp.cost)
    for k in range(lp.K):
        assert row(again, k) == row(lp, k)
    if "discount" in data:  # two states that absorb, which are one when written again
        return
    export_drn(again, tmp_path / "again.drn")
    once = lm.compile(lm.from_matrices(tmp_path / "again.drn", targets="attractor"))
    assert once.digest == again.digest
    a, b = lm.solve(lp), lm.solve(again)
    assert a.status == b.status == "verified"
    np.testing.assert_allclose(b.value[again.cells], a.value[lp.cells], rtol=1e-12)


def test_initial_states_are_read_back(tmp_path):
    data = steps(measure={"boxes": [{"x": [0.25, 0.5]}, {"x": [0.75, 1]}]})
    result = lm.solve(made(data))
    export_drn(result.lp, tmp_path / "model.drn")
    again = lm.solve(lm.from_matrices(tmp_path / "model.drn", targets="attractor"))
    assert again.lp.weight.tolist() == result.lp.weight.tolist() == [0.5, 0, 0.5]
    assert again.cost == pytest.approx(result.cost)


def row(lp, k):
    found: dict[int, Fraction] = {}
    for j, c in lp.rows.exact(k):
        found[j] = found.get(j, Fraction(0)) + Fraction(c, lp.rows.total(k))
    return found


def test_a_file_of_storm(tmp_path):
    path = tmp_path / "model.drn"
    path.write_text(STORM)
    with pytest.raises(lm.BadInput, match="reward models"):
        lm.from_matrices(path, targets="done")
    result = lm.solve(lm.from_matrices(path, "energy", targets="done"))
    # V0 = 1 + 0.5 + 0.3 V1 (going), V1 = 2 + V0/3
    V0 = (1.5 + 0.6) / (1 - 0.1)
    assert result.cost == pytest.approx(V0)  # runs begin in the state labelled init
    np.testing.assert_allclose(result.value, [V0, 2 + V0 / 3, 0], rtol=1e-8)
    steps_ = lm.solve(lm.from_matrices(str(path), "steps", targets=[2]))
    np.testing.assert_allclose(steps_.value[:2], [1.3 / 0.9, 1 + 1.3 / 2.7], rtol=1e-8)
    with pytest.raises(lm.BadInput, match="targets: no state has the label 'goal'"):
        lm.from_matrices(path, "steps", targets="goal")


def test_a_reward_model_without_a_name(tmp_path):
    """Storm writes a blank for its name; what is paid counts all the same."""
    path = tmp_path / "model.drn"
    text = STORM.replace("steps energy\n", " \n")
    path.write_text(text.replace("[0, 1]", "[1]").replace("[1, ", "[").replace("[0, 0]", "[0]"))
    result = lm.solve(lm.from_matrices(path, targets="done"))
    V0 = (1.5 + 0.6) / (1 - 0.1)  # as above
    np.testing.assert_allclose(result.value, [V0, 2 + V0 / 3, 0], rtol=1e-8)
    with pytest.raises(lm.BadInput, match="'steps' is no reward model of the file; it has none"):
        lm.from_matrices(path, "steps", targets="done")
    path.write_text(text)
    with pytest.raises(lm.BadInput, match="2 rewards for 1 reward models; give each a name"):
        lm.from_matrices(path, targets="done")


@pytest.mark.parametrize(("old", "new", "words"), [
    ("@type: MDP", "@type: CTMC", "line 3: the type is 'CTMC'"),
    ("@parameters\n\n", "@parameters\np q\n", "parameters have no values"),
    ("1 : 0.3\n", "1 : p\n", "'p' is no number"),
    ("1 : 0.3\n", "1 : 1e999999999\n", "is no number"),
    ("1 : 0.3\n", "1 : 1/0\n", "divides by 0"),
    ("1 : 0.3\n", "7 : 0.3\n", "there is no state 7; they are 0..2"),
    ("1 : 0.3\n", "1 : 0.4\n", "state 0 (init), action 0: the probabilities sum to"),
    ("state 1 ", "state 5 ", "state '5' where 1 is expected"),
    ("[1, 0.5]", "[1]", "1 rewards for 2 reward models"),
    ("[1, 0.5]", "[1, -5]", "cost: state 0 (init), action 0: -4.0; a cost is finite and >= 0"),
    ("@model\n", "", "is not expected here"),
    ("@nr_states\n3", "@nr_states\n4", "line 9: @nr_states says '4', but the file has 3 states"),
    ("@nr_choices\n4", "@nr_choices\n5", "@nr_choices says '5', but the file has 4 choices"),
    ("@nr_choices\n4", "@nr_choices\nmany", "@nr_choices says 'many', but the file has 4"),
])  # fmt: skip
def test_bad_files_of_storm(old, new, words, tmp_path):
    path = tmp_path / "model.drn"
    path.write_text(STORM.replace(old, new, 1))
    with pytest.raises(lm.BadInput, match=re.escape(words)):
        lm.from_matrices(path, "energy", targets=[2])

"""The packages whose models are read, asked themselves: their examples, and models at random.

Each test runs where its package is installed: the extra ``peers`` names them.
"""

from __future__ import annotations

import numpy as np
import pytest
from tables import value_iteration

import lmdsl as lm

# QuantEcon -------------------------------------------------------------------------------------


def quantecon_example(markov):
    """The two ways of stating Puterman's example that the docstring of DiscreteDP shows."""
    R, Q = [[5, 10], [-1, -float("inf")]], [[(0.5, 0.5), (0, 1)], [(0, 1), (0.5, 0.5)]]
    yield (
        markov.DiscreteDP(R, Q, 0.95),
        lm.from_matrices(Q, R, discount=0.95, layout="product", maximise=True),
    )
    R, Q, at = [5, 10, -1], [(0.5, 0.5), (0, 1), (0, 1)], ([0, 0, 1], [0, 1, 0])
    yield (
        markov.DiscreteDP(R, Q, 0.95, *at),
        lm.from_matrices((Q, *at), R, discount=0.95, maximise=True),
    )


def test_quantecon_documented_example():
    markov = pytest.importorskip("quantecon.markov", reason="QuantEcon is not installed")
    for theirs, problem in quantecon_example(markov):
        found, ours = theirs.solve(method="policy_iteration", v_init=[0, 0]), lm.solve(problem)
        # As printed in the docstring.
        assert found.sigma.tolist() == [0, 0]
        np.testing.assert_allclose(found.v, [-8.57142857, -20.0], atol=5e-9)
        assert ours.status == "verified"
        assert ours.control_index.tolist() == found.sigma.tolist()
        np.testing.assert_allclose(ours.rewards, found.v, rtol=1e-9)


@pytest.mark.parametrize("sparse", [False, True])
def test_quantecon_at_random(sparse):
    """Their own random models, as matrices of pairs."""
    markov = pytest.importorskip("quantecon.markov", reason="QuantEcon is not installed")
    for seed in range(10):
        theirs = markov.random_discrete_dp(
            12, 4, beta=0.9, k=3, sparse=sparse, sa_pair=True, random_state=seed
        )
        found = theirs.solve(method="policy_iteration")
        triple = (theirs.Q, theirs.s_indices, theirs.a_indices)
        ours = lm.solve(lm.from_matrices(triple, theirs.R, discount=theirs.beta, maximise=True))
        assert ours.status == "verified"
        assert ours.control_index.tolist() == found.sigma.tolist()
        np.testing.assert_allclose(ours.rewards, found.v, rtol=1e-8)


# pymdptoolbox ----------------------------------------------------------------------------------


def answers(mdp, P, R, discount, least=0.0):
    """Theirs and ours; ``least`` is what their answer may lack of the best."""
    mdp.run()
    ours = lm.solve(lm.from_matrices(P, R, discount=discount, maximise=True))
    assert ours.status == "verified"
    np.testing.assert_allclose(ours.rewards, mdp.V, rtol=1e-9, atol=least)
    assert ours.control_index.tolist() == list(mdp.policy)
    return ours


@pytest.mark.parametrize("sparse", [False, True])
def test_pymdptoolbox_documented_examples(sparse):
    mdptoolbox = pytest.importorskip("mdptoolbox", reason="pymdptoolbox is not installed")
    example = pytest.importorskip("mdptoolbox.example")
    P, R = example.forest(is_sparse=sparse)
    ours = answers(mdptoolbox.mdp.PolicyIteration(P, R, 0.9), P, R, 0.9)
    # As printed in the docstring of PolicyIteration.
    assert ours.control_index.tolist() == [0, 0, 0]
    np.testing.assert_allclose(ours.rewards, (26.244, 29.484, 33.484), rtol=1e-9)
    # Of ValueIteration, which stops within 0.01 of the best in the span of V.
    P = np.array([[[0.5, 0.5], [0.8, 0.2]], [[0, 1], [0.1, 0.9]]])
    R = np.array([[5, 10], [-1, 2]])
    theirs = mdptoolbox.mdp.ValueIteration(P, R, 0.9)
    theirs.run()
    np.testing.assert_allclose(theirs.V, (40.048625392716815, 33.65371175967546), rtol=1e-12)
    ours = lm.solve(lm.from_matrices(P, R, discount=0.9, layout="states", maximise=True))
    assert ours.control_index.tolist() == list(theirs.policy) == [1, 0]
    np.testing.assert_allclose(np.diff(ours.rewards), np.diff(theirs.V), atol=0.01)


def test_pymdptoolbox_at_random():
    mdptoolbox = pytest.importorskip("mdptoolbox", reason="pymdptoolbox is not installed")
    example = pytest.importorskip("mdptoolbox.example")
    for seed in range(10):
        np.random.seed(seed)  # noqa: NPY002 -- they draw from NumPy's global numbers
        P, R = example.rand(8, 3)  # rewards of transitions, (A, S, S)
        answers(mdptoolbox.mdp.PolicyIteration(P, R, 0.9), P, R, 0.9)


# Gymnasium -------------------------------------------------------------------------------------

WORLDS = [("FrozenLake-v1", {}), ("FrozenLake-v1", {"map_name": "8x8"}),
          ("FrozenLake-v1", {"is_slippery": False}), ("CliffWalking", {}), ("Taxi", {}),
          ("Taxi", {"is_rainy": True})]  # fmt: skip


@pytest.mark.parametrize(("name", "options"), WORLDS)
def test_gymnasium_tables(name, options):
    """Value iteration by hand on the package's own table finds the same."""
    gymnasium = pytest.importorskip("gymnasium", reason="Gymnasium is not installed")
    name = max(key for key in gymnasium.registry if key.startswith(name))
    P = gymnasium.make(name, **options).unwrapped.P
    result = lm.solve(lm.from_matrices(P, discount=0.95, maximise=True))
    assert result.status == "verified"
    V, Q = value_iteration(P, 0.95)
    np.testing.assert_allclose(result.rewards[: len(P)], V, atol=1e-8)
    chosen = Q[np.arange(len(P)), result.control_index[: len(P)]]
    np.testing.assert_allclose(chosen, V, atol=1e-8)

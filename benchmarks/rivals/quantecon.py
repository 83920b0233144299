"""QuantEcon's DiscreteDP in the sparse state-action form; it maximises, so the reward is -G."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.arrays import Arrays, with_attractor
from benchmarks.rivals.base import Contestant

METHODS = ("value_iteration", "policy_iteration", "modified_policy_iteration", "linear_programming")
CONTESTANTS = [
    Contestant(f"QuantEcon {m.replace('_', ' ')}", __name__, m, "quantecon", "below one")
    for m in METHODS
]


class Solver:
    """The attractor is one more state that pays nothing for ever."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        from quantecon.markov import DiscreteDP
        from scipy.sparse import csr_matrix

        pointer, target, share = with_attractor(model)
        self.n, self.algorithm = model.n, algorithm
        self.epsilon = model.precision
        self.problem = DiscreteDP(
            np.append(-model.cost, 0.0),
            csr_matrix((share, target, pointer), shape=(model.K + 1, model.n + 1)),
            model.gamma,
            np.append(model.cell, model.n),
            np.append(model.control, 0).astype(np.int64),
        )
        self.found: Any = None

    def renew(self) -> None:
        self.found = None

    def solve(self) -> None:
        self.found = self.problem.solve(self.algorithm, epsilon=self.epsilon, max_iter=10**6)

    def value(self) -> np.ndarray:
        return -self.found.v[: self.n]

"""Value iteration in a dozen lines of NumPy and SciPy, as anyone would write it."""

from __future__ import annotations

import numpy as np

from benchmarks.arrays import Arrays
from benchmarks.rivals.base import Contestant

CONTESTANTS = [
    Contestant("NumPy value iteration", __name__, note="until V changes by less than 1e-9 relative")
]


class Solver:
    """V <- min_a G_a + gamma P_a V from 0; the matrix carries gamma."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        self.M = model.gamma * model.P
        self.first, self.cost = model.pair_pointer[:-1], model.cost
        self.V = np.zeros(model.n)

    def renew(self) -> None:
        self.V = np.zeros_like(self.V)

    def solve(self) -> None:
        V = self.V
        while True:
            new = np.minimum.reduceat(self.cost + self.M @ V, self.first)
            change = np.abs(new - V)
            V = new
            if (change <= 1e-9 * V).all():
                break
        self.V = V

    def value(self) -> np.ndarray:
        return self.V

"""mdpsolver; it maximises, so the reward is -G. A cold model for every solve: it warm-starts."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.arrays import Arrays, with_attractor
from benchmarks.rivals.base import Contestant

OPTIONS: dict[str, dict[str, Any]] = {
    "modified policy iteration": {"algorithm": "mpi", "parallel": False},
    "modified policy iteration, Gauss-Seidel": {
        "algorithm": "mpi", "update": "gs", "parallel": False,
    },
    "modified policy iteration, threads": {"algorithm": "mpi", "parallel": True},
    "value iteration": {"algorithm": "vi", "parallel": False},
    "policy iteration": {"algorithm": "pi", "parallel": False},
}  # fmt: skip
CONTESTANTS = [
    Contestant(f"mdpsolver {name}", __name__, name, "mdpsolver", "below one") for name in OPTIONS
]


class Solver:
    """Rewards, probabilities and columns as lists of lists, the form it takes."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        import mdpsolver

        self.make = mdpsolver.model
        self.n, self.tolerance, self.options = model.n, model.precision, OPTIONS[algorithm]
        pointer, target, share = with_attractor(model)
        cells = np.append(model.pair_pointer, model.K + 1).tolist()
        per_pair = [_cut(array.tolist(), pointer.tolist()) for array in (share, target)]
        self.data = {
            "discount": model.gamma,
            "rewards": _cut(np.append(-model.cost, 0.0).tolist(), cells),
            "tranMatProbs": _cut(per_pair[0], cells),
            "tranMatColumns": _cut(per_pair[1], cells),
        }
        self.model: Any = None

    def renew(self) -> None:
        self.model = self.make()
        self.model.mdp(**self.data)

    def solve(self) -> None:
        self.model.solve(tolerance=self.tolerance, **self.options)

    def value(self) -> np.ndarray:
        return -np.array(self.model.getValueVector())[: self.n]


def _cut(values: list[Any], ends: list[int]) -> list[list[Any]]:
    return [values[a:b] for a, b in pairwise(ends)]

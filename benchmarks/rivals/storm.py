"""Storm through stormpy 2: expected cost to the attractor at gamma 1, relative precision 1e-9."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.arrays import Arrays, with_attractor
from benchmarks.rivals.base import Contestant

SOUND = {
    "OPTIMISTIC_VALUE_ITERATION": "optimistic value iteration",
    "SOUND_VALUE_ITERATION": "sound value iteration",
    "INTERVAL_ITERATION": "interval iteration",
    "TOPOLOGICAL": "topological",
}
CONTESTANTS = [
    Contestant(
        "Storm value iteration", __name__, "VALUE_ITERATION", "stormpy", "one", note="not sound"
    ),
    *(
        Contestant(f"Storm {words}", __name__, method, "stormpy", "one", 1e-8, "sound")
        for method, words in SOUND.items()
    ),
]


class Solver:
    """A sparse MDP made once; the graph analysis Storm does on each check is part of the solve."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        import stormpy
        from stormpy import environments

        self.stormpy, self.n = stormpy, model.n
        self.mdp = _mdp(model)
        self.formula = stormpy.parse_properties('R{"cost"}min=? [F "attractor"]')[0]
        self.environment = environments.Environment()
        solver = self.environment.solver()
        solver.force_soundness = algorithm in SOUND
        min_max = solver.min_max()
        min_max.method = getattr(environments.MinMaxMethod, algorithm)
        min_max.precision = stormpy.Rational("1/1000000000")
        min_max.relative_termination_criterion = True
        self.found: Any = None

    def renew(self) -> None:
        self.found = None

    def solve(self) -> None:
        self.found = self.stormpy.model_checking(
            self.mdp, self.formula, environment=self.environment
        )

    def value(self) -> np.ndarray:
        values = getattr(self.found, "get_value_vector", None) or self.found.get_values
        return np.array(values(), dtype=np.float64)[: self.n]


def _mdp(model: Arrays) -> Any:
    from stormpy import datastructures, models

    pointer, target, share = with_attractor(model)
    K, n = model.K + 1, model.n + 1
    builder = datastructures.SparseMatrixBuilder[float](
        rows=K, columns=n, entries=len(share), has_custom_row_grouping=True, row_groups=n
    )
    row = np.repeat(np.arange(K), np.diff(pointer))
    builder.add_next_values(row, target, share, model.pair_pointer)
    labels = models.StateLabeling(n)
    for label in ("init", "attractor"):
        labels.add_label(label)
    labels.add_label_to_state("init", 0)
    labels.add_label_to_state("attractor", n - 1)
    cost = models.SparseRewardModel[float](
        optional_state_action_reward_vector=np.append(model.cost, 0.0)
    )
    return models.SparseMdp[float](
        models.SparseModelComponents[float](
            transition_matrix=builder.build(), state_labeling=labels, reward_models={"cost": cost}
        )
    )

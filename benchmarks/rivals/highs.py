"""HiGHS through bare highspy on A, b, c; b is one in every cell, so that V does not change."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.arrays import Arrays
from benchmarks.rivals.base import Contestant

OPTIONS: dict[str, dict[str, Any]] = {
    "simplex": {"solver": "simplex"},
    "IPX": {"solver": "ipx", "run_crossover": "off"},
    "IPX with crossover": {"solver": "ipx", "run_crossover": "on"},
    "HiPO": {"solver": "hipo", "run_crossover": "off"},
    "PDLP": {"solver": "pdlp", "pdlp_optimality_tolerance": 1e-9},
}
LOOSE = {"PDLP": 1e-5}
CONTESTANTS = [
    Contestant(f"HiGHS {name}", __name__, name, "highspy", "own", LOOSE.get(name, 1e-6))
    for name in OPTIONS
]


class Solver:
    """The model is passed outside the clock; ``run`` starts from nothing."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        import highspy

        self.highspy, self.options = highspy, OPTIONS[algorithm]
        self.A, self.cost = model.A, model.cost
        self.highs: Any = None

    def renew(self) -> None:
        n, K = self.A.shape
        self.highs = self.highspy.Highs()
        self._set("output_flag", False)
        for name, value in self.options.items():
            self._set(name, value)
        lp = self.highspy.HighsLp()
        lp.num_row_, lp.num_col_ = n, K
        lp.col_cost_, lp.col_lower_, lp.col_upper_ = self.cost, np.zeros(K), np.full(K, np.inf)
        lp.row_lower_ = lp.row_upper_ = np.ones(n)
        lp.a_matrix_.format_ = self.highspy.MatrixFormat.kColwise
        lp.a_matrix_.start_, lp.a_matrix_.index_ = self.A.indptr, self.A.indices
        lp.a_matrix_.value_ = self.A.data
        self.highs.passModel(lp)

    def _set(self, name: str, value: Any) -> None:
        if self.highs.setOptionValue(name, value).name == "kError":
            raise NotImplementedError(f"this highspy has no {name} = {value}")

    def solve(self) -> None:
        self.highs.run()

    def value(self) -> np.ndarray:
        status = self.highs.getModelStatus().name
        if status != "kOptimal":
            raise RuntimeError(f"HiGHS stopped with {status}")
        return np.array(self.highs.getSolution().row_dual)

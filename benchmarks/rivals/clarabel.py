"""Clarabel on A, b, c in the primal and the dual form, with its default tolerances (1e-8)."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.arrays import Arrays
from benchmarks.rivals.base import Contestant

CONTESTANTS = [
    Contestant(f"Clarabel {form}, {method}", __name__, f"{form} {method}", "clarabel", "own")
    for form in ("primal", "dual")
    for method in ("faer", "qdldl")
]


class Solver:
    """Primal: A x = 1, x >= 0. Dual: max 1'V, A'V <= c."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        import clarabel
        from scipy.sparse import csc_array, eye_array, vstack

        self.clarabel, self.n = clarabel, model.n
        form, method = algorithm.split()
        self.dual = form == "dual"
        A, n, K = model.A, model.n, model.K
        none = clarabel.NonnegativeConeT(K)
        if self.dual:
            self.form = (csc_array((n, n)), -np.ones(n), A.T.tocsc(), model.cost, [none])
        else:
            rows = vstack([A, -eye_array(K)]).tocsc()
            right = np.append(np.ones(n), np.zeros(K))
            cones = [clarabel.ZeroConeT(n), none]
            self.form = (csc_array((K, K)), model.cost, rows, right, cones)
        self.settings = clarabel.DefaultSettings()
        self.settings.verbose = False
        self.settings.direct_solve_method = method
        self.found: Any = None

    def renew(self) -> None:
        self.found = None

    def solve(self) -> None:
        self.found = self.clarabel.DefaultSolver(*self.form, self.settings).solve()

    def value(self) -> np.ndarray:
        if str(self.found.status) not in ("Solved", "AlmostSolved"):
            raise RuntimeError(f"Clarabel stopped with {self.found.status}")
        return np.array(self.found.x) if self.dual else -np.array(self.found.z[: self.n])

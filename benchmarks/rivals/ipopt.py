"""IPOPT, the paper's solver, through casadi, with constant derivatives and Mehrotra's algorithm."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.arrays import Arrays
from benchmarks.rivals.base import Contestant

CONTESTANTS = [
    Contestant("IPOPT", __name__, "mehrotra", "casadi", "own", 1e-3, "casadi's build, MUMPS")
]

OPTIONS = {
    "print_level": 0,
    "sb": "yes",
    "mehrotra_algorithm": "yes",
    "tol": 1e-9,
    "max_iter": 500,
    "jac_c_constant": "yes",
    "hessian_constant": "yes",
}


class Solver:
    """min c'x, A x = 1, x >= 0; V is minus its multiplier."""

    def __init__(self, model: Arrays, algorithm: str) -> None:
        import casadi

        A = model.A
        n, K = A.shape
        pattern = casadi.Sparsity(n, K, A.indptr.tolist(), A.indices.tolist())
        A, c = casadi.DM(pattern, A.data), casadi.DM(model.cost)
        x, p = casadi.MX.sym("x", K), casadi.MX.sym("p", 0)
        on_f, on_g = casadi.MX.sym("on_f"), casadi.MX.sym("on_g", n)
        f, g = casadi.dot(c, x), casadi.mtimes(A, x)
        # Handed over, for casadi would differentiate A x column by column.
        derivatives = {
            "grad_f": ([x, p], [f, casadi.MX(c)], ["x", "p"], ["f", "grad_f_x"]),
            "jac_g": ([x, p], [g, casadi.MX(A)], ["x", "p"], ["g", "jac_g_x"]),
            "hess_lag": (
                [x, p, on_f, on_g],
                [casadi.MX(K, K)],
                ["x", "p", "lam_f", "lam_g"],
                ["triu_hess_gamma_x_x"],
            ),
        }
        functions = {name: casadi.Function(name, *parts) for name, parts in derivatives.items()}
        options = {"print_time": False, "ipopt": OPTIONS, **functions}
        self.solver = casadi.nlpsol("lp", "ipopt", {"x": x, "f": f, "g": g}, options)
        self.found: Any = None

    def renew(self) -> None:
        self.found = None

    def solve(self) -> None:
        self.found = self.solver(x0=1, lbx=0, ubx=np.inf, lbg=1, ubg=1)

    def value(self) -> np.ndarray:
        status = self.solver.stats()["return_status"]
        if status not in ("Solve_Succeeded", "Solved_To_Acceptable_Level"):
            raise RuntimeError(f"IPOPT stopped with {status}")
        return -np.array(self.found["lam_g"]).ravel()

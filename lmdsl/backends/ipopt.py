"""Ipopt through CasADi: Mehrotra's predictor-corrector algorithm, the solver of the paper.

A nonlinear solver gets the LP with its derivatives, which are constant: gradient c, Jacobian A, no
Hessian. On an LP without a solution Mehrotra's multipliers grow without end, and Ipopt has no word
for it; where they prove that there is none (A'V <= 0 < b'V up to rounding) that is said.
Standard map, gamma 1.02, 50 x 50 cells, two shared cores: about ten times as long as HiGHS IPX, V
good to 1e-9.

Ipopt's multiplier y of A x = b has the sign of c'x + y'(A x - b): V = -y.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

import numpy as np

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.backends.scaled import ScaledLP, failure

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP

# Options always passed.
FIXED = {
    "mehrotra_algorithm": "yes",
    "jac_c_constant": "yes",
    "hessian_constant": "yes",
    "bound_relax_factor": 0.0,  # else theta >= -1e-8
    "print_level": 0,
    "sb": "yes",
}

# The default, and the relative tolerance below which no smaller one is passed on.
TOLERANCE, LEAST_TOLERANCE = 1e-9, 1e-12
ITERATIONS, MOST_ITERATIONS = 500, 2**31 - 1  # our limit, and the largest that Ipopt takes

RAY = 1e-9  # largest entry of A'y that counts as zero where the largest of y is 1

FAILURES = (
    "Search_Direction_Becomes_Too_Small", "Diverging_Iterates", "Feasible_Point_Found",
    "Restoration_Failed", "Error_In_Step_Computation", "Not_Enough_Degrees_Of_Freedom",
    "Invalid_Problem_Definition", "Invalid_Option", "Invalid_Number_Detected",
    "Unrecoverable_Exception", "NonIpopt_Exception_Thrown", "Insufficient_Memory", "Internal_Error",
)  # fmt: skip
# Every ApplicationReturnStatus by CasADi's name; one not listed is a failure.
STOPS = {
    "Solve_Succeeded": Stop.OPTIMAL,
    "Solved_To_Acceptable_Level": Stop.INACCURATE,
    "Infeasible_Problem_Detected": Stop.INFEASIBLE,
    "User_Requested_Stop": Stop.INTERRUPTED,
    "Maximum_Iterations_Exceeded": Stop.ITERATION_LIMIT,
    "Maximum_CpuTime_Exceeded": Stop.TIME_LIMIT,
    "Maximum_WallTime_Exceeded": Stop.TIME_LIMIT,
    **dict.fromkeys(FAILURES, Stop.FAILED),
}


def solve(lp: StabilizationLP, options: Options) -> Solution:
    """Solve with Ipopt."""
    return ScaledLP.of(lp).solved(_solved, options)


def _solved(scaled: ScaledLP, options: Options) -> Solution:
    import casadi

    try:
        solver = _solver(casadi, scaled.A, scaled.c, _options(options, scaled))
        with _interruptible():
            found = solver(x0=1, lbx=0, ubx=np.inf, lbg=scaled.b, ubg=scaled.b)
        stats = solver.stats()
        y, x = -np.array(found["lam_g"]).ravel(), np.array(found["x"]).ravel()
    except BaseException as error:
        return failure(error)
    word = stats["return_status"]
    stop = STOPS.get(word, Stop.FAILED)
    if not stop.success and _proves_infeasible(scaled, y):
        stop = Stop.INFEASIBLE
    return scaled.solution(stop, word, y, x, stats["iter_count"])


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt where Ctrl-C ended Ipopt: CasADi takes it for a failure.

    So it is where Ipopt runs in this process.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    seen = []

    def note(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        before(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if seen:
        raise KeyboardInterrupt


def _proves_infeasible(scaled: ScaledLP, y: Any) -> bool:
    """Return whether y is a Farkas ray: A'y <= 0 < b'y, so that no x >= 0 has A x = b."""
    top = np.abs(y).max(initial=0.0)
    if not 0 < top < np.inf:
        return False
    ray = y / top
    return bool((scaled.A.T @ ray).max() <= RAY < scaled.b @ ray)


def _solver(casadi: Any, A: Any, c: Any, options: dict[str, Any]) -> Any:
    """Return the solver of min c'x, A x = b, x >= 0, with b to be given.

    The derivatives are handed over, for CasADi would make them column by column.
    """
    n, K = A.shape
    pattern = casadi.Sparsity(n, K, A.indptr.tolist(), A.indices.tolist())
    A, c = casadi.DM(pattern, A.data), casadi.DM(c)
    x, p = casadi.MX.sym("x", K), casadi.MX.sym("p", 0)
    on_f, on_g = casadi.MX.sym("on_f"), casadi.MX.sym("on_g", n)
    f, g = casadi.dot(c, x), casadi.densify(casadi.mtimes(A, x))
    lagrangian = [x, p, on_f, on_g], [casadi.MX(K, K)], ["x", "p", "lam_f", "lam_g"]
    derivatives = {
        "grad_f": ([x, p], [f, casadi.MX(c)], ["x", "p"], ["f", "grad_f_x"]),
        "jac_g": ([x, p], [g, casadi.MX(A)], ["x", "p"], ["g", "jac_g_x"]),
        "hess_lag": (*lagrangian, ["triu_hess_gamma_x_x"]),
    }
    functions = {name: casadi.Function(name, *parts) for name, parts in derivatives.items()}
    settings = {"print_time": False, "ipopt": FIXED | options, **functions}
    return casadi.nlpsol("lp", "ipopt", {"x": x, "f": f, "g": g}, settings)


def _options(options: Options, scaled: ScaledLP) -> dict[str, Any]:
    wanted = TOLERANCE if options.tolerance is None else min(TOLERANCE, options.tolerance / 10)
    most = ITERATIONS if options.max_iterations is None else options.max_iterations
    passed: dict[str, Any] = {
        "tol": max(wanted, LEAST_TOLERANCE),
        "max_iter": min(max(most, 0), MOST_ITERATIONS),
    }
    seconds = scaled.seconds_left(options.time_limit)
    if seconds is not None:
        passed["max_wall_time"] = max(seconds, 1e-9)
    return passed


BACKEND = Backend(
    "ipopt", solve, Capabilities(algorithms=("mehrotra",), elimination=True), ("casadi",)
)

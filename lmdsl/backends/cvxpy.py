"""CVXPY: the primal LP in matrices, for any solver that CVXPY finds installed.

``cvxpy:NAME`` names the solver, in any case. The default is HiGHS. Standard map, gamma 1.02,
50 x 50 cells, two shared cores, times relative to it: SciPy 1.8, SCS 3.5, Clarabel 6 to 7.
HiGHS and SciPy are told to use the interior point, not the simplex that they choose unasked.

CVXPY's multiplier y of A x = b has the sign of c'x + y'(A x - b): V = -y. It has no word for which
limit was reached, and for some solvers calls a limit "optimal_inaccurate"; see ``_stop``.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.backends.scaled import ScaledLP, failure
from lmdsl.errors import BadInput, shown
from lmdsl.machine import quiet
from lmdsl.machine.forking import forked

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP

PREFERRED = ("HIGHS", "CLARABEL", "SCIPY")  # the first of these that is installed is the default

# Every status of cvxpy.settings; one not listed is a failure.
STOPS = {
    "optimal": Stop.OPTIMAL,
    "optimal_inaccurate": Stop.INACCURATE,
    "infeasible": Stop.INFEASIBLE,
    "infeasible_inaccurate": Stop.INFEASIBLE,
    "unbounded": Stop.UNBOUNDED,
    "unbounded_inaccurate": Stop.UNBOUNDED,
    "infeasible_or_unbounded": Stop.INFEASIBLE,  # costs are >= 0: it cannot be unbounded
    "user_limit": Stop.ITERATION_LIMIT,
    "solver_error": Stop.FAILED,
}

# Solvers of which "optimal_inaccurate" means that a limit was reached, their own included.
INACCURATE_IS_LIMIT = ("OSQP", "SCIPY", "SCS")

# Options always passed.
FIXED = {
    "HIGHS": {"solver": "ipx", "run_crossover": "off"},
    "SCIPY": {"method": "highs-ipm"},
}

# Solvers that take their options as one dictionary of this name.
NESTED = {"HIGHS": "highs_options", "SCIPY": "scipy_options"}

TIME_LIMIT = {
    "CLARABEL": "time_limit",
    "HIGHS": "time_limit",
    "OSQP": "time_limit",
    "SCIPY": "time_limit",
    "SCS": "time_limit_secs",
}
ITERATION_LIMIT = {
    "CLARABEL": ("max_iter",),
    "HIGHS": ("ipm_iteration_limit", "simplex_iteration_limit"),
    "OSQP": ("max_iter",),
    "SCIPY": ("maxiter",),
    "SCS": ("max_iters",),
}
# Our default and the options it sets; no default is looser than CVXPY's.
TOLERANCE = {
    "CLARABEL": (1e-8, ("tol_gap_abs", "tol_gap_rel", "tol_feas")),
    "HIGHS": (1e-8, ("ipm_optimality_tolerance",)),
    "OSQP": (1e-5, ("eps_abs", "eps_rel")),
    "SCIPY": (1e-8, ("ipm_optimality_tolerance",)),
    "SCS": (1e-7, ("eps_abs", "eps_rel")),
}

LEAST_TOLERANCE = 1e-12  # tolerance below which no smaller one is passed on


def solve(lp: StabilizationLP, options: Options) -> Solution:
    """Solve with a solver of CVXPY; BadInput where CVXPY does not find it."""
    return ScaledLP.of(lp).solved(_solved, options)


def _solved(scaled: ScaledLP, options: Options) -> Solution:
    with warnings.catch_warnings(), quiet.foreign():
        warnings.simplefilter("ignore")
        import cvxpy

        solver = _solver(cvxpy, options.algorithm)
        if scaled.time_up(options.time_limit):
            return scaled.out_of_time()
        passed, unsupported = _passed(solver, options, scaled.seconds_left(options.time_limit))
        details = {"solver": solver}
        if unsupported:
            details["not supported"] = ", ".join(unsupported)
        try:
            x = cvxpy.Variable(len(scaled.c), nonneg=True)
            balance = scaled.A @ x == scaled.b
            problem = cvxpy.Problem(cvxpy.Minimize(scaled.c @ x), [balance])
            problem.solve(solver=solver, **passed)
        except BaseException as error:
            failed = failure(error)
            if not scaled.time_up(options.time_limit):
                return Solution(Stop.FAILED, failed.word, details=details)
            return Solution(Stop.TIME_LIMIT, failed.word, details=details)
    iterations = problem.solver_stats.num_iters
    time_up = scaled.time_up(options.time_limit)
    stop = _stop(problem.status, solver, iterations, options.max_iterations, time_up)
    y = None if balance.dual_value is None else -balance.dual_value
    return scaled.solution(stop, problem.status, y, x.value, iterations, details)


def _solver(cvxpy: Any, asked: str | None) -> str:
    installed = cvxpy.installed_solvers()
    if asked is None:
        return next((name for name in PREFERRED if name in installed), installed[0])
    if asked.upper() not in installed:
        raise BadInput(
            f"{shown(asked)} is not a solver that cvxpy finds; it has {', '.join(installed)}",
            "backend",
        )
    return asked.upper()


def _passed(
    solver: str, options: Options, seconds: float | None
) -> tuple[dict[str, Any], list[str]]:
    """Return the keywords of ``Problem.solve``, and the options that the solver does not get."""
    passed: dict[str, Any] = dict(FIXED.get(solver, {}))
    unsupported = []
    if solver == "CLARABEL" and forked():
        passed["direct_solve_method"] = "qdldl"  # its default may wait for threads that are gone
    if seconds is not None:
        if solver in TIME_LIMIT:
            passed[TIME_LIMIT[solver]] = max(seconds, 1e-9)  # to some solvers 0 is no limit
        else:
            unsupported.append("time_limit")
    if options.max_iterations is not None:
        passed |= dict.fromkeys(ITERATION_LIMIT.get(solver, ()), options.max_iterations)
        if solver not in ITERATION_LIMIT:
            unsupported.append("max_iterations")
    if solver in TOLERANCE:
        default, names = TOLERANCE[solver]
        wanted = default if options.tolerance is None else min(default, options.tolerance / 10)
        passed |= dict.fromkeys(names, max(wanted, LEAST_TOLERANCE))
    elif options.tolerance is not None:
        unsupported.append("tolerance")
    return ({NESTED[solver]: passed} if solver in NESTED else passed), unsupported


def _stop(
    status: str, solver: str, iterations: int | None, most: int | None, time_up: bool
) -> Stop:
    """Map a status; what is not exact at a limit is the limit."""
    stop = STOPS.get(status, Stop.FAILED)
    exhausted = most is not None and iterations is not None and iterations >= most
    limited = status == "user_limit" or (stop is Stop.INACCURATE and solver in INACCURATE_IS_LIMIT)
    if limited or (status.endswith("_inaccurate") and (exhausted or time_up)):
        return Stop.TIME_LIMIT if time_up else Stop.ITERATION_LIMIT
    return stop


BACKEND = Backend("cvxpy", solve, Capabilities(elimination=True, silent=True), ("cvxpy",))

"""Clarabel: interior point on the primal or the dual LP, factorised by QDLDL or faer.

Primal form: min c'x s.t. A x = b, x >= 0; its multiplier z of A x = b has the sign V = -z.
Dual form: max b'V s.t. A'V <= c; its multiplier is theta.

The default is the primal form with faer. Standard map, gamma 1.02, two shared cores, times
relative to it: dual 0.9 to 1.1 and QDLDL 0.8 (either form) at 50 x 50 cells; dual 1.4, primal with
QDLDL more than 3 (not finished) at 100 x 100. V is good to 1e-7 (dual form: 1e-9).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.backends.scaled import ScaledLP, failure
from lmdsl.machine.forking import forked

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP

# The factorisation of every algorithm, the default first.
ALGORITHMS = {"primal": "faer", "dual": "faer", "primal-qdldl": "qdldl", "dual-qdldl": "qdldl"}

# The default, and the relative tolerance below which no smaller one is passed on.
TOLERANCE, LEAST_TOLERANCE = 1e-8, 1e-12
TOLERANCES = ("tol_gap_abs", "tol_gap_rel", "tol_feas")

# Every SolverStatus by name, for the primal form; one not listed is a failure.
STOPS = {
    "Unsolved": Stop.FAILED,
    "Solved": Stop.OPTIMAL,
    "AlmostSolved": Stop.INACCURATE,
    "PrimalInfeasible": Stop.INFEASIBLE,
    "AlmostPrimalInfeasible": Stop.INFEASIBLE,
    "DualInfeasible": Stop.UNBOUNDED,
    "AlmostDualInfeasible": Stop.UNBOUNDED,
    "MaxIterations": Stop.ITERATION_LIMIT,
    "MaxTime": Stop.TIME_LIMIT,
    "NumericalError": Stop.FAILED,
    "InsufficientProgress": Stop.FAILED,
    "CallbackTerminated": Stop.INTERRUPTED,
}

# What the dual form's infeasibility says of the primal LP.
SWAPPED = {Stop.INFEASIBLE: Stop.UNBOUNDED, Stop.UNBOUNDED: Stop.INFEASIBLE}


def solve(lp: StabilizationLP, options: Options) -> Solution:
    """Solve with Clarabel."""
    return ScaledLP.of(lp).solved(_solved, options)


def _solved(scaled: ScaledLP, options: Options) -> Solution:
    import clarabel

    algorithm = options.algorithm or next(iter(ALGORITHMS))
    dual = algorithm.startswith("dual")
    form = _dual_form(clarabel, scaled) if dual else _primal_form(clarabel, scaled)
    try:
        settings = _settings(clarabel, options, ALGORITHMS[algorithm])
        if options.time_limit is not None:
            settings.time_limit = scaled.seconds_left(options.time_limit)
        found = clarabel.DefaultSolver(*form, settings).solve()
    except BaseException as error:
        return failure(error)
    word = str(found.status)
    stop = _stop(word, found.iterations, settings.max_iter, scaled.time_up(options.time_limit))
    if dual:
        stop = SWAPPED.get(stop, stop)
    x, z = np.array(found.x), np.array(found.z)
    y, x = (x, z) if dual else (-z[: len(scaled.b)], x)
    return scaled.solution(stop, word, y, x, found.iterations)


def _primal_form(clarabel: Any, scaled: ScaledLP) -> tuple[Any, ...]:
    from scipy.sparse import csc_array, eye_array, vstack

    n, K = scaled.A.shape
    rows = vstack([scaled.A, -eye_array(K)]).tocsc()
    cones = [clarabel.ZeroConeT(n), clarabel.NonnegativeConeT(K)]
    return csc_array((K, K)), scaled.c, rows, np.concatenate([scaled.b, np.zeros(K)]), cones


def _dual_form(clarabel: Any, scaled: ScaledLP) -> tuple[Any, ...]:
    from scipy.sparse import csc_array

    n, K = scaled.A.shape
    cones = [clarabel.NonnegativeConeT(K)]
    return csc_array((n, n)), -scaled.b, scaled.A.T.tocsc(), scaled.c, cones


def _settings(clarabel: Any, options: Options, factorisation: str) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.direct_solve_method = factorisation
    if forked():  # faer would wait for threads that are gone
        if hasattr(settings, "max_threads"):
            settings.max_threads = 1
        else:
            settings.direct_solve_method = "qdldl"
    wanted = TOLERANCE if options.tolerance is None else min(TOLERANCE, options.tolerance / 10)
    for name in TOLERANCES:
        setattr(settings, name, max(wanted, LEAST_TOLERANCE))
    if options.max_iterations is not None:
        settings.max_iter = options.max_iterations
    return settings


def _stop(word: str, iterations: int, most: int, time_up: bool) -> Stop:
    """Map a status; Clarabel calls a limit "almost" when the last iterate is not far off."""
    stop = STOPS.get(word, Stop.FAILED)
    if word.startswith("Almost") and (time_up or iterations >= most):
        return Stop.TIME_LIMIT if time_up else Stop.ITERATION_LIMIT
    return stop


BACKEND = Backend(
    "clarabel",
    solve,
    Capabilities(algorithms=tuple(ALGORITHMS), elimination=True, silent=True),
    ("clarabel",),
)

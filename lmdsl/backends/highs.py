"""HiGHS: interior point (IPX), simplex, HiPO and PDLP on the primal LP.

IPX without crossover is the default: its V is good to 1e-8 or better, and no vertex is needed
where the policy is taken from V. Standard map, gamma 1.02, two shared cores, times relative to
it: crossover 1.7 to 2.3, simplex 9 to 13, PDLP 8 to 12 at 50 x 50 cells; crossover 3.0 at
100 x 100. HiGHS left to choose takes simplex.

``row_dual`` is d(optimal cost)/d(right-hand side): V itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.backends.scaled import ScaledLP, failure
from lmdsl.errors import MissingDependency
from lmdsl.machine import quiet

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP

# Options of every algorithm, the default first.
ALGORITHMS = {
    "ipx": {"solver": "ipx", "run_crossover": "off"},
    "ipx-crossover": {"solver": "ipx", "run_crossover": "on"},
    "simplex": {"solver": "simplex"},
    "hipo": {"solver": "hipo", "run_crossover": "off"},
    "pdlp": {"solver": "pdlp"},
}

# Our default and the least value HiGHS takes; no default is looser than its own.
TOLERANCES = {
    "primal_feasibility_tolerance": (1e-7, 1e-10),
    "dual_feasibility_tolerance": (1e-7, 1e-10),
    "ipm_optimality_tolerance": (1e-8, 1e-12),
    "pdlp_optimality_tolerance": (1e-9, 1e-12),
}

ITERATION_LIMITS = ("simplex_iteration_limit", "ipm_iteration_limit", "pdlp_iteration_limit")
ITERATIONS = (
    "simplex_iteration_count",
    "ipm_iteration_count",
    "crossover_iteration_count",
    "pdlp_iteration_count",
)

# Every HighsModelStatus by name; one not listed is a failure.
FAILURES = (
    "kNotset", "kLoadError", "kModelError", "kPresolveError", "kSolveError", "kPostsolveError",
    "kModelEmpty", "kObjectiveBound", "kObjectiveTarget", "kUnknown", "kSolutionLimit",
    "kMemoryLimit",
)  # fmt: skip
STOPS = {
    "kOptimal": Stop.OPTIMAL,
    "kInfeasible": Stop.INFEASIBLE,
    "kUnboundedOrInfeasible": Stop.INFEASIBLE,  # costs are >= 0: it cannot be unbounded
    "kUnbounded": Stop.UNBOUNDED,
    "kTimeLimit": Stop.TIME_LIMIT,
    "kIterationLimit": Stop.ITERATION_LIMIT,
    "kInterrupt": Stop.INTERRUPTED,
    "kHighsInterrupt": Stop.INTERRUPTED,
    **dict.fromkeys(FAILURES, Stop.FAILED),
}


def solve(lp: StabilizationLP, options: Options) -> Solution:
    """Solve with HiGHS; MissingDependency where this highspy lacks the algorithm."""
    return ScaledLP.of(lp).solved(_solved, options)


def _solved(scaled: ScaledLP, options: Options) -> Solution:
    with quiet.foreign():  # some versions greet before they can be told not to
        import highspy

        highs = highspy.Highs()
        highs.setOptionValue("output_flag", False)
    _choose(highs, options, scaled.seconds_left(options.time_limit))
    if scaled.time_up(options.time_limit):
        return scaled.out_of_time()
    try:
        highs.passModel(_model(highspy, scaled))
        highs.run()
    except BaseException as error:
        return failure(error)
    status = highs.getModelStatus()
    found, info = highs.getSolution(), highs.getInfo()
    stop = STOPS.get(status.name, Stop.FAILED)
    iterations = sum(max(getattr(info, name), 0) for name in ITERATIONS)
    y = found.row_dual if found.dual_valid else None
    x = found.col_value if found.value_valid else None
    return scaled.solution(stop, highs.modelStatusToString(status), y, x, iterations)


def _choose(highs: Any, options: Options, seconds: float | None) -> None:
    algorithm = options.algorithm or next(iter(ALGORITHMS))
    for name, word in ALGORITHMS[algorithm].items():
        if not _accepted(highs, name, word):
            raise MissingDependency(  # HiGHS itself would go on, with simplex
                f"this highspy has no {algorithm}; install highspy[extras] or a newer highspy, or "
                "use highs:simplex",
                "backend",
            )
    for name, (default, least) in TOLERANCES.items():
        wanted = default if options.tolerance is None else min(default, options.tolerance / 10)
        _accepted(highs, name, max(wanted, least))
    _accepted(highs, "small_matrix_value", 1e-12)  # smaller transition shares would be dropped
    if seconds is not None:
        _accepted(highs, "time_limit", seconds)
    if options.max_iterations is not None:
        for name in ITERATION_LIMITS:
            _accepted(highs, name, options.max_iterations)


def _accepted(highs: Any, name: str, value: object) -> bool:
    return bool(highs.setOptionValue(name, value).name != "kError")


def _model(highspy: Any, scaled: ScaledLP) -> Any:
    n, K = scaled.A.shape
    model = highspy.HighsLp()
    model.num_row_, model.num_col_ = n, K
    model.col_cost_ = scaled.c
    model.col_lower_, model.col_upper_ = np.zeros(K), np.full(K, np.inf)
    model.row_lower_ = model.row_upper_ = scaled.b
    model.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    model.a_matrix_.start_ = scaled.A.indptr
    model.a_matrix_.index_ = scaled.A.indices
    model.a_matrix_.value_ = scaled.A.data
    return model


BACKEND = Backend(
    "highs",
    solve,
    Capabilities(
        algorithms=tuple(ALGORITHMS),
        extras={"hipo": "highspy-extras"},
        elimination=True,
        silent=True,
    ),
    ("highspy",),
)

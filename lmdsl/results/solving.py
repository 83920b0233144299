"""The pipeline: problem -> LP -> backend -> policy -> certificate -> result."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl import backends
from lmdsl.backends import Backend, Options, Solution, Stop
from lmdsl.backends.asking import ask
from lmdsl.certificate import claims
from lmdsl.certificate.claims import Certificate, Verified, Witness
from lmdsl.common import inputs
from lmdsl.common.types import Pairs, Progress
from lmdsl.control.invariance import check
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline, Stopped, TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.discretization import control_count, control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local_controller import LocalController
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize.feasibility import first_policy, gamma
from lmdsl.optimize.policies import bellman, policy
from lmdsl.optimize.witness import certify
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Coverage, Result, Seconds

TOLERANCE = 1e-6
UNKNOWN = 255
"""Status of cells of which nothing is known."""


@own_arithmetic
def solve(
    problem: Problem | StabilizationLP,
    backend: str | Backend = backends.DEFAULT,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float | Deadline | None = None,
    max_iterations: int | None = None,
    require_all: bool = False,
    restrict_to_gamma: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Solve a problem and verify the answer.

    Parameters
    ----------
    problem
        A problem, or the LP of :func:`lmdsl.compile`.
    backend
        ``"policy-iteration"``, ``"highs"``, ``"clarabel"``, ``"cvxpy"``, one of your own, each
        optionally with an algorithm (``"highs:simplex"``, ``"cvxpy:SCS"``), or a Backend.
    tolerance
        Largest gap that counts as verified.
    time_limit
        Seconds for compiling and solving. What was found by then is verified, for as long again at
        most, or two seconds. A problem that compiles in a moment is compiled whatever the limit.
    max_iterations
        Iterations in the backend's own sense.
    require_all
        Refuse a problem of which a cell outside A and Z is not stabilizable.
    restrict_to_gamma
        Where gamma is infeasible for some cells, solve on the others: the cells left out get the
        status BEYOND_GAMMA, and ``witness`` proves that no policy has finite cost from them.
    progress
        Called with (stage, fraction done, or -1).

    Returns
    -------
    Result
        Also for unverified, not stabilizable and failed solves, and where the time was up before
        the problem was compiled.

    Raises
    ------
    BadInput
        The problem or an option cannot be used.
    """
    _check_options(problem, tolerance, max_iterations)
    require_all = inputs.flag(require_all, "require_all")
    restrict_to_gamma = inputs.flag(restrict_to_gamma, "restrict_to_gamma")
    late = Deadline.of(time_limit)
    chosen, algorithm = backends.resolve(backend)
    started = time.perf_counter()
    compiled = None
    if isinstance(problem, Problem):
        try:
            lp = compile(problem, progress, late)
        except TimeLimitReached as error:
            return not_compiled(backend, problem, tolerance, error, time.perf_counter() - started)
        compiled = time.perf_counter() - started
    else:
        lp = problem
    job = _Job(lp, chosen, tolerance, compiled, backend if isinstance(backend, str) else None)
    refused = _not_stabilizable(lp, require_all)
    job.finish = late.again()
    if refused:
        return job.refused(*refused)
    started = time.perf_counter()
    first = first_policy.stabilizing(lp, late)
    if isinstance(first, first_policy.Refused):
        verified = _refuse(lp, first, tolerance)
        w = verified.witness.w
        if verified.certificate.refusal and w is not None:
            smaller = gamma.restricted(lp, w) if restrict_to_gamma else None
            if smaller is not None:
                inner = solve(
                    smaller,
                    backend,
                    tolerance=tolerance,
                    time_limit=late,
                    max_iterations=max_iterations,
                    require_all=require_all,
                    restrict_to_gamma=True,
                    progress=progress,
                )
                return job.restricted(inner, lp.expand(w, 0.0, 0.0))
            job.solve_seconds, job.finish = time.perf_counter() - started, late.again()
            limits = gamma.bracket(lp, late, start=first.best)
            bracket = (max(limits.low, first.lower), min(limits.high, lp.gamma))
            message = gamma.refusal_message(lp, w, limits, bracket)
            return job.refused("gamma", message, verified, bracket)
        first = first_policy.Undecided(first.best.pair, first.lower)
    options = Options(
        tolerance=tolerance,
        time_limit=late.left,
        max_iterations=max_iterations,
        algorithm=algorithm,
        start=first.pair,
        proof=first.w if isinstance(first, first_policy.Feasible) else None,
        progress=progress,
    )
    iteration = None
    if isinstance(first, first_policy.Undecided):
        word = "time limit" if late() else "undecided"
        stop = Stop.TIME_LIMIT if late() else Stop.FAILED
        solution = Solution(stop, word, pair=first.pair)
    else:
        if progress:
            progress("solve", -1.0)
        solution, iteration, job.log = ask(lp, chosen, options)
    outcome = _polish(lp, solution, iteration, first.pair, tolerance, late)
    iteration = None  # the rows of its last policy would stay till the end
    job.solve_seconds = time.perf_counter() - started
    if progress:
        progress("verify", -1.0)
    started = time.perf_counter()
    job.finish = late.again()
    verified = certify(lp, outcome.pair, tolerance, outcome.value, job.finish)
    job.verify_seconds = time.perf_counter() - started
    undecided = isinstance(first, first_policy.Undecided) and not late()
    return job.solved(solution, outcome, verified, undecided)


def not_compiled(
    backend: str | Backend, problem: Problem, tolerance: float, error: Exception, seconds: float
) -> Result:
    """Return what is known of a problem that there was no time to compile."""
    partition = Partition.of(problem)
    N = partition.size
    message = str(error)
    claims = Certificate(*(False,) * 5, *(None,) * 5, tolerance=tolerance, reasons=(message,))
    return Result(
        status="solver_failed",
        backend=backend if isinstance(backend, str) else backend.name,
        solver_status="time limit",
        gamma=problem.gamma,
        tolerance=tolerance,
        cells=N,
        controls=control_count(problem),
        seconds=Seconds(compile=seconds),
        message=message,
        problem=problem,
        partition=partition,
        certificate=claims,
        control_index=np.full(N, -1, dtype=np.int32),
        value=np.full(N, np.inf),
        lower=np.zeros(N),
        measure=np.zeros(N),
        cell_status=np.full(N, UNKNOWN, dtype=np.uint8),
        witness=np.zeros(N),
        control_vectors=control_vectors(problem),
    )


def _check_options(problem: Any, tolerance: Any, max_iterations: Any) -> None:
    if not isinstance(problem, Problem | StabilizationLP):
        raise BadInput(f"{shown(problem)} is neither a Problem nor a compiled LP", "problem")
    if not _number(tolerance) or not 0 <= tolerance < 1e300:
        raise BadInput(f"{shown(tolerance)} must be a finite number >= 0", "tolerance")
    if max_iterations is not None:
        inputs.whole(max_iterations, "max_iterations", most=math.inf)


def _number(value: Any) -> bool:
    return isinstance(value, float | int | np.floating | np.integer) and value is not True


def _not_stabilizable(lp: StabilizationLP, require_all: bool) -> tuple[str, str] | None:
    """Return the cause and a sentence where the graph alone rules the problem out."""
    if not lp.n:
        if not np.isin(lp.cell_status, (2, 3, 4)).any():
            return "empty", "every cell is attractor or avoid; there is nothing to stabilize"
        return "empty", "no cell can be kept in the box and brought to the attractor"
    if not lp.weight.any():
        return "measure", "no cell of measure is stabilizable; enlarge its boxes"
    outside = lp.partition.size - lp.n - int(np.isin(lp.cell_status, (0, 5)).sum())
    if require_all and outside:
        return (
            "require_all",
            f"{outside} of {lp.n + outside} cells outside A and Z are not stabilizable",
        )
    return None


def _refuse(lp: StabilizationLP, found: first_policy.Refused, tolerance: float) -> Verified:
    from lmdsl.optimize.descent import lower_until_below

    w = lower_until_below(lp, found.w, lp.gamma, None)
    witness = Witness(None, found.w if w is None else w)
    return Verified(claims.check(lp, witness, tolerance), witness)


@dataclass(frozen=True, eq=False)
class _Outcome:
    """A policy after polishing, and what polishing did."""

    pair: Pairs
    value: NDArray[np.float64] | None
    steps: int
    gap_before: float | None


def _claimed(lp: StabilizationLP, solution: Solution) -> Pairs | None:
    """Return the policy of a solution: its own, else greedy in V, else largest occupation."""
    if solution.pair is not None:
        return solution.pair
    if solution.value is not None:
        return bellman.improve(lp, np.maximum(solution.value, 0.0)).pair
    if solution.occupation is not None:
        theta = solution.occupation
        top = np.maximum.reduceat(theta, lp.pair_pointer[:-1])
        return policy.first_column(lp, theta >= top[lp.cell])
    return None


def _polish(
    lp: StabilizationLP,
    solution: Solution,
    iteration: policy.Iteration | None,
    start: Pairs,
    tolerance: float,
    stop: Deadline,
) -> _Outcome:
    """Improve a backend's policy exactly until nothing is strictly better, then break ties.

    A policy that is not g-stabilizing is discarded where gamma >= 1. After a limit the policy is
    left as it is: a limit is not a license to go on.
    """
    if iteration is not None and solution.stop.success:  # it ends where polishing would begin
        return _tidied(lp, iteration, tolerance, 0, None, stop)
    pair = _claimed(lp, solution)
    if pair is not None and not _usable(lp, pair, solution.value):
        pair = None
    if pair is None:
        pair = start
    guess = None if solution.pair is None else solution.value
    try:
        value = policy.evaluate(lp, pair, start=guess, transient=lp.gamma >= 1, stop=stop.again())
    except Stopped:
        value = None
    if value is None or solution.stop.limit:
        return _Outcome(pair, value, 0, None)
    done = policy.iterate(lp, pair, value, stop=stop)
    gap_before = None
    if done.steps:
        gap_before = certify(lp, pair, tolerance, value, stop.again()).certificate.gap
    return _tidied(lp, done, tolerance, done.steps, gap_before, stop)


def _tidied(
    lp: StabilizationLP,
    done: policy.Iteration,
    tolerance: float,
    steps: int,
    gap_before: float | None,
    stop: Deadline,
) -> _Outcome:
    """Break ties; where that costs more than the tolerance the strict minimisers stay."""
    try:
        tidy = policy.canonical(lp, done.pair, done.value, done.screen, stop)
    except Stopped:
        tidy = done.pair
    if (tidy != done.pair).any() and _usable(lp, tidy, done.value):
        tidy_value = policy.evaluate(lp, tidy, start=done.value, transient=lp.gamma >= 1)
        limit = (1 + tolerance / 4) * claims.weighted(lp, done.value)
        if tidy_value is not None and claims.weighted(lp, tidy_value) <= limit:
            return _Outcome(tidy, tidy_value, steps, gap_before)
    value = done.value if done.converged else None  # else perhaps only a bound of it
    return _Outcome(done.pair, value, steps, gap_before)


def _usable(lp: StabilizationLP, pair: Pairs, guess: NDArray[np.float64] | None) -> bool:
    return lp.gamma < 1 or policy.stability_vector(lp, pair, guess)[0] is not None


class _Job:
    """What is known before a result exists; makes the result."""

    def __init__(
        self,
        lp: StabilizationLP,
        backend: Backend,
        tolerance: float,
        compile_seconds: float | None,
        spec: str | None,
    ) -> None:
        self.lp, self.tolerance, self.compile_seconds = lp, tolerance, compile_seconds
        self.backend = spec or backend.name
        self.finish = Deadline()
        self.solve_seconds: float | None = None
        self.verify_seconds: float | None = None
        self.log = ""

    def refused(
        self,
        cause: str,
        message: str,
        verified: Verified | None = None,
        gamma_bar: tuple[float, float] | None = None,
    ) -> Result:
        if verified is None:
            witness = Witness(None)
            verified = Verified(claims.check(self.lp, witness, self.tolerance), witness)
        proof = replace(verified.certificate, reasons=(message,))
        return self._result(
            verified.witness, proof, "not_stabilizable", message, cause=cause, gamma_bar=gamma_bar
        )

    def restricted(self, inner: Result, w: NDArray[np.float64]) -> Result:
        """Add to the result on the feasible cells the proof that the others are infeasible."""
        count = int((w > 0).sum())
        return replace(
            inner,
            witness=inner.witness + w,
            seconds=replace(inner.seconds, compile=self.compile_seconds),
            message=f"{inner.message}; {count} cells are proved infeasible at this gamma",
        )

    def solved(
        self, solution: Solution, outcome: _Outcome, verified: Verified, undecided: bool
    ) -> Result:
        proof = verified.certificate
        if proof.verified:
            status = "verified"
            free = Coverage.of(self.lp.cell_status).free
            message = (
                f"the controller brings every one of {self.lp.n} cells (of {free} free) to the "
                f"attractor; its cost is within {proof.gap:.2g} of optimal (finite model)"
            )
        else:
            failed = not solution.stop.success and not undecided
            status = "solver_failed" if failed else "unverified"
            message = "; ".join(proof.reasons)
            if failed:
                message = f"{solution.stop.value} ({solution.word}); {message}"
            elif undecided:
                message = (
                    f"gamma = {self.lp.gamma!r} is so close to its limit, or the way to the "
                    f"attractor so long, that the numbers decide neither way; {message}"
                )
        return self._result(
            verified.witness,
            proof,
            status,
            message,
            solver_status=solution.word,
            polish_steps=outcome.steps,
            gap_before_polish=outcome.gap_before,
            iterations=solution.iterations,
            log=self.log,
        )

    def _result(
        self, witness: Witness, proof: Certificate, status: str, message: str, **more: Any
    ) -> Result:
        lp, n = self.lp, self.lp.n

        def spread(values: Any, missing: float, attractor: float, outside: float) -> Any:
            known = np.full(n, missing) if values is None else values
            return lp.expand(np.asarray(known, dtype=np.float64), attractor, outside)

        index = np.full(lp.partition.size, -1, dtype=np.int32)
        if witness.pair is not None:
            index[lp.cells] = lp.control[witness.pair]
        solved = status != "not_stabilizable"
        attractor = lp.cell_status == CellStatus.ATTRACTOR
        local = LocalController.of(lp.problem, lp.partition, attractor)
        return Result(
            status=status,
            backend=self.backend,
            gamma=lp.gamma,
            cost=proof.cost if solved else None,
            lower_bound=(proof.lower or 0.0) if solved else None,
            gap=proof.gap if solved else None,
            tolerance=self.tolerance,
            contraction=proof.contraction,
            cells=lp.partition.size,
            controls=len(lp.controls),
            pairs=lp.K,
            attractor_cells=int(attractor.sum()),
            stabilizable_cells=n,
            local_controller=None if local is None else check(lp.problem, local, self.finish),
            seconds=Seconds(self.compile_seconds, self.solve_seconds, self.verify_seconds),
            message=message,
            problem=lp.problem,
            partition=lp.partition,
            certificate=proof,
            control_index=index,
            value=spread(witness.V_up if proof.upper_bound else None, np.inf, 0.0, np.inf),
            lower=spread(witness.W if proof.lower_bound else None, 0.0, 0.0, np.inf),
            measure=spread(witness.mu, 0.0, 0.0, 0.0),
            cell_status=lp.cell_status,
            witness=spread(witness.w, 0.0, 0.0, 0.0),
            control_vectors=lp.controls,
            lp=lp,
            **more,
        )

"""The pipeline: problem -> LP -> backend -> policy -> certificate -> result."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl import backends
from lmdsl.backends import Backend, Options, Solution, Stop, policy_iteration
from lmdsl.backends.asking import ask
from lmdsl.certificate import judge
from lmdsl.certificate.claims import Verified, Witness
from lmdsl.common import inputs
from lmdsl.common.on_disk import WHERE
from lmdsl.common.types import FilePath, Floats, Indices, Progress, told
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.optimize import checkpoints
from lmdsl.optimize.feasibility import first_policy, gamma_bar, lifting, restriction
from lmdsl.optimize.witness import certify
from lmdsl.problem import Problem, given
from lmdsl.results.job import Extent, _Job, not_compiled, ruled_out
from lmdsl.results.polishing import _Outcome, _polish
from lmdsl.results.result import Result
from lmdsl.results.status import Cause

TOLERANCE = 1e-6  # default gap above which a result is not verified


@own_arithmetic
def solve(
    problem: Problem | StabilizationLP | FilePath,
    backend: str | Backend = backends.DEFAULT,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float | Deadline | None = None,
    max_iterations: int | None = None,
    require_all: bool = False,
    restrict_to_gamma: bool = False,
    proved: float | None = None,
    start: Result | None = None,
    rows_on_disk: FilePath | None = None,
    checkpoint: FilePath | None = None,
    resume: FilePath | None = None,
    progress: Progress | bool | None = None,
) -> Result:
    """Solve a problem and verify the answer.

    Parameters
    ----------
    problem
        A problem, the path of its file, or the LP of :func:`lmdsl.compile`.
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
    proved
        Share of the volume of C that is to be proved to arrive, on the true map: pairs that lose
        runs, or of which that is undecided, are dropped and the rest is solved again, until it is
        reached or nothing helps (see ``Result.proved``).
    start
        An earlier result of the same states and controls, on other cells, with other samples or
        another gamma, say: the search begins at its controller. The answer is the same.
    rows_on_disk
        A folder: the rows lie there, in files that vanish with the result, instead of in memory.
    checkpoint
        A folder: policy and V are kept there every minute or so, and the last ones.
    resume
        A folder with a checkpoint of the same problem: the search begins at its policy, which is
        proved anew. The answer is the same. One that is ``checkpoint`` may still be empty.
    progress
        Called with (stage, fraction done, or -1); True shows it on stderr, with the time left.

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
    progress = told(progress)
    problem = given(problem, StabilizationLP)
    _check_options(tolerance, max_iterations)
    _not_compiled_yet(problem, rows_on_disk)
    declared = problem if isinstance(problem, Problem) else problem.problem
    require_all = inputs.flag(require_all, "require_all")
    restrict_to_gamma = inputs.flag(restrict_to_gamma, "restrict_to_gamma")
    if restrict_to_gamma:
        _no_enclosures(declared)
    chosen, algorithm = backends.resolve(backend)
    _keeps(chosen, checkpoint)
    request = _Request(
        backend=chosen,
        algorithm=algorithm,
        name=backend if isinstance(backend, str) else chosen.name,
        tolerance=tolerance,
        deadline=Deadline.of(time_limit),
        max_iterations=max_iterations,
        require_all=require_all,
        restrict_to_gamma=restrict_to_gamma,
        start=_earlier(start),
        rows_on_disk=rows_on_disk,
        resume=checkpoints.wanted(resume, declared, checkpoint, start),
        keeping=checkpoints.Checkpoints.of(checkpoint, declared),
        progress=progress,
    )
    if proved is None:
        return _solved(problem, request)
    from lmdsl.results.directory.repair import repairing

    repairing.require_provable(proved, declared, restrict_to_gamma)
    first = _solved(problem, request)

    def again(dropped: NDArray[np.int64]) -> Result:
        return _solved(first.problem, request, dropped)

    return repairing.repaired(first, again, proved, request.deadline, progress)


def _solved(problem: Problem | StabilizationLP, request: "_Request", dropped: Any = None) -> Result:
    """Compile, without some pairs, and answer."""
    if isinstance(problem, StabilizationLP):
        return _answer(problem, request)
    started = time.perf_counter()
    try:
        lp = compile(
            problem, request.progress, request.deadline,
            dropped=dropped, rows_on_disk=request.rows_on_disk,
        )  # fmt: skip
    except TimeLimitReached as error:
        seconds = time.perf_counter() - started
        return not_compiled(request.name, problem, request.tolerance, error, seconds)
    return _answer(lp, request, time.perf_counter() - started)


@dataclass(frozen=True)
class _Request:
    """What the caller of :func:`solve` asks for."""

    backend: Backend
    algorithm: str | None
    name: str
    tolerance: float
    deadline: Deadline
    max_iterations: int | None
    require_all: bool
    restrict_to_gamma: bool
    start: lifting.Earlier | None
    rows_on_disk: FilePath | None
    resume: Path | None
    keeping: checkpoints.Checkpoints | None
    progress: Progress | None

    def first(
        self, lp: StabilizationLP
    ) -> first_policy.Feasible | first_policy.Refused | first_policy.Undecided:
        """Return the policy to begin with: an earlier one, where that serves."""
        found, kept = None, checkpoints.unfinished(self.resume, lp)
        if kept is not None:
            found = lifting.continued(lp, kept, self.deadline)
        elif self.start is not None:
            found = lifting.lifted(lp, self.start, self.deadline)
        return found or first_policy.stabilizing(lp, self.deadline)

    def keep(self, lp: StabilizationLP) -> Callable[[Indices, Floats], None] | None:
        """Return what keeps a policy of a model on the way, None where nothing does."""
        return None if self.keeping is None else partial(self.keeping.keep, lp)

    def tell(self, stage: str) -> None:
        """Tell the caller what begins."""
        if self.progress:
            self.progress(stage, -1.0)


def _answer(lp: StabilizationLP, request: _Request, compile_seconds: float | None = None) -> Result:
    """Find a policy of a compiled problem, and the proof of it or against any."""
    deadline = request.deadline
    job = _Job(lp, request.name, request.tolerance, compile_seconds)
    job.finish = deadline.again()
    if request.start is not None:
        request.start.require_fit(lp)
    refused = ruled_out(lp.problem, lp.partition, Extent.of(lp), request.require_all, job.finish)
    if refused:
        return job.refused(*refused)
    request.tell("solve")
    started = time.perf_counter()
    first = request.first(lp)
    if isinstance(first, first_policy.Refused):
        infeasible = _infeasible(lp, first, request, job, started)
        if infeasible is not None:
            return infeasible
        first = first_policy.Undecided(first.best.policy, first.lower)
    solution, outcome = _asked(lp, first, request, job)
    if request.keeping and outcome.value is not None:
        request.keeping.keep(lp, outcome.policy, outcome.value, last=True)
    job.solve_seconds = time.perf_counter() - started
    request.tell("verify")
    started = time.perf_counter()
    job.finish = deadline.again()
    verified = certify(lp, outcome.policy, request.tolerance, outcome.value, job.finish)
    job.verify_seconds = time.perf_counter() - started
    undecided = isinstance(first, first_policy.Undecided) and not deadline()
    return job.solved(solution, outcome, verified, undecided)


def _infeasible(
    lp: StabilizationLP, first: first_policy.Refused, request: _Request, job: _Job, started: float
) -> Result | None:
    """Return the refusal of gamma, or the answer on the other cells; None if it is not proved."""
    verified = _refuse(lp, first, request.tolerance)
    w = verified.witness.refusal
    if not verified.certificate.refusal or w is None:
        return None
    smaller = restriction.restricted(lp, w) if request.restrict_to_gamma else None
    if smaller is not None:
        return job.restricted(_answer(smaller, request), lp.expand(w, 0.0, 0.0))
    job.solve_seconds, job.finish = time.perf_counter() - started, request.deadline.again()
    limits = gamma_bar.bracket(lp, request.deadline, start=first.best)
    bracket = (max(limits.low, first.lower), min(limits.high, lp.gamma))
    message = restriction.refusal_message(lp, w, limits, bracket)
    return job.refused(Cause.GAMMA, message, verified, bracket)


def _asked(
    lp: StabilizationLP,
    first: first_policy.Feasible | first_policy.Undecided,
    request: _Request,
    job: _Job,
) -> tuple[Solution, _Outcome]:
    """Return what the backend says, and its policy polished; it is not asked where undecided."""
    deadline, iteration = request.deadline, None
    if isinstance(first, first_policy.Undecided):
        word = "time limit" if deadline() else "undecided"
        stop = Stop.TIME_LIMIT if deadline() else Stop.FAILED
        solution = Solution(stop, word, policy=first.policy)
    else:
        options = Options(
            tolerance=request.tolerance,
            time_limit=deadline.left,
            max_iterations=request.max_iterations,
            algorithm=request.algorithm,
            start=first.policy,
            proof=first.w,
            value=first.value,
            progress=request.progress,
            keep=request.keep(lp),
        )
        solution, iteration, job.log = ask(lp, request.backend, options)
    outcome = _polish(lp, solution, iteration, first.policy, request.tolerance, deadline)
    return solution, outcome


def _check_options(tolerance: Any, max_iterations: Any) -> None:
    if not inputs.is_number(tolerance) or not 0 <= tolerance < 1e300:
        raise BadInput(f"{shown(tolerance)} must be a finite number >= 0", "tolerance")
    if max_iterations is not None:
        inputs.whole(max_iterations, "max_iterations", most=math.inf)


def _not_compiled_yet(problem: Problem | StabilizationLP, rows_on_disk: Any) -> None:
    if rows_on_disk is not None and isinstance(problem, StabilizationLP):
        raise BadInput("the problem is compiled already; give it to lm.compile", WHERE)


def _keeps(backend: Backend, checkpoint: Any) -> None:
    if checkpoint is not None and backend.solve is not policy_iteration.solve:
        raise BadInput(f"{backend.name} keeps none; use policy-iteration", "checkpoint")


def _earlier(start: Any) -> lifting.Earlier | None:
    """Return the controller to begin with, None where none is asked for."""
    if start is None:
        return None
    inputs.kind(start, Result, "start", "a Result")
    if (start.control_index < 0).all():
        raise BadInput("it has no controller; leave it out, or give another result", "start")
    own = start.problem.controls
    return lifting.Earlier(start.partition, own, start.control_vectors, start.control_index)


def _no_enclosures(problem: Problem) -> None:
    """Refuse to leave out cells that runs of the map, not of its samples, may enter."""
    if problem.successors == "enclosed":
        raise BadInput(
            "successors are enclosed: what cells left out can still be met from others is not "
            'known on the smaller model; lower gamma, or use "successors": "sampled"',
            "restrict_to_gamma",
        )


def _refuse(lp: StabilizationLP, found: first_policy.Refused, tolerance: float) -> Verified:
    from lmdsl.optimize.descent import lower_until_below

    w = lower_until_below(lp, found.w, lp.gamma, None)
    witness = Witness(None, refusal=found.w if w is None else w)
    return Verified(judge.verdict(lp, witness, tolerance), witness)

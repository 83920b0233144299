"""What is known while a problem is solved, and the result made of it."""

import time
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.backends import Backend, Solution
from lmdsl.certificate import judge
from lmdsl.certificate.claims import Certificate, Verified, Witness
from lmdsl.common.types import Floats
from lmdsl.control.accuracy import IntegrationError, integration_error
from lmdsl.control.staying import check_of
from lmdsl.data.report import DataReport
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.discretization import control_count, control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.sets import attractor_note
from lmdsl.model.stabilizable_set import LOST, CellStatus, sets_of
from lmdsl.problem.problem import Problem
from lmdsl.results.polishing import _Outcome
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status
from lmdsl.results.summary import Seconds
from lmdsl.systems import DataSystem

UNKNOWN = 255  # status of cells of which nothing is known
LITTLE = 0.1  # share of cells that can be stabilized below which that is said first


def not_compiled(
    backend: str | Backend, problem: Problem, tolerance: float, error: Exception, seconds: float
) -> Result:
    """Return what is known of a problem that there was no time to compile."""
    partition = Partition.of(problem)
    N = partition.size
    message = str(error)
    claims = Certificate(*(False,) * 5, *(None,) * 5, tolerance=tolerance, reasons=(message,))
    return Result(
        status=Status.SOLVER_FAILED,
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


class Extent(NamedTuple):
    """How many cells of a compiled model are what.

    Attributes
    ----------
    inside
        Number of cells of C.
    status
        Number of cells by :class:`CellStatus`.
    weighed, held
        Whether a cell of C carries weight; whether some cell holds, where that is asked for.
    """

    inside: int
    status: tuple[int, ...]
    weighed: bool
    held: bool

    @classmethod
    def of(cls, lp: StabilizationLP) -> Self:
        """Count the cells of a model."""
        status = np.bincount(lp.cell_status, minlength=len(CellStatus)).tolist()
        return cls(lp.n, tuple(status), bool(lp.weight.any()), not holding.none_holds(lp.hold))

    @property
    def free(self) -> int:
        """Number of cells that are neither attractor nor avoid."""
        given = self.status[CellStatus.ATTRACTOR] + self.status[CellStatus.AVOID]
        return sum(self.status) - given


def ruled_out(
    problem: Problem, partition: Partition, extent: Extent, require_all: bool, deadline: Deadline
) -> tuple[Cause, str] | None:
    """Return the cause and a sentence where the graph alone rules the problem out."""
    if not extent.held:
        return Cause.HOLD, holding.why_none(problem, partition, deadline)
    if not extent.inside:
        enclosed = problem.successors == "enclosed"
        if not any(extent.status[lost] for lost in LOST):
            return Cause.EMPTY, "every cell is attractor or avoid; there is nothing to stabilize"
        if problem.attractor.empty:
            return Cause.EMPTY, _nothing_to_end_in(problem)
        sentence = "no cell can be kept in the box and brought to the attractor"
        return Cause.EMPTY, sentence + enclosed * (
            ", as far as enclosures of whole cells show; smaller cells or a finer control grid may "
            "do it (lmdsl explain)"
        )
    if not extent.weighed:
        return Cause.MEASURE, "no cell of measure is stabilizable; enlarge its boxes"
    outside = extent.free - extent.inside
    if require_all and outside:
        return (
            Cause.REQUIRE_ALL, f"{outside} of {extent.free} free cells are not stabilizable",
        )  # fmt: skip
    return None


def _nothing_to_end_in(problem: Problem) -> str:
    if problem.ends_in_time:
        return "discounted, no target: no cell can be kept in the box"
    return (
        f"gamma = {problem.gamma!r} times the discount {problem.discount!r} is not below 1, and "
        "there is no attractor: lower one of them, or declare an attractor"
    )


def success(problem: Problem, extent: Extent, gap: float | None) -> str:
    """Return what a verified controller does."""
    n, free = extent.inside, extent.free
    cells = f"every one of {n} cells (of {free} free)"
    text = f"the controller brings {cells} to the attractor"
    if n < LITTLE * free and not problem.ends_in_time:
        text = (
            f"only {n} of {free} free cells can be stabilized: the controller brings every "
            "one of these to the attractor"
        )
    elif problem.attractor.empty:
        text = f"discounted, no target: the controller keeps {cells} among them"
    elif problem.ends_in_time:
        text = f"the controller runs from {cells} to the attractor or the discounted end"
    return f"{text}; its cost is within {gap:.2g} of optimal (finite model)"


def neither_way(gamma: float) -> str:
    """Return why it is not decided whether a gamma is feasible."""
    return (
        f"gamma = {gamma!r} is so close to its limit, or the way to the attractor so long, that "
        "the numbers decide neither way"
    )


def left_out(count: int) -> str:
    """Return how many cells a gamma leaves out."""
    return f"{count} cells are proved infeasible at this gamma"


class _Job:
    """What is known before a result exists; makes the result."""

    def __init__(
        self, lp: StabilizationLP, backend: str, tolerance: float, compile_seconds: float | None
    ) -> None:
        self.lp, self.backend, self.tolerance = lp, backend, tolerance
        self.compile_seconds = compile_seconds
        self.finish = Deadline()
        self.solve_seconds: float | None = None
        self.verify_seconds: float | None = None
        self.log = ""

    def refused(
        self,
        cause: Cause,
        message: str,
        verified: Verified | None = None,
        gamma_bar: tuple[float, float] | None = None,
    ) -> Result:
        if verified is None:
            witness = Witness(None)
            verified = Verified(judge.verdict(self.lp, witness, self.tolerance), witness)
        proof = replace(verified.certificate, reasons=(message,))
        return self._result(
            verified.witness,
            proof,
            Status.NOT_STABILIZABLE,
            message,
            cause=cause,
            gamma_bar=gamma_bar,
        )

    def restricted(self, inner: Result, w: Floats) -> Result:
        """Add to the result on the feasible cells the proof that the others are infeasible."""
        count = int((w > 0).sum())
        return replace(
            inner,
            witness=inner.witness + w,
            seconds=replace(inner.seconds, compile=self.compile_seconds),
            message=f"{inner.message}; {left_out(count)}",
        )

    def solved(
        self, solution: Solution, outcome: _Outcome, verified: Verified, undecided: bool
    ) -> Result:
        proof = verified.certificate
        if proof.verified:
            status = Status.VERIFIED
            message = success(self.lp.problem, Extent.of(self.lp), proof.gap)
        else:
            failed = not solution.stop.success and not undecided
            status = Status.SOLVER_FAILED if failed else Status.UNVERIFIED
            message = "; ".join(proof.reasons)
            if failed:
                message = f"{solution.stop.value} ({solution.word}); {message}"
            elif undecided:
                message = f"{neither_way(self.lp.gamma)}; {message}"
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

    def _integration_error(self) -> IntegrationError | None:
        """Judge the compiled steps, where there is time."""
        try:
            return integration_error(self.lp.problem, sets_of(self.lp.cell_status), self.finish)
        except TimeLimitReached:
            return None

    def _data(self, witness: Witness) -> DataReport | None:
        """Report on recorded data, as far as there is time."""
        if not isinstance(self.lp.problem.system, DataSystem):
            return None
        started = time.perf_counter()
        guard = partial(self.finish.raise_if_over, "bounding the true cost")
        report = DataReport.of(self.lp, witness.policy, guard)
        self.verify_seconds = (self.verify_seconds or 0.0) + time.perf_counter() - started
        return report

    def _result(
        self, witness: Witness, proof: Certificate, status: Status, message: str, **more: Any
    ) -> Result:
        lp = self.lp
        w = witness.w if witness.refusal is None else witness.refusal
        index = _controls(lp, witness)
        solved = status != Status.NOT_STABILIZABLE
        attractor = lp.cell_status == CellStatus.ATTRACTOR
        local = check_of(lp, self.finish)
        held = holding.note(lp.problem, lp.partition, lp.hold)
        data, error = self._data(witness), self._integration_error()
        said = [data.sentence() if data else "", error.warning() if error else ""]
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
            stabilizable_cells=lp.n,
            local_controller=local,
            seconds=Seconds(self.compile_seconds, self.solve_seconds, self.verify_seconds),
            message=together(message, attractor_note(lp.problem, lp.partition), held, *said),
            data=data,
            integration_error=error,
            problem=lp.problem,
            partition=lp.partition,
            certificate=proof,
            control_index=index,
            value=_spread(lp, witness.V_up if proof.upper_bound else None, np.inf, 0.0, np.inf),
            lower=_spread(lp, witness.W if proof.lower_bound else None, 0.0, 0.0, np.inf),
            measure=_spread(lp, witness.mu, 0.0, 0.0, 0.0),
            cell_status=lp.cell_status,
            witness=_spread(lp, w, 0.0, 0.0, 0.0),
            control_vectors=lp.controls,
            sure_levels=lp.sure_levels,
            dropped=lp.dropped,
            lp=lp,
            **more,
        )


def _controls(lp: StabilizationLP, witness: Witness) -> NDArray[np.int32]:
    """Return the control of every cell, -1 where there is none."""
    index = np.full(lp.partition.size, -1, dtype=np.int32)
    if witness.policy is not None:
        index[lp.cells] = lp.control[witness.policy]
        index = index if lp.hold is None else np.maximum(index, lp.hold)
    return index


def together(*notes: str) -> str:
    """Return the sentences that there are as one text."""
    return "; ".join(note for note in notes if note)


def _spread(
    lp: StabilizationLP, values: Floats | None, missing: float, attractor: float, outside: float
) -> Floats:
    """Return values on C over all cells; ``missing`` on C where there are none."""
    known = np.full(lp.n, missing) if values is None else values
    return lp.expand(np.asarray(known, dtype=np.float64), attractor, outside)

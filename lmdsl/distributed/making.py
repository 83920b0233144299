"""Answers made of what ranks found: arrays of own cells, facts that all share."""

import contextlib
import math
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.control.accuracy import IntegrationError, integration_error
from lmdsl.control.invariance import LocalCheck
from lmdsl.control.staying import check_of
from lmdsl.data.report import DataReport
from lmdsl.distributed.answer import Answer
from lmdsl.distributed.talking import Talk
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.discretization import control_count, control_vectors
from lmdsl.model.grid.boxes import Area
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.sets import attractor_note
from lmdsl.model.stabilizable_set import CellStatus, sets_of
from lmdsl.optimize.feasibility.restriction import refusal_of_cells
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Alone, RankError, Ranks
from lmdsl.results.job import Extent, left_out, success, together
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status
from lmdsl.results.summary import Seconds, Summary
from lmdsl.slabs import digest
from lmdsl.slabs.gamma import whole
from lmdsl.slabs.gamma.restricting import restricted
from lmdsl.slabs.graph.pieces import PieceSets
from lmdsl.slabs.solving import Solved
from lmdsl.systems import DataSystem

BACKEND = "policy-iteration"
ARRAYS = ("control_index", "value", "lower", "measure", "cell_status", "witness", "sure_levels")
FACTS = (
    "problem",
    "certificate",
    "cause",
    "iterations",
    "dropped",
    "ended_by_discount",
)  # beside those of a summary


class AnswerMaker:
    """Makes answers; every method that says so is collective."""

    def __init__(
        self, ranks: Ranks, problem: Problem, tolerance: float, deadline: Deadline
    ) -> None:
        self.ranks, self.problem, self.tolerance = ranks, problem, tolerance
        self.deadline = deadline
        self.compile_seconds: float | None = None
        self.solve_seconds: float | None = None
        self.verify_seconds: float | None = None
        self.lp: StabilizationLP
        self.extent: Extent
        self.starts: Indices

    def of_model(self, lp: StabilizationLP) -> None:
        """Count the cells of a model; collective."""
        own = Extent.of(lp)
        every = self.ranks.collect((own, len(lp.cell_status), lp.hold is not None))
        status = np.sum([extent.status for extent, _, _ in every], axis=0).tolist()
        asked = lp.problem.local_controller is not None and lp.hold is not None
        self.extent = Extent(
            sum(extent.inside for extent, _, _ in every),
            tuple(status),
            any(extent.weighed for extent, _, _ in every),
            not asked or any(extent.held for extent, _, _ in every),
        )
        self.starts = np.append(0, np.cumsum([n for _, n, _ in every])).astype(np.int64)
        self.lp = lp

    def not_compiled(self, message: str, seconds: float) -> Answer:
        """Return what is known of a problem that there was no time to compile."""
        nothing = np.empty(0)
        return Answer(
            status=Status.SOLVER_FAILED, backend=BACKEND, solver_status="time limit",
            gamma=self.problem.gamma, tolerance=self.tolerance, message=message,
            cells=Partition.of(self.problem).size, controls=control_count(self.problem),
            seconds=Seconds(compile=seconds), problem=self.problem,
            partition=Partition.of(self.problem), certificate=_nothing(self.tolerance, message),
            control_vectors=control_vectors(self.problem), counted=(0,) * len(CellStatus),
            starts=np.zeros(self.ranks.count + 1, dtype=np.int64),
            control_index=nothing.astype(np.int32), value=nothing, lower=nothing, measure=nothing,
            cell_status=nothing.astype(np.uint8), witness=nothing,
        )  # fmt: skip

    def refused(self, cause: Cause, message: str) -> Answer:
        """Return the answer where no policy can be; collective."""
        proof = _nothing(self.tolerance, message, self.problem.system.assumes)
        return self._made(Witness(None), proof, Status.NOT_STABILIZABLE, message, cause=cause)

    def solved(self, found: Solved | None, late: bool) -> Answer:
        """Return the answer that was found; collective."""
        proof = _nothing(self.tolerance, "there is no policy to verify")
        proof = proof if found is None else found.certificate
        witness = Witness(None) if found is None else found.witness
        if proof.verified:
            message = success(self.lp.problem, self.extent, proof.gap)
            status, word = Status.VERIFIED, "optimal"
        else:
            status = Status.SOLVER_FAILED if late else Status.UNVERIFIED
            word = "time limit" if late else "undecided"
            message = "; ".join([word] * late + [*proof.reasons])
        steps = None if found is None else found.steps
        return self._made(
            witness, proof, status, message, solver_status=word, iterations=steps, polish_steps=0
        )

    def infeasible(self, found: Solved, w: Floats, limits: tuple[float, float]) -> Answer:
        """Return the refusal of a gamma; collective."""
        area = self._area(w > 0)
        assert area is not None
        lp = self.lp
        message = refusal_of_cells(lp.problem, self.extent.inside, area, None, limits)
        proof = replace(found.certificate, reasons=(message,))
        return self._made(found.witness, proof, Status.NOT_STABILIZABLE, message,
                          cause=Cause.GAMMA, gamma_bar=limits, area=area)  # fmt: skip

    def restricted(self, inner: Answer, w: Floats) -> Answer:
        """Add to the answer on the feasible cells the proof that the others are not; collective."""
        count = sum(self.ranks.collect(int((w > 0).sum())))
        return replace(
            inner, witness=inner.witness + self._over(w, 0.0, 0.0, 0.0), area=self._area(w > 0),
            message=f"{inner.message}; {left_out(count)}",
            seconds=replace(inner.seconds, compile=self.compile_seconds),
        )  # fmt: skip

    def for_model(self) -> "AnswerMaker":
        """Return what makes answers of another model of the same problem."""
        return AnswerMaker(self.ranks, self.problem, self.tolerance, self.deadline)

    @property
    def first_cell(self) -> int:
        """The first cell of the own part of the box."""
        return int(self.starts[self.ranks.rank])

    def _area(self, chosen: Bools) -> Area | None:
        """Return own cells of C and those of other ranks by region; None for none; collective."""
        cells = self.ranks.gathered(self.lp.cells[chosen])
        return self.ranks.by_first(
            lambda: None if cells is None or not len(cells) else Area.of(self.lp.partition, cells)
        )

    def told(self, result: Result | None) -> Answer:
        """Return what rank 0 found alone; collective."""
        facts: dict[str, Any] | None = None
        if result is not None:
            assert result.lp is not None
            names = [f.name for f in fields(Summary)] + [*FACTS]
            facts = {name: getattr(result, name) for name in names}
            facts["seconds"] = replace(result.seconds, compile=self.compile_seconds)
            facts["counted"] = Extent.of(result.lp).status
            facts["sure"], facts["area"] = result.sure_cells, result.beyond_gamma
            facts["model_sha256"] = digest.of_model(Alone(), result.lp)
        facts, talk = self.ranks.share(facts), Talk.of(self.lp)
        assert facts is not None
        facts["message"] = together(facts["message"], talk.note)
        arrays: dict[str, Any] = {name: self._scattered(result, name) for name in ARRAYS}
        return Answer(**facts, **arrays, partition=self.lp.partition, starts=self.starts,
                      control_vectors=self.lp.controls, **talk.facts(),
                      lp=self._left(facts, arrays))  # fmt: skip

    def _left(self, facts: dict[str, Any], arrays: dict[str, Any]) -> StabilizationLP:
        """Return the model of which rank 0 speaks, as it was asked, of own cells; collective."""
        lp, status = self.lp, arrays["cell_status"]
        out = status[lp.cells - self.first_cell] == CellStatus.BEYOND_GAMMA
        left = restricted(lp, out, self.first_cell) if self.ranks.any(bool(out.any())) else lp
        if left is None or digest.of_model(self.ranks, left) != facts["model_sha256"]:
            raise RankError("rank 0 speaks of another model than that of all ranks")
        return left

    def _scattered(self, result: Result | None, name: str) -> NDArray[Any] | None:
        """Return the own part of an array that rank 0 has, None where it has none."""
        values = None if result is None else getattr(result, name)
        if not self.ranks.share(values is not None):
            return None
        parts = None if values is None else np.split(values, self.starts[1:-1])
        return self.ranks.scatter(parts)

    def _made(
        self, witness: Witness, proof: Certificate, status: Status, message: str, **more: Any
    ) -> Answer:
        lp, problem = self.lp, self.lp.problem
        w = witness.w if witness.refusal is None else witness.refusal
        solved = status != Status.NOT_STABILIZABLE
        local, error, data, notes = self._beside(witness)
        pairs, talk = sum(self.ranks.collect(lp.K)), Talk.of(lp)
        V_up = witness.V_up if proof.upper_bound else None
        return Answer(
            status=status, backend=BACKEND, gamma=lp.gamma,
            cost=proof.cost if solved else None,
            lower_bound=(proof.lower or 0.0) if solved else None,
            gap=proof.gap if solved else None, tolerance=self.tolerance,
            contraction=proof.contraction, cells=lp.partition.size, controls=len(lp.controls),
            pairs=pairs, attractor_cells=self.extent.status[CellStatus.ATTRACTOR],
            stabilizable_cells=self.extent.inside, local_controller=local,
            seconds=Seconds(self.compile_seconds, self.solve_seconds, self.verify_seconds),
            message=together(message, *notes, talk.note), data=data, integration_error=error,
            problem=problem, partition=lp.partition, certificate=proof,
            control_vectors=lp.controls, starts=self.starts, counted=self.extent.status,
            control_index=self._controls(witness), value=self._over(V_up, np.inf, 0.0, np.inf),
            lower=self._over(witness.W if proof.lower_bound else None, 0.0, 0.0, np.inf),
            measure=self._over(witness.mu, 0.0, 0.0, 0.0), cell_status=lp.cell_status,
            witness=self._over(w, 0.0, 0.0, 0.0), sure_levels=lp.sure_levels, dropped=lp.dropped,
            sure=self._sure(), ended_by_discount=self._ended(witness, proof),
            model_sha256=digest.of_model(self.ranks, lp), lp=lp, **talk.facts(), **more,
        )  # fmt: skip

    def _ended(self, witness: Witness, proof: Certificate) -> float | None:
        """Return the share of runs that the discount ends, as a result says it."""
        b = self.problem.discount
        if b is None or self.lp.gamma != 1 or not proof.measure or witness.mu is None:
            return None
        return min(1.0, (1 - b) * math.fsum(self.ranks.collect(math.fsum(witness.mu))))

    def _sure(self) -> int | None:
        levels = self.lp.sure_levels
        return None if levels is None else sum(self.ranks.collect(int((levels > 0).sum())))

    def _controls(self, witness: Witness) -> NDArray[np.int32]:
        """Return the control of every own cell of the box, -1 where there is none."""
        lp = self.lp
        index = np.full(len(lp.cell_status), -1, dtype=np.int32)
        if witness.policy is not None:
            index[lp.cells - self.starts[self.ranks.rank]] = lp.control[witness.policy]
            index = index if lp.hold is None else np.maximum(index, lp.hold)
        return index

    def _over(
        self, values: Floats | None, missing: float, attractor: float, outside: float
    ) -> Floats:
        """Return values on C over the own part of the box; ``missing`` where there are none."""
        lp = self.lp
        full = np.full(len(lp.cell_status), outside)
        full[lp.cell_status == CellStatus.ATTRACTOR] = attractor
        at = lp.cells - self.starts[self.ranks.rank]
        full[at] = missing if values is None else values
        return full

    def _beside(self, witness: Witness) -> "_Beside":
        """Return what rank 0 finds out beside the proof, and the sentences about it.

        Of a local controller that needs the statuses of all cells.
        """
        lp, finish = self.lp, self.deadline.again()
        equation = lp.problem.flow(cost=False) is not None
        controlled = lp.problem.local_controller is not None
        status = self.ranks.gathered(lp.cell_status) if controlled else None
        hold = None if lp.hold is None else self.ranks.gathered(lp.hold)
        data = self._data(witness, finish)

        def found() -> Any:
            error, local = None, None
            if equation:
                with contextlib.suppress(TimeLimitReached):
                    holds = None if lp.hold is None else status
                    alone = partial(PieceSets.alone, lp.problem, finish)
                    sets = alone() if holds is None else sets_of(holds)
                    error = integration_error(lp.problem, sets, finish)
            if status is not None:
                local = check_of(replace(lp, cell_status=status, hold=hold, mesh=None), finish)
            held = holding.note(lp.problem, lp.partition, hold)
            notes = [attractor_note(lp.problem, lp.partition), held,
                     data.sentence() if data else "", error.warning() if error else ""]  # fmt: skip
            return local, error, data, notes

        beside: _Beside = self.ranks.by_first(found)
        return beside

    def _data(self, witness: Witness, finish: Deadline) -> DataReport | None:
        """Report on recorded data, which every rank holds whole; collective, known to rank 0."""
        lp = self.lp
        if not isinstance(lp.problem.system, DataSystem):
            return None
        model, pairs = whole.model(lp), self.ranks.collect(lp.K)
        known = self.ranks.all(witness.policy is not None)
        own = witness.policy if known else np.empty(0, dtype=np.int64)
        assert own is not None
        policy = self.ranks.gathered(own + sum(pairs[: self.ranks.rank]))
        guard = partial(finish.raise_if_over, "bounding the true cost")

        def found() -> DataReport | None:
            return None if model is None else DataReport.of(model, policy if known else None, guard)

        return self.ranks.agreed(found)


_Beside = tuple[LocalCheck | None, IntegrationError | None, DataReport | None, list[str]]


def _nothing(tolerance: float, message: str, assumes: str = "") -> Certificate:
    """Return a certificate that claims nothing."""
    return Certificate(
        *(False,) * 5, *(None,) * 5, tolerance=tolerance, reasons=(message,), assumes=assumes
    )

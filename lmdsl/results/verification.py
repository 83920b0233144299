"""Checking a saved result: recompile the problem, then judge every claim of the directory.

Nothing in the directory is trusted: the finite model is made anew from the problem, and the stored
vectors are checked against it by the same inequalities that certified them.
"""

import os
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.certificate.exact_sums import BLOCK
from lmdsl.certificate.judge import exact_verdict, verdict
from lmdsl.common import inputs
from lmdsl.common.records import Reported, jsonable
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.errors import BadInput, printable
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.progress import Counted
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.assembly.estimates import estimate, refuse_given
from lmdsl.model.assembly.transitions import shares_of
from lmdsl.model.discretization import noise_nodes, sample_points
from lmdsl.model.local import holding
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.model.rows import Rows
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.optimize.feasibility.restriction import restricted
from lmdsl.results.directory import archive, audit
from lmdsl.results.directory.functions import function_differences, function_notes
from lmdsl.results.directory.proved import proof_findings
from lmdsl.results.directory.recorded import policy_of
from lmdsl.results.directory.repair import repaired
from lmdsl.results.directory.repair.repaired import Judge
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status
from lmdsl.systems import MatrixSystem


@dataclass(frozen=True)
class Verification(Reported):
    """The outcome of :func:`verify`.

    Attributes
    ----------
    holds
        The status is ``verified`` or ``not_stabilizable`` and every claim holds.
    status
        The status the directory claims.
    same_model
        The recompiled model has the stored digest, bit for bit.
    certificate
        The claims as judged now.
    reasons
        What does not hold, one sentence each.
    notes
        What else to know, one sentence each.
    scope
        What the claims speak of.
    """

    holds: bool
    status: Status
    same_model: bool
    certificate: Certificate
    reasons: tuple[str, ...]
    notes: tuple[str, ...]
    scope: str = "the finite model: cells and sampled transitions"

    def text(self) -> str:
        """Return the outcome for people."""
        lines = [f"{self.status}: " + ("every claim holds" if self.holds else "NOT confirmed")]
        proof = self.certificate
        if proof.gap is not None:
            lines.append(f"  gap {proof.gap:.2g}, tolerance {proof.tolerance:.2g}")
        lines += [f"  {printable(sentence)}" for sentence in (*self.reasons, *self.notes)]
        if proof.assumes:
            lines.append(f"  assumed: {proof.assumes}")
        scope = self.scope
        if proof.safe == "assumed":
            lines.append("  assumed, not proved: that no run of the map is lost (claim 7)")
        elif proof.safe:
            scope += "; safe of the map as compiled"
        return "\n".join([*lines, f"  (claims speak of {scope})"])

    __str__ = text

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        proof = self.certificate
        return {
            "holds": self.holds,
            "status": self.status.value,
            "same_model": self.same_model,
            "claims": proof.claims,
            "cost": jsonable(proof.cost),
            "lower_bound": jsonable(proof.lower),
            "gap": jsonable(proof.gap),
            "tolerance": jsonable(proof.tolerance),
            "contraction": jsonable(proof.contraction),
            "assumes": proof.assumes,
            "reasons": list(self.reasons),
            "notes": list(self.notes),
        }


@own_arithmetic
def verify(
    path: str | os.PathLike[str], *, exact: bool = False, progress: Progress | bool | None = None,
    time_limit: float | Deadline | None = None, rows_on_disk: FilePath | None = None,
) -> Verification:  # fmt: skip
    """Recompile the problem of a result directory and check every claim it makes.

    Parameters
    ----------
    path
        The result directory.
    exact
        Judge in rational arithmetic, without tolerance on claims 1 to 3 (slower).
    progress
        Called with (stage, fraction done) during long work; True shows it on stderr.
    time_limit
        Seconds.
    rows_on_disk
        A folder: the rows that are made anew lie there instead of in memory.

    Raises
    ------
    TimeLimitReached
        The time limit was reached.
    BadInput
        The directory cannot be read.
    """
    progress, deadline = told(progress), Deadline.of(time_limit)
    in_time = partial(deadline.raise_if_over, "verifying")
    exactly = partial(exact_verdict, guard=in_time)
    judge = exactly if inputs.flag(exact, "exact") else verdict
    path = inputs.path(path)
    stored = archive.read(path)
    result, reasons = stored.result, list[str]()
    notes = [audit.REWRITTEN.format(name) for name in stored.rewritten]
    lp = whole = recompiled(path, result, progress, deadline, rows_on_disk)
    in_time()
    if progress:  # told at once, and where an exact judge reads blocks of rows
        counted = Counted(in_time, progress, -(-lp.n // BLOCK) - (-lp.K // BLOCK))
        judge = partial(exact_verdict, guard=counted) if exact else judge
    if result.problem.functions:
        reasons += function_differences(lp, result)
        notes = function_notes(result) + notes
    lp = _restricted(lp, result, reasons, judge)
    same = archive.names(result, lp)
    if not same:
        notes.append(audit.OTHER_MODEL)
    if not same_cells(lp, result):
        reasons.append(audit.OTHER_CELLS)
    if result.status == Status.NOT_STABILIZABLE:
        certificate = _judge_refusal(lp, result, reasons, judge)
    else:
        certificate = _judge_claims(lp, result, reasons, judge)
        if result.status != Status.VERIFIED:
            reasons.append(f"the status is {result.status}, not verified")
    reasons += audit.differences(whole, lp, result, stored.certificate, certificate)
    in_time()
    reasons += audit.local_differences(lp, result, stored.certificate, deadline)
    reasons += proof_findings(path, result, stored.certificate.proof, in_time, notes)
    declared = partial(compile, result.problem, progress, deadline, rows_on_disk=rows_on_disk)
    reasons += repaired.differences(result, stored.certificate.proof, declared, lp, judge, deadline)
    said = tuple(reasons), tuple(notes)
    found = Verification(not reasons, result.status, same, certificate, *said)
    system = result.problem.system
    return replace(found, scope=system.scope) if isinstance(system, MatrixSystem) else found


def _restricted(
    lp: StabilizationLP, result: Result, reasons: list[str], judge: Judge
) -> StabilizationLP:
    """Return the part of the model a restricted result speaks of, its refusal checked."""
    beyond = result.cell_status[lp.cells] == CellStatus.BEYOND_GAMMA
    if not beyond.any():
        return lp
    w = np.where(beyond, result.refusal_vector[lp.cells], 0.0)
    if not (w[beyond] > 0).all() or not judge(lp, Witness(None, refusal=w), 0.0).refusal:
        reasons.append(audit.NOT_REFUSED)
    return restricted(lp, w) or lp


def recompiled(
    path: str | os.PathLike[str], result: Result, progress: Progress | None = None,
    time_limit: float | Deadline | None = None, rows_on_disk: FilePath | None = None,
) -> StabilizationLP:  # fmt: skip
    """Return the finite model of a directory made anew; of Python functions, what they gave."""
    problem, made = result.problem, partial(compile, rows_on_disk=rows_on_disk)
    if "system" in problem.functions:
        refuse_given(rows_on_disk)
        return _stored_model(path, result)
    if not problem.functions:
        return made(problem, progress, time_limit, dropped=result.dropped)
    lp = made(problem.replaced(stage_cost="0"), progress, time_limit)
    cost = archive.read_model(path, result, {"cost": ((lp.K,), "<f8")})["cost"]
    if not (np.isfinite(cost) & (cost >= 0)).all():
        raise BadInput("the saved costs are inconsistent", "model.npz")
    return replace(lp, problem=problem, cost=cost)


def same_cells(lp: StabilizationLP, result: Result) -> bool:
    """Return whether cells are what they were; where none holds, earlier ones had other causes."""
    ours, theirs = lp.cell_status, result.cell_status
    if result.cause == Cause.HOLD:
        ours, theirs = (np.where(np.isin(x, LOST), CellStatus.TRAPPED, x) for x in (ours, theirs))
    return np.array_equal(ours, theirs)


def _judge_claims(
    lp: StabilizationLP, result: Result, reasons: list[str], judge: Judge
) -> Certificate:
    policy = policy_of(lp, result)
    if policy is None:
        reasons.append(audit.NO_POLICY)
    on = lp.cells
    V_up, W = result.value[on], result.lower[on]
    witness = Witness(policy, result.stability_vector[on], V_up, W, result.measure[on])
    certificate = judge(lp, witness, result.tolerance or 0.0)
    reasons += certificate.reasons
    return certificate


def _judge_refusal(
    lp: StabilizationLP, result: Result, reasons: list[str], judge: Judge
) -> Certificate:
    witness = Witness(None, refusal=result.refusal_vector[lp.cells])
    certificate = judge(lp, witness, result.tolerance or 0.0)
    proved = {
        Cause.EMPTY: not lp.n,
        Cause.MEASURE: bool(lp.n) and not lp.weight.any(),
        Cause.REQUIRE_ALL: bool(np.isin(lp.cell_status, LOST).any()),
        Cause.GAMMA: certificate.refusal,
        Cause.HOLD: holding.none_holds(lp.hold),
    }
    if result.cause is None or not proved[result.cause]:
        reasons.append(audit.UNPROVED.format(result.cause))
    return certificate


def _stored_model(path: str | os.PathLike[str], result: Result) -> StabilizationLP:
    """Rebuild the LP of a Python function from its saved rows."""
    status, problem = result.cell_status, result.problem
    sets = CellSets.of(problem, result.partition)
    cells = np.flatnonzero(status == CellStatus.STABILIZED)
    n, K = len(cells), int(result.pairs or 0)
    memory.require(estimate(problem), "the saved rows")
    nodes, points = noise_nodes(problem), sample_points(problem)
    kinds = {"pair_pointer": ((n + 1,), "<i8"), "control": ((K,), "<i4"),
             "pointer": ((K + 1,), "<i8"), "cost": ((K,), "<f8")}  # fmt: skip
    small = archive.read_model(path, result, kinds)
    entries = int(small["pointer"][-1])
    if not 0 <= entries <= K * (points * len(nodes.weights) + 1):
        raise BadInput("pointer is out of range", "model.npz")
    large = archive.read_model(
        path, result, {"target": ((entries,), "<i4"), "code": ((entries,), "<u4")}
    )
    shares = shares_of(problem, points, nodes)
    rows = Rows(
        small["pointer"],
        large["target"],
        large["code"].astype(np.min_scalar_type(max(len(shares.numerator) - 1, 0))),
        shares,
        n,
    )
    _refuse_broken(rows, small, len(result.control_vectors))
    return StabilizationLP(
        problem, result.partition, result.control_vectors, status, cells,
        small["pair_pointer"], small["control"], rows, small["cost"], problem.gamma,
        sets.weight(cells), hold=holding.stored(problem, status, result.control_index),
    )  # fmt: skip


def _refuse_broken(rows: Rows, small: dict[str, Any], controls: int) -> None:
    pairs, pointer = small["pair_pointer"], rows.pointer
    sound = (
        pairs[0] == 0
        and pairs[-1] == rows.count
        and (np.diff(pairs) > 0).all()
        and pointer[0] == 0
        and (np.diff(pointer) > 0).all()
        and _increasing(small["control"], pairs)
        and ((small["control"] >= 0) & (small["control"] < controls)).all()
        and ((rows.target >= 0) & (rows.target <= rows.columns)).all()
        and (rows.code < len(rows.shares.numerator)).all()
        and (np.isfinite(small["cost"]) & (small["cost"] >= 0)).all()
    )
    if not sound:
        raise BadInput("the saved rows are inconsistent", "model.npz")
    ended = rows.shares.ended
    if ended is not None:
        at, last = np.flatnonzero(rows.code == ended), pointer[1:] - 1
        if not (np.array_equal(at, last) and (rows.target[last] == rows.columns).all()):
            raise BadInput("not every row ends by discount as its last entry", "model.npz")
    for k in range(rows.count):
        if sum(share for _, share in rows.exact(k)) != rows.total(k):
            raise BadInput(f"row {k} does not sum to 1", "model.npz")


def _increasing(control: Any, pairs: Any) -> bool:
    """Return whether the controls of every cell stand in order, each once."""
    first = np.zeros(len(control), dtype=bool)
    first[pairs[:-1]] = True
    return bool((first[1:] | (np.diff(control) > 0)).all())

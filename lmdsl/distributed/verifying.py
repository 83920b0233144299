"""A saved result checked over ranks: each compiles and judges its own cells.

What must hold: the outcome is that of :func:`lmdsl.verify`. Another version of the digest, exact
arithmetic, repairs and Python functions are left to rank 0, which checks them as one process does;
so are the boxes of a proof. The rest is compared by all (``auditing.py``).
"""

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.common import inputs
from lmdsl.common.on_disk import Disk
from lmdsl.common.types import FilePath, Guard, Progress, told
from lmdsl.distributed import auditing, loading
from lmdsl.distributed.auditing import OwnPart
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.ranks.ending import together
from lmdsl.ranks.mpi import at_hand
from lmdsl.ranks.verbs import Ranks
from lmdsl.results.directory import audit
from lmdsl.results.directory.archive import Stored
from lmdsl.results.directory.proved import proof_findings
from lmdsl.results.status import Cause, Status
from lmdsl.results.verification import Verification, same_cells
from lmdsl.results.verification import verify as verify_alone
from lmdsl.slabs import compiling, digest, judging
from lmdsl.slabs.gamma import restricting
from lmdsl.systems import MatrixSystem


@own_arithmetic
def verify(
    path: str | os.PathLike[str],
    *,
    exact: bool = False,
    progress: Progress | bool | None = None,
    time_limit: float | None = None,
    rows_on_disk: FilePath | None = None,
    ranks: Ranks | None = None,
) -> Verification:
    """Recompile the problem of a result directory over ranks and check every claim it makes.

    Parameters
    ----------
    path
        The result directory, which all ranks see.
    exact, time_limit, rows_on_disk
        As for :func:`lmdsl.verify`.
    progress
        Of rank 0: called with (stage, fraction done) during long work; True shows it on stderr.
    ranks
        Who works together: the ranks of the launcher, if not given.

    Returns
    -------
    Verification
        The same on every rank.

    Raises
    ------
    TimeLimitReached, BadInput
        On every rank, as :func:`lmdsl.verify` does.
    """
    everyone = at_hand() if ranks is None else ranks
    heard = told(progress) if everyone.rank == 0 else None

    def program(ranks: Ranks) -> Verification:
        deadline = ranks.agreed(lambda: Deadline.of(time_limit))
        exactly = ranks.agreed(lambda: inputs.flag(exact, "exact"))
        place = ranks.agreed(lambda: inputs.path(path))
        whole = exactly or loading.version(ranks, place) != 2
        stored = None if whole else loading.read(ranks, place)
        if stored is not None:
            ranks.alike(stored.certificate.model_dump_json(), "certificates")
        if stored is None or _needs_all(stored):
            return ranks.by_first(lambda: verify_alone(
                    path, exact=exactly, progress=heard, time_limit=deadline,
                    rows_on_disk=rows_on_disk,
                ),
            )  # fmt: skip
        disk = ranks.agreed(lambda: Disk.of(rows_on_disk))
        return _verified(ranks, place, stored, deadline, disk)

    return together(everyone, program)


def _needs_all(stored: Stored) -> bool:
    """Return whether something is claimed that is checked on the whole model, or by functions."""
    result = stored.result
    return bool(result.digest != 2 or result.problem.functions or result.proved is not None)


def _verified(
    ranks: Ranks, path: Path, stored: Stored, deadline: Deadline, disk: Disk | None
) -> Verification:
    result, problem = stored.result, stored.result.problem
    whole = compiling.compiled(ranks, problem, deadline, disk)
    reasons = list[str]()
    notes = [audit.REWRITTEN.format(name) for name in ranks.share(stored.rewritten)]
    model = _restricted(OwnPart.of(ranks, stored, whole), reasons)
    lp, own = model.lp, model.own
    same = digest.of_model(ranks, lp) == result.model_sha256
    if not same:
        notes.append(audit.OTHER_MODEL)
    if not ranks.all(same_cells(lp, own)):
        reasons.append(audit.OTHER_CELLS)
    if result.status == Status.NOT_STABILIZABLE:
        certificate = _judged_refusal(model, reasons)
    else:
        certificate = _judged_claims(model, reasons)
        if result.status != Status.VERIFIED:
            reasons.append(f"the status is {result.status}, not verified")
    in_time = partial(deadline.raise_if_over, "verifying")
    reasons += auditing.differences(model, whole, certificate, deadline)
    ranks.agreed(in_time)
    reasons += auditing.local_differences(model, deadline)
    wrong, noted = ranks.by_first(lambda: _of_proof(path, stored, in_time))
    reasons += wrong
    notes += noted
    said = tuple(reasons), tuple(notes)
    found = Verification(not reasons, result.status, same, certificate, *said)
    system = problem.system
    return replace(found, scope=system.scope) if isinstance(system, MatrixSystem) else found


def _of_proof(path: Path, stored: Stored, guard: Guard) -> tuple[list[str], list[str]]:
    """Return what does not hold of the proof of a directory, and what is noted of one that does."""
    notes = list[str]()
    return proof_findings(path, stored.result, stored.certificate.proof, guard, notes), notes


def _restricted(model: OwnPart, reasons: list[str]) -> OwnPart:
    """Return the part of the model that a restricted result speaks of, its refusal checked."""
    ranks, lp, own, on = model.ranks, model.lp, model.own, model.cells
    beyond = own.cell_status[on] == CellStatus.BEYOND_GAMMA
    if not ranks.any(bool(beyond.any())):
        return model
    w = np.where(beyond, own.refusal_vector[on], 0.0)
    positive = ranks.all(bool((w[beyond] > 0).all()))
    if not judging.verdict(lp, Witness(None, refusal=w), 0.0).refusal or not positive:
        reasons.append(audit.NOT_REFUSED)
    left = restricting.restricted(lp, ~(w == 0), model.first)  # also where a file says -1 or NaN
    return model if left is None else OwnPart.of(ranks, model.stored, left)


def _judged_claims(model: OwnPart, reasons: list[str]) -> Certificate:
    """Judge the claims of what is stored for own cells."""
    own, on, policy = model.own, model.cells, model.policy
    if not model.law:
        reasons.append(audit.NO_POLICY)
    witness = Witness(
        policy, own.stability_vector[on], own.value[on], own.lower[on], own.measure[on]
    )
    certificate = judging.verdict(model.lp, witness, own.tolerance or 0.0)
    reasons += certificate.reasons
    return certificate


def _judged_refusal(model: OwnPart, reasons: list[str]) -> Certificate:
    """Judge a refusal: what is stored for own cells, and its cause."""
    own, extent = model.own, model.extent
    witness = Witness(None, refusal=own.refusal_vector[model.cells])
    certificate = judging.verdict(model.lp, witness, own.tolerance or 0.0)
    proved = {
        Cause.EMPTY: not extent.inside,
        Cause.MEASURE: extent.inside > 0 and not extent.weighed,
        Cause.REQUIRE_ALL: any(extent.status[code] for code in LOST),
        Cause.GAMMA: certificate.refusal,
        Cause.HOLD: not extent.held,
    }
    if own.cause is None or not proved[own.cause]:
        reasons.append(audit.UNPROVED.format(own.cause))
    return certificate

"""A saved result checked over ranks: each compiles and judges its own cells.

What must hold: the outcome is that of :func:`lmdsl.verify`. What compares whole models (another
version of the digest, exact arithmetic, brackets of gamma_bar, proofs, repairs, functions, data) is
checked by rank 0 alone, as one process checks it.
"""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.common import inputs
from lmdsl.common.on_disk import Disk
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.distributed import loading
from lmdsl.distributed.making import AnswerMaker
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.ranks.ending import together
from lmdsl.ranks.mpi import at_hand
from lmdsl.ranks.verbs import Item, Ranks
from lmdsl.results.directory import archive, audit
from lmdsl.results.directory.recorded import policy_of
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status
from lmdsl.results.verification import Verification
from lmdsl.results.verification import verify as verify_alone
from lmdsl.slabs import compiling, digest, judging
from lmdsl.systems import DataSystem, MatrixSystem

VECTORS = ("control_index", "value", "lower", "measure", "cell_status", "witness")


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
        if stored is None or _needs_all(ranks, stored):
            return by_first(
                ranks,
                lambda: verify_alone(
                    path, exact=exactly, progress=heard, time_limit=deadline,
                    rows_on_disk=rows_on_disk,
                ),
            )  # fmt: skip
        disk = ranks.agreed(lambda: Disk.of(rows_on_disk))
        return _verified(ranks, stored, deadline, disk)

    return together(everyone, program)


def by_first(ranks: Ranks, work: Callable[[], Item]) -> Item:
    """Return what rank 0 makes, on every rank; its error is raised on all. Collective."""
    found = ranks.agreed(lambda: work() if ranks.rank == 0 else None)
    return ranks.share(found)


def _needs_all(ranks: Ranks, stored: archive.Stored) -> bool:
    """Return whether something is claimed that is checked on the whole model; collective."""
    result = stored.result
    problem, local = result.problem, result.problem.local_controller
    beyond = result.gamma_bar is not None or result.cause in (Cause.GAMMA, Cause.HOLD)
    whole = problem.functions or isinstance(problem.system, DataSystem | MatrixSystem)
    held = local is not None and local.kind == "hold"
    repaired = stored.certificate.proof is not None or result.proved is not None
    N = len(result.cell_status)
    share = slice(N * ranks.rank // ranks.count, N * (ranks.rank + 1) // ranks.count)
    limited = ranks.any(bool((result.cell_status[share] == CellStatus.BEYOND_GAMMA).any()))
    return bool(
        result.digest != 2 or beyond or whole or held or repaired or limited or stored.rewritten
    )


def _verified(
    ranks: Ranks, stored: archive.Stored, deadline: Deadline, disk: Disk | None
) -> Verification:
    result = stored.result
    lp = compiling.compiled(ranks, result.problem, deadline, disk)
    maker = AnswerMaker(ranks, result.problem, result.tolerance or 0.0, deadline)
    maker.of_model(lp)
    first, last = (int(n) for n in maker.starts[ranks.rank : ranks.rank + 2])
    own = replace(result, **{name: getattr(result, name)[first:last] for name in VECTORS})
    if result.sure_levels is not None:
        own = replace(own, sure_levels=result.sure_levels[first:last])
    part = replace(lp, cells=lp.cells - first, _known=lp._algorithm_1)
    reasons, notes = list[str](), list[str]()
    same = digest.of_model(ranks, lp) == result.model_sha256
    if not same:
        notes.append("the recompiled model differs from the stored one; claims are judged on it")
    if not ranks.all(np.array_equal(lp.cell_status, own.cell_status)):
        reasons.append("cell_status differs from the recompiled model")
    if not ranks.all(_same_levels(lp, own)):
        reasons.append("sure_levels differ from the recompiled model")
    if result.status == Status.NOT_STABILIZABLE:
        certificate = judging.verdict(lp, Witness(None), maker.tolerance)
        reasons += _unproved(maker, result)
    else:
        certificate = _judged(lp, part, own, maker.tolerance, reasons)
        if result.status != Status.VERIFIED:
            reasons.append(f"the status is {result.status}, not verified")
    reasons += _differences(maker, part, own, stored, certificate)
    in_time = partial(deadline.raise_if_over, "verifying")
    ranks.agreed(in_time)
    whole = lp
    if ranks.rank == 0:
        whole = replace(lp, cell_status=result.cell_status, sure_levels=None, mesh=None)
    reasons += by_first(
        ranks, lambda: audit.local_differences(whole, result, stored.certificate, deadline)
    )
    return Verification(not reasons, result.status, same, certificate, tuple(reasons), tuple(notes))


def _same_levels(lp: StabilizationLP, own: Result) -> bool:
    """Return whether what is stored of sure arrival, of own cells, is what was found."""
    found, stored = lp.sure_levels, own.sure_levels
    return found is stored if found is None or stored is None else np.array_equal(found, stored)


def _judged(
    lp: StabilizationLP, part: StabilizationLP, own: Result, tolerance: float, reasons: list[str]
) -> Certificate:
    """Judge the claims of what is stored for own cells, which ``part`` numbers from 0."""
    assert lp.mesh is not None
    ranks, policy, on = lp.mesh.ranks, policy_of(part, own), part.cells
    nothing = np.empty(0, dtype=np.int64)
    if not ranks.all(policy is not None or not lp.n):
        reasons.append("control_index is no policy on the stabilizable set")
        policy = None
    elif policy is None:
        policy = nothing
    w, mu = own.stability_vector[on], own.measure[on]
    witness = Witness(policy, w, own.value[on], own.lower[on], mu)
    certificate = judging.verdict(lp, witness, tolerance)
    reasons += certificate.reasons
    return certificate


def _unproved(maker: AnswerMaker, result: Result) -> list[str]:
    """Return whether the cause of a refusal is none, in a sentence."""
    extent = maker.extent
    proved = {
        Cause.EMPTY: not extent.inside,
        Cause.MEASURE: extent.inside > 0 and not extent.weighed,
        Cause.REQUIRE_ALL: any(extent.status[code] for code in LOST),
    }
    if result.cause is not None and proved.get(result.cause):
        return []
    return [f"the refusal ({result.cause}) is not proved by the recompiled model"]


def _differences(
    maker: AnswerMaker,
    lp: StabilizationLP,
    own: Result,
    stored: archive.Stored,
    found: Certificate,
) -> list[str]:
    """Return where the certificate says something else than what was found, as one process does."""
    ranks, extent = maker.ranks, maker.extent
    counts = {
        "gamma": lp.gamma,
        "cells": lp.partition.size,
        "controls": len(lp.controls),
        "pairs": sum(ranks.collect(lp.K)),
        "attractor_cells": extent.status[CellStatus.ATTRACTOR],
        "stabilizable_cells": extent.inside,
    }
    mass = sum(ranks.collect(audit.mass(lp, own)))
    reasons = [*audit.counts(counts, own), *audit.numbers(own, found)]
    for outside in ranks.collect(audit.outside(lp, own)):
        reasons += [sentence for sentence in outside if sentence not in reasons]
    reasons += by_first(ranks, lambda: audit.facts(own, stored.certificate, found, mass))
    return reasons

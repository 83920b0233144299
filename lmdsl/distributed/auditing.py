"""What a directory says, compared with what ranks found anew, as ``results/directory/audit.py``.

Each rank looks at its own cells. What needs all of them is found by rank 0: the law of the
attractor cells, what follows from recorded data, and the bracket of gamma_bar where the model is
small; of a larger one all ranks prove it.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lmdsl.certificate.claims import Certificate
from lmdsl.common.types import Indices, Policy
from lmdsl.distributed.making import AnswerMaker
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.boxes import Area
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.optimize.feasibility import gamma_bar
from lmdsl.ranks.verbs import Ranks
from lmdsl.results.directory import audit
from lmdsl.results.directory.archive import Stored
from lmdsl.results.directory.recorded import data_differences, policy_of
from lmdsl.results.job import Extent
from lmdsl.results.result import Result
from lmdsl.results.status import Cause
from lmdsl.slabs.chains.evaluating import MOST_GATHERED
from lmdsl.slabs.gamma import bracket, whole
from lmdsl.systems import DataSystem

VECTORS = ("control_index", "value", "lower", "measure", "cell_status", "witness", "sure_levels")


@dataclass(frozen=True, eq=False)
class OwnPart:
    """What a rank checks: its own cells of a model compiled anew, and what is stored for them.

    Attributes
    ----------
    ranks, stored
        Who checks together, and what the directory holds.
    lp
        The model, or the part of it that a restricted result speaks of.
    first, own
        First cell of the own part of the box, and the result with the vectors of that part.
    extent, pairs
        How many cells, of all ranks, are what; and the number of all pairs.
    policy, law
        The stored policy: own columns, None where that is none on every rank that has cells of C;
        and whether it is one.
    """

    ranks: Ranks
    stored: Stored
    lp: StabilizationLP
    first: int
    own: Result
    extent: Extent
    pairs: int
    policy: Policy | None
    law: bool

    @classmethod
    def of(cls, ranks: Ranks, stored: Stored, lp: StabilizationLP) -> "OwnPart":
        """Return the own part of a model; collective."""
        result = stored.result
        maker = AnswerMaker(ranks, result.problem, result.tolerance or 0.0, Deadline())
        maker.of_model(lp)
        first, last = (int(n) for n in maker.starts[ranks.rank : ranks.rank + 2])
        arrays = {name: getattr(result, name) for name in VECTORS}
        cut = {name: x[first:last] for name, x in arrays.items() if x is not None}
        own = replace(result, proof=None, **cut)  # which rank 0 alone reads
        pairs = sum(ranks.collect(lp.K))
        policy = policy_of(replace(lp, cells=lp.cells - first, _known=lp._algorithm_1), own)
        if policy is None and not lp.n:
            policy = np.empty(0, dtype=np.int64)
        law = ranks.all(policy is not None) and pairs > 0
        return cls(ranks, stored, lp, first, own, maker.extent, pairs, policy if law else None, law)

    @property
    def cells(self) -> Indices:
        """Own cells of C, by their place in the own part of the box."""
        return self.lp.cells - self.first


def differences(
    model: OwnPart, compiled: StabilizationLP, found: Certificate, deadline: Deadline
) -> list[str]:
    """Return where the certificate says something else than what was found; collective.

    ``compiled`` is the whole model, as :func:`audit.differences` has it.
    """
    ranks, stored, lp, own = model.ranks, model.stored, model.lp, model.own
    here = replace(lp, cells=model.cells, _known=lp._algorithm_1)
    reasons = [*audit.counts(_counted(model), own), *audit.numbers(own, found)]
    wrong = ranks.collect(audit.outside(here, own, model.law))
    reasons += audit.said_of(np.any(wrong, axis=0).tolist())
    if not ranks.all(same_levels(compiled, own)):
        reasons.append(audit.OTHER_LEVELS)
    mass, beyond = sum(ranks.collect(audit.mass(here, own))), _beyond(model)
    reasons += ranks.by_first(lambda: audit.facts(own, stored.certificate, found, mass, beyond))
    every = whole.model(lp) if isinstance(lp.problem.system, DataSystem) else lp
    reasons += ranks.by_first(
        lambda: [] if every is None else data_differences(every, stored.result)
    )
    bracketed = partial(_enclosed, model, compiled, found, deadline)
    return [*reasons, *audit.bracket(own, found, compiled.gamma, bracketed)]


def same_levels(lp: StabilizationLP, own: Result) -> bool:
    """Return whether what is stored of sure arrival, of own cells, is what was found."""
    found, stored = lp.sure_levels, own.sure_levels
    return found is stored if found is None or stored is None else np.array_equal(found, stored)


def local_differences(model: OwnPart, deadline: Deadline) -> list[str]:
    """Return where the local controller does less than the directory says; collective.

    Rank 0 checks it, which has status and control of all cells for that.
    """
    ranks, lp, status, hold = model.ranks, model.lp, None, None
    if lp.problem.local_controller is not None:
        status = ranks.gathered(lp.cell_status)
        hold = None if lp.hold is None else ranks.gathered(lp.hold)
    every = replace(lp, cell_status=lp.cell_status if status is None else status,
                    hold=hold, sure_levels=None, mesh=None)  # fmt: skip
    result, certificate = model.stored.result, model.stored.certificate
    return ranks.by_first(lambda: audit.local_differences(every, result, certificate, deadline))


def _counted(model: OwnPart) -> dict[str, float]:
    """Return what is counted of all cells."""
    return {
        "gamma": model.lp.gamma,
        "cells": model.lp.partition.size,
        "controls": len(model.lp.controls),
        "pairs": model.pairs,
        "attractor_cells": model.extent.status[CellStatus.ATTRACTOR],
        "stabilizable_cells": model.extent.inside,
    }


def _beyond(model: OwnPart) -> Area | None:
    """Return the cells that the vectors prove infeasible, on rank 0; collective."""
    own = model.own
    mask = own.cell_status == CellStatus.BEYOND_GAMMA
    if own.cause == Cause.GAMMA:
        mask = mask | (own.refusal_vector > 0)
    cells = model.ranks.gathered(model.first + np.flatnonzero(mask))
    return Area.of(model.lp.partition, cells) if cells is not None and len(cells) else None


def _enclosed(
    model: OwnPart, compiled: StabilizationLP, found: Certificate, deadline: Deadline,
    low: float, high: float,
) -> tuple[float, float]:  # fmt: skip
    """Return a bracket of gamma_bar that is proved anew; collective."""
    ranks = model.ranks
    if whole.fits(compiled, whole.MOST_WHOLE):
        every = whole.model(compiled)
        return ranks.by_first(
            lambda: (0.0, 0.0) if every is None else gamma_bar.enclosed(every, low, high)
        )
    refused = found.refusal and model.lp is compiled
    w = model.own.refusal_vector[model.cells] if refused else None
    return bracket.enclosed(compiled, w, MOST_GATHERED, ranks.time_up(deadline), low, high)

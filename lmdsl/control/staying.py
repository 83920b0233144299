"""Whether the attractor cells are kept, whichever local controller a problem names."""

from functools import partial

import numpy as np

from lmdsl.control.invariance import LocalCheck, examine
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.local.controller import LocalController
from lmdsl.model.local.holding import Controls, HoldingLaw
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus, sets_of
from lmdsl.model.successors.inclusion import Inclusion
from lmdsl.systems import FunctionSystem


def check_of(
    lp: StabilizationLP,
    deadline: Deadline,
    samples: int | None = None,
    hold: Controls | None = None,
) -> LocalCheck | None:
    """Check the local controller of a compiled problem; None where it names none.

    ``hold`` are controls of the cells that hold, by default the model's own; see
    :func:`lmdsl.control.invariance.examine` for the others.
    """
    problem, partition = lp.problem, lp.partition
    attractor = lp.cell_status == CellStatus.ATTRACTOR
    if lp.hold is None:
        local = LocalController.of(problem, partition, attractor, deadline)
        return None if local is None else examine(problem, local, deadline, samples)
    hold = lp.hold if hold is None else hold
    cells, holding = int(attractor.sum()), int((hold >= 0).sum())
    if not holding:
        return LocalCheck("hold", None, cells, 0, 0, 0, 0)
    law = HoldingLaw.of(problem, partition, hold)
    proved = _enclosed(lp, hold, deadline)
    found = examine(problem, law, deadline, samples, proved)
    return LocalCheck("hold", None, cells, found.proved, found.samples, found.kept, holding)


def _enclosed(lp: StabilizationLP, hold: Controls, deadline: Deadline) -> int | None:
    """Count the cells that hold by all that images can meet; None where samples were compiled.

    It is none where the time is up before the last is proved. Nothing is proved of a function.
    """
    if lp.problem.successors != "enclosed" or isinstance(lp.problem.system, FunctionSystem):
        return None
    cells = np.flatnonzero(hold >= 0)
    guard = partial(deadline.raise_if_over, "checking the local controller")
    try:
        inclusion = Inclusion(lp.problem, lp.partition, sets_of(lp.cell_status), hold >= 0)
        return int(inclusion(cells, hold[cells], guard).sum())
    except TimeLimitReached:
        return 0

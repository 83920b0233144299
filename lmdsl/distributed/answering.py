"""A problem compiled, solved and judged over ranks, in the words of one process.

What must hold: statuses, causes, policies and claims are those of :func:`lmdsl.solve`, whatever the
number of ranks, and every rank returns the same facts. What is rare and needs all pairs at once, as
gamma_bar does, is found by rank 0 with the code of one process, where the model is small.
"""

import time
from pathlib import Path
from typing import NamedTuple

from lmdsl.common.on_disk import Disk
from lmdsl.common.types import FilePath, Progress
from lmdsl.distributed.answer import Answer
from lmdsl.distributed.making import AnswerMaker
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize import checkpoints
from lmdsl.problem.problem import Problem
from lmdsl.ranks.verbs import Ranks
from lmdsl.results import solving as alone
from lmdsl.results.job import ruled_out
from lmdsl.results.result import Result
from lmdsl.slabs import compiling, solving
from lmdsl.slabs.chains.evaluating import MOST_GATHERED
from lmdsl.slabs.gamma import bracket, whole
from lmdsl.slabs.gamma.restricting import restricted


class Wanted(NamedTuple):
    """What is asked of a solve over ranks; see :func:`lmdsl.solve`.

    Attributes
    ----------
    tolerance, time_limit, require_all, restrict_to_gamma
        As of ``solve``.
    gathered
        Number of cells up to which rank 0 evaluates policies, else all ranks do.
    rows_on_disk, checkpoint, resume
        As of ``solve``: folders, of which the last two are the same on every rank.
    whole
        Number of transitions up to which rank 0 holds the whole model, where that is needed.
    """

    tolerance: float = alone.TOLERANCE
    time_limit: float | Deadline | None = None
    require_all: bool = False
    restrict_to_gamma: bool = False
    gathered: int = MOST_GATHERED
    whole: int = whole.MOST_WHOLE
    rows_on_disk: FilePath | None = None
    checkpoint: FilePath | None = None
    resume: FilePath | None = None


def answer(
    ranks: Ranks, problem: Problem, wanted: Wanted | None = None, progress: Progress | None = None
) -> Answer:
    """Compile, solve and judge a problem over ranks; collective.

    Every rank gives the same problem and wishes; ``progress`` is told by those that give it.

    Raises
    ------
    BadInput
        On every rank, with one message: what :func:`lmdsl.solve` raises, or that something does
        not run over several ranks.
    """
    wanted = wanted or Wanted()
    deadline, started = Deadline.of(wanted.time_limit), time.perf_counter()
    maker = AnswerMaker(ranks, problem, wanted.tolerance, deadline)
    folder, keeping, disk = ranks.agreed(
        lambda: (
            checkpoints.wanted(wanted.resume, problem, wanted.checkpoint),
            checkpoints.Checkpoints.of(wanted.checkpoint, problem),
            Disk.of(wanted.rows_on_disk),
        )
    )
    ranks.alike(folder is None, "folders of checkpoints")
    try:
        lp = compiling.compiled(ranks, problem, deadline, disk)
    except TimeLimitReached as error:
        return maker.not_compiled(str(error), time.perf_counter() - started)
    maker.compile_seconds = time.perf_counter() - started
    return _answered(maker, lp, wanted, progress, folder, keeping)


def _answered(
    maker: AnswerMaker,
    lp: StabilizationLP,
    wanted: Wanted,
    progress: Progress | None,
    folder: Path | None,
    keeping: checkpoints.Checkpoints | None,
) -> Answer:
    """Answer a compiled problem; ``folder`` is that of a checkpoint to begin with."""
    ranks, deadline = maker.ranks, maker.deadline
    maker.of_model(lp)
    refused = maker.ranks.by_first(
        lambda: ruled_out(
            lp.problem, lp.partition, maker.extent, wanted.require_all, deadline.again()
        )
    )
    if refused is not None:
        return maker.refused(*refused)
    if progress:
        progress("solve", -1.0)
    started = time.perf_counter()
    kept = checkpoints.unfinished(folder, lp)
    found = solving.solved(lp, wanted.tolerance, deadline, wanted.gathered, kept, keeping)
    maker.verify_seconds = None if found is None else found.judged
    maker.solve_seconds = time.perf_counter() - started - (maker.verify_seconds or 0.0)
    late = ranks.any(deadline())
    if found is not None and found.certificate.verified:
        return maker.solved(found, late)
    if not late and whole.fits(lp, wanted.whole):
        return _by_first(maker, lp, wanted)
    if found is not None and found.certificate.refusal:
        return _infeasible(maker, lp, wanted, found, folder, keeping)
    return maker.solved(found, late)


def _infeasible(
    maker: AnswerMaker,
    lp: StabilizationLP,
    wanted: Wanted,
    found: solving.Solved,
    folder: Path | None,
    keeping: checkpoints.Checkpoints | None,
) -> Answer:
    """Return the refusal of gamma, or the answer on the other cells, as all ranks find it."""
    w = found.witness.refusal
    assert w is not None
    if wanted.restrict_to_gamma:
        smaller = restricted(lp, w > 0, maker.first_cell)
        if smaller is not None:
            inner = maker.for_model()
            return maker.restricted(_answered(inner, smaller, wanted, None, folder, keeping), w)
    limits = bracket.bracket(lp, w, wanted.gathered, maker.ranks.time_up(maker.deadline))
    return maker.infeasible(found, w, limits)


def _by_first(maker: AnswerMaker, lp: StabilizationLP, wanted: Wanted) -> Answer:
    """Let rank 0 answer alone: refusals with gamma_bar, what doubles hardly decide."""
    model = whole.model(lp)

    def found() -> Result | None:
        return None if model is None else alone.solve(
            model, tolerance=wanted.tolerance, time_limit=maker.deadline,
            require_all=wanted.require_all, restrict_to_gamma=wanted.restrict_to_gamma,
        )  # fmt: skip

    return maker.told(maker.ranks.agreed(found))

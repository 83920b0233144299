"""``lmdsl.distributed.solve``: a problem solved by all ranks that a launcher started."""

import hashlib
import os
from typing import Any

from lmdsl.common import inputs
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.distributed import saving
from lmdsl.distributed.answer import Answer
from lmdsl.distributed.answering import Wanted, answer
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.problem import Problem, given
from lmdsl.ranks.ending import together
from lmdsl.ranks.mpi import at_hand
from lmdsl.ranks.verbs import Ranks
from lmdsl.results.solving import TOLERANCE, _check_options, _no_enclosures


@own_arithmetic
def solve(
    problem: Problem | FilePath,
    *,
    out: str | os.PathLike[str] | None = None,
    tolerance: float = TOLERANCE,
    time_limit: float | None = None,
    require_all: bool = False,
    restrict_to_gamma: bool = False,
    rows_on_disk: FilePath | None = None,
    checkpoint: FilePath | None = None,
    resume: FilePath | None = None,
    progress: Progress | bool | None = None,
    ranks: Ranks | None = None,
) -> Answer:
    """Solve a problem over all ranks, and verify the answer: every rank calls it alike.

    Parameters
    ----------
    problem
        A problem, or the path of its file, the same on every rank.
    out
        The result directory that all ranks write, in a folder that all of them see.
    tolerance, time_limit, require_all, restrict_to_gamma
        As for :func:`lmdsl.solve`.
    rows_on_disk, checkpoint, resume
        As for :func:`lmdsl.solve`; the last two in a folder that all ranks see.
    progress
        Of rank 0: called with (stage, fraction done, or -1); True shows it on stderr.
    ranks
        Who works together: the ranks of the launcher, if not given.

    Returns
    -------
    Answer
        Its facts are the same on every rank; its arrays are those of a rank's own cells.

    Raises
    ------
    BadInput
        On every rank: the problem or an option cannot be used, or does not run over ranks.
    """
    everyone = at_hand() if ranks is None else ranks
    heard = told(progress) if everyone.rank == 0 else None

    def program(ranks: Ranks) -> Answer:
        declared = ranks.agreed(lambda: given(problem))
        wanted = ranks.agreed(
            lambda: asked(
                declared, tolerance, time_limit, require_all, restrict_to_gamma,
                rows_on_disk=rows_on_disk, checkpoint=checkpoint, resume=resume,
            )
        )  # fmt: skip
        if out is not None:
            saving.require_place(ranks, out)
        found = solved(ranks, declared, wanted, heard)
        if out is not None:
            saving.save(ranks, found, out)
        return found

    return together(everyone, program)


def solved(
    ranks: Ranks, problem: Problem, wanted: Wanted, progress: Progress | None = None
) -> Answer:
    """Answer a problem, which must be the same on every rank; collective."""
    said = problem.model_dump_json().encode()
    ranks.alike(hashlib.sha256(said).hexdigest()[:16], "problems (by their SHA-256)")
    return answer(ranks, problem, wanted, progress)


FOLDERS = ("rows_on_disk", "checkpoint", "resume")


def asked(
    problem: Problem, tolerance: Any, time_limit: Any, require_all: Any, restrict_to_gamma: Any,
    **folders: Any,
) -> Wanted:  # fmt: skip
    """Return what is asked for; BadInput where it cannot be. ``folders`` are FOLDERS."""
    _check_options(tolerance, None)
    whole = inputs.flag(require_all, "require_all")
    restricted = inputs.flag(restrict_to_gamma, "restrict_to_gamma")
    if restricted:
        _no_enclosures(problem)
    return Wanted(tolerance, Deadline.of(time_limit), whole, restricted, **folders)

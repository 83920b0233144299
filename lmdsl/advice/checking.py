"""``check``: what looks wrong with a problem, in plain words, before the long run."""

from collections.abc import Iterator

from lmdsl.advice import declaration, jumps, motion, recorded, sizes, targets
from lmdsl.advice.report import CheckReport, Finding
from lmdsl.advice.survey import MOST_SETS, Survey
from lmdsl.common.types import FilePath, Progress, told
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.assembly.substeps import settled
from lmdsl.model.grid.partition import Partition
from lmdsl.problem import Problem, given
from lmdsl.systems import MatrixSystem


@own_arithmetic
def check(
    problem: Problem | FilePath,
    *,
    time_limit: float | Deadline | None = None,
    progress: Progress | bool | None = None,
) -> CheckReport:
    """Say what looks wrong with a problem before the long run.

    A survey of some cells is tried with the true map, and the problem compiled where that is cheap,
    else on fewer cells: a matter of seconds, whatever the size.

    Parameters
    ----------
    problem
        A problem, or the path of its file.
    time_limit
        Seconds.
    progress
        Called with (stage, -1); True shows it on stderr.

    Raises
    ------
    BadInput
        The problem cannot be compiled.
    TimeLimitReached
        The time limit was reached.
    """
    progress = told(progress)
    problem = given(problem)
    deadline = Deadline.of(time_limit)
    if progress:
        progress("check", -1.0)
    own = {name: axis.cells for name, axis in problem.state_box.items()}
    findings: list[Finding] = []
    notes: list[Finding] = []
    if isinstance(problem.system, MatrixSystem):
        level, found = sizes.of_matrices(problem, deadline)
        known = [level]
        findings += recorded.few(problem)
    else:
        partition = Partition.of(problem)
        if partition.size <= MOST_SETS:
            problem = settled(problem, deadline)
        survey = Survey(problem, partition, deadline)
        known = sizes.levels(problem, deadline)
        found = sizes.expected(survey, known)
        share = found.coverage if found.coverage_cells == own else None
        findings += _of_the_map(survey, share, deadline)
        findings += sizes.shrinking(problem, known, deadline)
        notes += [*targets.shrunk(problem, partition), *declaration.axis_order(survey)]
    findings += [*targets.little(problem, known, deadline), *sizes.too_large(found)]
    return CheckReport(tuple(findings), found, own, tuple(notes))


def _of_the_map(survey: Survey, share: float | None, deadline: Deadline) -> Iterator[Finding]:
    """Yield what is found about a map; the share that can be stabilized is None if unknown."""
    yield from declaration.unused(survey.problem)
    yield from declaration.idle(survey.problem)
    yield from targets.chance(survey)
    yield from declaration.angles(survey, share, deadline)
    yield from declaration.degrees(survey)
    yield from motion.few_substeps(survey, deadline)
    yield from motion.on_edges(survey)
    yield from motion.short_step(survey, share, deadline)
    yield from jumps.long_step(survey, share, deadline)

"""What compiling a problem takes and gives: of itself where that is cheap, else on fewer cells."""

import json
import math
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lmdsl.advice.report import Expectation, Finding, shape
from lmdsl.advice.survey import MOST_SETS, Survey
from lmdsl.errors import BadInput
from lmdsl.explanation import remedies
from lmdsl.explanation.remedies import StabilizableShare
from lmdsl.explanation.trials import some
from lmdsl.machine import memory, threads
from lmdsl.machine.deadline import Deadline
from lmdsl.model import discretization, stabilizable_set
from lmdsl.model.assembly import estimates
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.assembly.transitions import Assembler, assemble, shares_of
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.grid.boxes import Ends
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.local_control import without_orbit
from lmdsl.problem.problem import Problem

# Additions above which compiling is no survey: on the problem's own cells, and on others.
OWN_WORK, WORK = 6e9, 1e9
TELLING = 50  # number of free cells below which coarser cells say nothing about a problem's own
TRIED = 30  # number of cells below which those tried say nothing about the others
FUNCTION = 1e5  # additions for which a sample of a map counts of which nobody knows
# Number of samples that are compiled to tell the time: of formulas, and of a user's own function.
MOST_SAMPLES, FEW_SAMPLES = 2**20, 2**12
GROWTH = (0, 1, 2, 4, 8)  # number of cells by which a box is tried to be larger than the attractor
LEAST = 100  # number of free cells below which a share says little
FALLEN = 0.9  # the part of a share below which it has fallen


class Level(NamedTuple):
    """A problem on some number of cells, compiled."""

    problem: Problem
    cells: dict[str, int]
    found: StabilizableShare
    seconds: float
    widened: bool = False  # the attractor was, to whole cells


def work(problem: Problem) -> float:
    """Return the additions that compiling takes, about; of a function a guess."""
    known = estimates.work(problem)
    if known < np.inf:
        return known
    N = float(np.prod([float(axis.cells) for axis in problem.state_box.values()]))
    samples = discretization.sample_points(problem) * discretization.node_count(problem)
    return N * discretization.control_count(problem) * samples * FUNCTION


def levels(problem: Problem, deadline: Deadline) -> list[Level]:
    """Compile a problem on the most cells, by halves or doubles of its own, that are cheap.

    Returns
    -------
    levels
        On half as many cells an axis first, then on those; empty where neither can be. The numbers
        of cells are at most twice the problem's own.
    """
    bare = problem.replaced(measure=None, **without_orbit(problem.local_controller))
    found: list[Level] = []
    for power in (1, 0, -1, -2, -3, -4, -5, -6):
        cells = {
            name: max(round(axis.cells * 2.0**power), 1) for name, axis in bare.state_box.items()
        }
        own = power == 0
        other = bare if own else without_indices(bare)
        if other is None or max(cells.values()) > 2**30:
            continue
        scaled = bare if own else remedies.with_cells(other, cells)
        if work(scaled) > (OWN_WORK if own else WORK):
            continue
        if not memory.fits(estimates.estimate(scaled)):
            continue
        try:
            found.insert(0, _compiled(scaled, cells, deadline))
        except BadInput:
            if own:  # a fault of the problem itself: its cost, say
                raise
            wider = _widened(scaled) if power < 0 else None
            if wider is None:
                continue
            try:  # a box of the attractor that holds no cell of this size
                found.insert(0, _compiled(wider, cells, deadline)._replace(widened=True))
            except BadInput:
                break
        if len(found) == 3 or (len(found) == 2 and power < 0):
            break
    return found


def _compiled(problem: Problem, cells: dict[str, int], deadline: Deadline) -> Level:
    start = time.perf_counter()
    covered = remedies.coverage(problem, deadline)
    return Level(problem, cells, covered, time.perf_counter() - start)


def without_indices(problem: Problem) -> Problem | None:
    """Return a problem whose attractor is not of indices of cells; None where it is too large."""
    if not problem.attractor.cells:
        return problem
    if math.prod(axis.cells for axis in problem.state_box.values()) > MOST_SETS:
        return None
    return problem.replaced(attractor={"boxes": remedies.attractor_boxes(problem)})


def _widened(problem: Problem) -> Problem | None:
    """Return a problem with the boxes of its attractor widened to whole cells; None without any."""
    boxes = []
    for box in problem.attractor.boxes:
        wide = {}
        for name, (a, b) in box.items():
            axis = problem.state_box[name]
            width = (axis.high - axis.low) / axis.cells
            first = min(max(math.floor((a - axis.low) / width + EDGE), 0), axis.cells - 1)
            last = min(max(math.ceil((b - axis.low) / width - EDGE), first + 1), axis.cells)
            wide[name] = (axis.low + first * width, axis.low + last * width)
        boxes.append(wide)
    return problem.replaced(attractor={"boxes": boxes}) if boxes else None


def expected(survey: Survey, known: list[Level]) -> Expectation:
    """Return what compiling takes and gives."""
    problem, p = survey.problem, survey.partition
    own = {name: axis.cells for name, axis in problem.state_box.items()}
    few, most = estimates.ALL_ADMISSIBLE, None
    each = None if survey.sets is None else 0.0
    if survey.sets is not None and len(survey.sets.free):
        sampler = Sampler(problem, p, sets=survey.sets)
        few, each, most = _few(sampler, survey, survey.sets)
    level, coarser = _telling(known, own)
    return Expectation(
        cells=p.size,
        controls=discretization.control_count(problem),
        samples=discretization.sample_points(problem) * discretization.node_count(problem),
        admissible=None if each is None else few.admissible,
        coverage=level.found.share if level and level.found.free else None,
        coverage_cells=None if level is None else level.cells,
        memory=estimates.estimate(problem, few),
        available=memory.available().bytes,
        seconds=None if each is None else each * p.size * discretization.control_count(problem),
        coverage_coarser=None if coarser is None else coarser.found.share,
        attractor_widened=level is not None and level.widened,
        coverage_at_most=most if level is None else None,
    )


def of_matrices(problem: Problem, deadline: Deadline) -> tuple[Level, Expectation]:
    """Compile a finite model: there is no map to try."""
    cells = {name: axis.cells for name, axis in problem.state_box.items()}
    start = time.perf_counter()
    transitions = assemble(problem, Partition.of(problem), deadline=deadline)
    found = stabilizable_set.of_problem(problem, transitions, deadline)
    covered = remedies.counted(transitions, found)
    level = Level(problem, cells, covered, time.perf_counter() - start)
    pairs = len(found.inside) * discretization.control_count(problem)
    return level, Expectation(
        cells=math.prod(cells.values()),
        controls=discretization.control_count(problem),
        samples=1,
        admissible=int(transitions.pair_pointer[-1]) / max(pairs, 1),
        coverage=covered.share if covered.free else None,
        coverage_cells=cells,
        memory=estimates.estimate(problem),
        available=memory.available().bytes,
        seconds=level.seconds,
    )


def _few(
    sampler: Sampler, survey: Survey, sets: CellSets
) -> tuple[estimates.Pilot, float, float | None]:
    """Compile a few cells, and refuse a cost that compiling all would.

    Returns
    -------
    few, seconds, most
        What the pairs are like, seconds a pair takes, and which share of the cells has a pair that
        is admissible; None if too few were tried, or with some of the controls only.
    """
    shares = shares_of(survey.problem, len(sampler.points), sampler.nodes)
    assembler, blocks = Assembler(sampler, sets, shares), _blocks(sampler, survey)
    assembler(blocks[0])  # kernels are compiled
    start = time.perf_counter()
    rows = [assembler(block)[1] for block in blocks]
    seconds = time.perf_counter() - start
    tried = sum(block.lanes for block in blocks)
    kept, entries = (sum(len(part) for part in parts) for parts in
                     ([row.control for row in rows], [row.target for row in rows]))  # fmt: skip
    few = estimates.Pilot(kept / tried, entries / kept if kept else 1.0)
    open_cells = np.concatenate([row.per_cell > 0 for row in rows])
    whole = all(block.width == len(sampler.controls) for block in blocks)
    most = float(open_cells.mean()) if whole and len(open_cells) >= TRIED else None
    return few, seconds / tried / threads.count(), most


def _blocks(sampler: Sampler, survey: Survey) -> list[Block]:
    """Return blocks of some of the cells with some or all controls."""
    most = MOST_SAMPLES if survey.quick else FEW_SAMPLES
    M, S = len(sampler.controls), sampler.samples
    width = min(M, max(1, most // S))
    cells = some(survey.cells, max(1, most // (width * S)))
    size = max(1, sampler.chunk // (width * S))
    firsts = np.linspace(0, M - width, -(-len(cells) // size)).astype(int).tolist()
    return [
        Block(0, cells[i * size : (i + 1) * size], (first, first + width))
        for i, first in enumerate(firsts)
    ]


def _telling(known: list[Level], own: dict[str, int]) -> tuple[Level | None, Level | None]:
    """Return the problem's own level; else the finest, an estimate, and the next coarser one."""
    for level in known:
        if level.cells == own:
            return level, None
    telling = [level for level in known if level.found.free >= TELLING]
    coarser, finest = [None, None, *telling][-2:]
    return finest, coarser


def too_large(found: Expectation) -> Iterator[Finding]:
    """Find that a problem does not fit in memory."""
    if found.memory > found.available:
        part = found.available / found.memory
        yield Finding(
            "memory",
            "state_box",
            f"compiling and solving take about {memory.human(found.memory)}, and "
            f"{memory.human(found.available)} are left",
            f"take {100 * part:.2g} % of the cells, controls or sample points, or more memory",
            {"memory": found.memory, "available": found.available},
        )


def shrinking(problem: Problem, known: list[Level], deadline: Deadline) -> Iterator[Finding]:
    """Find that an attractor of points loses cells as it shrinks, and a box that does not."""
    if not problem.attractor.points or len(known) < 2:
        return
    last, finest = known[-2:]
    if min(last.found.free, finest.found.free) < LEAST:
        return
    if not finest.found.share < FALLEN * last.found.share:
        return
    shares = {shape(one.cells): one.found.share for one in known}
    told = ", ".join(f"{100 * share:.3g} % on {cells}" for cells, share in shares.items())
    text = (
        f"the attractor is the cells around points, which shrinks with them, and less can be "
        f"stabilized the more cells there are: {told}"
    )
    figures: dict[str, Any] = {"shares": shares}
    fixed = _box(max(known, key=lambda one: one.found.share).problem, last.problem, deadline)
    boxed = finest.problem.replaced(attractor={"boxes": fixed})
    share = remedies.coverage(boxed, deadline).share
    remedy = f'write "boxes": {json.dumps(fixed)} in attractor instead of points'
    if share > finest.found.share:
        figures |= {"boxes": fixed, "share_with_boxes": share}
        remedy += f": then {100 * share:.3g} % on {shape(finest.cells)}"
    yield Finding("shrinking_attractor", "attractor.points", text, remedy, figures)


def _box(source: Problem, on: Problem, deadline: Deadline) -> list[Ends]:
    """Return the attractor of a problem as boxes, grown while much more can be stabilized so."""
    found = []
    for grow in GROWTH:
        fixed = remedies.attractor_boxes(source, grow)
        try:
            boxed = on.replaced(attractor={"boxes": fixed})
            found.append((fixed, remedies.coverage(boxed, deadline).share))
        except BadInput:  # it meets avoid
            break
    best = max(share for _, share in found)
    return next(fixed for fixed, share in found if share >= best - remedies.ABOUT)

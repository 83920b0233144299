"""What compiling and solving take, said before: bytes, and whether it is a moment's work."""

import logging
import math
import time
from typing import NamedTuple

from lmdsl.common.on_disk import WHERE, Disk
from lmdsl.errors import BadInput
from lmdsl.machine import memory, threads
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.progress import spoken
from lmdsl.model import discretization
from lmdsl.model.assembly.entries import doubles
from lmdsl.model.assembly.paths.judging import KEPT
from lmdsl.model.assembly.sampler import CHUNK, chunk
from lmdsl.model.sets import always_whole
from lmdsl.problem.problem import Problem

log = logging.getLogger(__name__)


def require_least(problem: Problem, disk: Disk | None = None) -> None:
    """Refuse a problem whose grids and cells do not fit, before anything of it is made."""
    require_room(problem, "at least, before sampling", disk)


def require_room(
    problem: Problem,
    how: str,
    disk: Disk | None = None,
    pilot: "Pilot | None" = None,
    share: float = 1.0,
) -> int:
    """Return the bytes of memory that a share of a problem takes; refuse what does not fit.

    Where its rows on disk would make it fit, the refusal says so, and how much they take there.
    """
    pilot = pilot or ALL_ADMISSIBLE
    need, rows = estimate(problem, pilot, disk is not None, share), of_rows(problem, pilot, share)
    how = named(problem, how) + ", on one of several ranks" * (share < 1)
    if disk is not None:
        disk.require(rows)
        memory.require(need, f"{how}, rows on disk")
    else:
        memory.require(need, how, lambda: _remedy(estimate(problem, pilot, True, share), rows))
    return need


def _remedy(need: int, rows: int) -> str:
    """Return what rows on disk would change, where that is enough."""
    if not memory.fits(need):
        return ""
    return (
        "or keep rows on disk (--rows-on-disk DIR, in Python rows_on_disk=DIR), which "
        f"takes {memory.human(need)} of memory and {memory.human(rows)} there"
    )


def refuse_given(disk: object) -> None:
    """Refuse a disk for rows that are given, in memory."""
    if disk is not None:
        raise BadInput(
            "the rows of this problem are given, in memory, and not computed; leave it out", WHERE
        )


def named(problem: Problem, how: str) -> str:
    """Return how an estimate was made, and what is large in it beside rows."""
    parts = discretization.node_count(problem)
    if problem.successors != "enclosed" or parts == 1:
        return how
    return f"{how}; a pair has a range of cells for each of {parts} noise nodes"


class Pilot(NamedTuple):
    """What a few cells say of all: the share of admissible pairs and the mean length of rows."""

    admissible: float = 1.0
    entries: float = 1.0


ALL_ADMISSIBLE = Pilot()


def estimate(
    problem: Problem,
    pilot: Pilot = ALL_ADMISSIBLE,
    on_disk: bool = False,
    share: float = 1.0,
) -> int:
    """Return an upper bound of the bytes of memory that compiling and solving a problem takes.

    With rows ``on_disk``; of a process that has a ``share`` of the cells.

    Solving is counted for the default backend, as it goes as a rule. What takes more (cells that
    are lost, ties, other backends, a first policy that is hard to find) asks when it comes to it.
    """
    every, M, S = _counts(problem)
    N = every * share
    pairs = M * pilot.admissible
    entries = pilot.entries + (problem.discount is not None)
    # Of a pair the row, its end, control and cost; of a cell the sets, levels and weights.
    row = 0.0 if on_disk else 20 + entries * _entry(S)
    others = every - N if always_whole(problem) else min(every - N, N)
    model = N * (64 + pairs * (1 + row)) + others * SETS
    if problem.successors == "enclosed":
        parts = min(discretization.node_count(problem), 10**40)
        model += N * pairs * (8 + 4 * parts * len(problem.state_box))
    copied = pairs * (8 + row) if pilot.admissible < 1 else 0  # cells may be lost
    # Of a pair whether it ties, and a unit cost; of a cell vectors, and the rows of a policy in
    # doubles.
    solving = pairs * (1 if on_disk else 9) + 130 + 24 * entries
    peak = MARGIN * (model + max(N * copied + _blocks(problem, S), N * solving))
    return int(min(peak + _grids(problem, M, S) + OVERHEAD, 1e30))


def of_rows(problem: Problem, pilot: Pilot = ALL_ADMISSIBLE, share: float = 1.0) -> int:
    """Return an upper bound of the bytes that rows of a share of the cells take on disk."""
    N, M, S = _counts(problem)
    entries = pilot.entries + (problem.discount is not None)
    each = 20 + entries * _entry(S)
    if pilot.admissible < 1:  # cells may be lost: a copy, and who reaches each cell
        each += max(each + 8, 8 * entries)
    return int(min(MARGIN * share * N * M * pilot.admissible * each, 1e30))


def _counts(problem: Problem) -> tuple[int, int, int]:
    """Return the numbers of cells, controls and samples.

    Capped: a product of declared counts may exceed the range of doubles.
    """
    N = math.prod(axis.cells for axis in problem.state_box.values())
    S = discretization.sample_points(problem) * discretization.node_count(problem)
    return min(N, 10**40), min(discretization.control_count(problem), 10**40), min(S, 10**40)


def _entry(S: int) -> int:
    """Return the bytes of a target and its code."""
    return 4 + (1 if S <= 2**8 else 2 if S <= 2**16 else 4)


MARGIN = 1.1  # a few cells do not say exactly what all are like, and allocators keep something back


SETS = 24  # bytes of a cell of others that is known: whether it is free, its number and mass


OVERHEAD = 2**25  # bytes of code, kernels and tables


CODE = 250  # bytes of a code of samples with noise: its exact numerator, of up to a thousand bits


def _blocks(problem: Problem, S: int) -> int:
    """Return the bytes of the blocks that are sampled at a time."""
    step, cost = problem.step(), problem.stage()
    d, samples, count = len(problem.state_box), max(chunk(problem), S), threads.count()
    # States, images and their cells, paths, the arrays of a formula, keys and rows.
    live = max(each.live for each in (step, cost, problem.admitted()) if each is not None)
    each = 8 * samples * (3 * d + live + 8)
    if doubles(problem):
        each += 8 * max(KEPT, doubles(problem))
    waiting = 8 * (count - 1) * 16 * samples  # finished blocks, for their turn
    return count * each + waiting


def _grids(problem: Problem, M: int, S: int) -> int:
    """Return the bytes of sample points, controls, noise nodes and codes."""
    points, nodes = discretization.sample_points(problem), discretization.node_count(problem)
    codes = S * (CODE if nodes > 1 else 16)
    controls = M * 8 * (1 + 4 * len(problem.control_grid))
    return controls + points * 40 * len(problem.state_box) + nodes * discretization.NODE + codes


# Number of additions above which compiling takes more than a moment, and heeds the deadline.
SHORT = 2e9


SAMPLE = 40  # additions that take as long as locating and sorting a sample


CALL = 2_000  # additions that take as long as NumPy's own work for an operation on an array


ENCLOSED = 50  # operations on doubles that take as long as one on enclosures, some bisected
SET = 20_000  # additions that take as long as resolving a point or a box of a set, its cells apart


LONG = 20.0  # seconds from which it is said beforehand how long compiling and solving take
TOLD_AFTER = 1.0  # seconds of sampling after which that is known well enough
SOLVING = 1e-7  # seconds that solving and verifying take for a transition, about


class Outlook:
    """What compiling and solving take, said once, in the first seconds of long work.

    Parameters
    ----------
    what
        What is done, in words.
    need
        Bytes that it takes, None where that was said already.
    entries
        Number of transitions that are solved, about.
    """

    def __init__(self, what: str, need: float | None = None, entries: float = 0.0) -> None:
        self.what, self.need, self.entries = what, need, entries
        self.begun: tuple[float, float] | None = None
        self.told = False

    def done(self, fraction: float) -> None:
        """Note which part is done of what has to be done first."""
        now = time.perf_counter()
        if self.begun is None:  # kernels were compiled on the way here
            self.begun = now, fraction
            return
        began, first = self.begun
        if self.told or now - began < TOLD_AFTER or fraction <= first:
            return
        self.told = True
        seconds = (now - began) * (1 - first) / (fraction - first) + SOLVING * self.entries
        if seconds > LONG:
            room = "" if self.need is None else f", {memory.human(self.need)}"
            log.info("%s about %s%s", self.what, spoken(seconds), room)


def work(problem: Problem) -> float:
    """Return the additions that take as long as compiling a problem; infinite for functions."""
    N = math.prod(axis.cells for axis in problem.state_box.values())
    lanes = N * discretization.control_count(problem)
    samples = discretization.sample_points(problem) * discretization.node_count(problem)
    step, cost = problem.step(), problem.stage()
    if cost is None:  # a rate, of the same names
        cost = problem.program(problem.cost())
    calls = 2 + 2 * lanes * min(samples, CHUNK) // CHUNK
    locating = SAMPLE * (1 + doubles(problem) // 8)
    work = lanes * samples * (locating + step.work + cost.work)
    condition = problem.admitted()
    if condition is not None:
        work += lanes * samples * condition.work
    work += CALL * calls * (step.effort + cost.effort)
    attractor, avoid, weight = problem.attractor, problem.avoid, problem.measure
    boxes = [attractor.boxes, (avoid and avoid.boxes) or (), (weight and weight.boxes) or ()]
    count = sum(map(len, boxes))
    work += N * count + SET * (count + len(attractor.points) + len(attractor.cells))
    for where in ("attractor", "avoid", "measure"):
        for each in problem.conditions(where):
            work += ENCLOSED * N * problem.program(each).work
    if problem.successors == "enclosed":
        work += ENCLOSED * lanes * discretization.node_count(problem) * step.work
    density = problem.density()
    if density is not None:
        work += N * density.work
    if problem.local_controller is not None:  # linearised: some fifty operations for each
        work += 50 * CALL * step.effort
    return work


def unless_short(problem: Problem, deadline: Deadline) -> Deadline:
    """Return a deadline, or one that never passes where compiling takes a moment at most."""
    return Deadline() if work(problem) <= SHORT else deadline

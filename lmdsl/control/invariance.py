"""Whether the local controller keeps the attractor cells: by samples, and by enclosure.

To prove T(x, C0(x), w) in A for every x of a cell, its domain (every state that is located in it)
is cut into boxes until the enclosed image of each meets attractor cells only. This is
proved of the map as computed, with its rounding, and so of what a simulation can do.
"""

from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, product
from typing import Any

import numpy as np

from lmdsl.common.records import Reported
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.formulas.enclosures import Jet, apply, enclosure
from lmdsl.formulas.intervals import Interval, subtract
from lmdsl.formulas.program import FUNCTION
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.discretization import noise_nodes, noise_parts
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController
from lmdsl.model.local.holding import HoldingLaw
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem

SAMPLES, FEWEST = 10_000, 10  # largest and least number of samples
SAMPLED_WORK = 1e10  # number of additions above which fewer samples are taken: some seconds
CHUNK = 8192  # cells enclosed at a time
WORK = 2e7  # number of operations on boxes above which no cell is enclosed any more: seconds
OVERHEAD = 1000  # boxes whose arithmetic costs as much as NumPy's own work for an operation
ROUNDS = 14  # number of halvings of an axis above which a box is given up
CORNERS = 32  # most states of a cell, and values of noise, that are tried beforehand
MEETS = 512  # number of cells that an image meets above which nothing is claimed of it
DOING = "checking the local controller"


@dataclass(frozen=True)
class LocalCheck(Reported):
    """Whether the local controller keeps the attractor cells: T(x, C0(x), w) in A for x in A.

    Attributes
    ----------
    kind
        ``constant``, ``linear``, ``lqr`` or ``hold``.
    multiplier
        Largest modulus of the multipliers of the linearised orbit; below 1 it attracts.
    cells
        Number of attractor cells.
    proved
        Of these, cells whose every point is mapped into A by all noise that enclosures cover (the
        nodes; all of a uniform variable; ``within`` of a normal one): by interval arithmetic. None
        for a system written in Python, which cannot be enclosed.
    samples, kept
        Random states of A, and how many of them are mapped into A by every noise node. Fewer where
        there are many nodes or operations, or no more time.
    holding
        Of ``hold``, the attractor cells that hold; what is proved and sampled is of these, and
        that they are mapped into these. Else None.
    """

    kind: str
    multiplier: float | None
    cells: int
    proved: int | None
    samples: int
    kept: int
    holding: int | None = None

    def sentence(self) -> str:
        """Return one line for people."""
        line = f"{self.kind}: "
        if self.holding == 0:
            return line + "no attractor cell holds"
        if self.holding is not None:
            line += f"{self.holding} of {self.cells} attractor cells hold; "
        if self.proved is not None:
            known = f"{self.proved} of {self.cells} attractor cells are"
            line += known if self.proved else "no attractor cell is"
            line += " proved to be kept (by the map as computed); "
        line += f"{self.kept} of {self.samples} random states of A were kept"
        if self.multiplier is not None:
            line += f"; orbit's multiplier {self.multiplier:.4g}"
        return line

    __str__ = sentence


def examine(
    problem: Problem,
    local: LocalController | HoldingLaw,
    deadline: Deadline | None = None,
    samples: int | None = None,
    proved: int | None = None,
) -> LocalCheck:
    """Check whether the local controller of a problem keeps the attractor cells.

    The deadline ends the work with what is known; ``samples`` are as many random states as take
    some seconds where their number is not given; ``proved`` is known for some.
    """
    cells, loop = np.flatnonzero(local.attractor), _Loop(problem, local, Deadline.of(deadline))
    if samples is None:
        work = FUNCTION if loop.true_map.map.enclose is None else loop.true_map.map.work
        samples = int(min(SAMPLES, max(SAMPLED_WORK // (work * len(loop.nodes)), FEWEST)))
    proved = _proved(loop, cells) if proved is None else proved
    samples, kept = _sampled(loop, cells, samples)
    kind = "constant" if problem.local_controller is None else problem.local_controller.kind
    return LocalCheck(kind, local.multiplier, len(cells), proved, samples, kept)


class _Loop:
    """The true map under the local controller, all noise nodes, and what ends the work in time."""

    def __init__(
        self, problem: Problem, local: LocalController | HoldingLaw, deadline: Deadline
    ) -> None:
        self.local, self.partition = local, local.partition
        self.true_map, self.nodes = TrueMap(problem, local.partition), noise_nodes(problem).values
        self.parts = noise_parts(problem)
        self.guard = partial(deadline.raise_if_over, DOING)

    @property
    def per_box(self) -> float:
        """Operations that a box takes."""
        parts, d = len(self.parts[0]), self.partition.dimension
        return float(self.true_map.map.effort) * parts * (1 + d)


def _sampled(loop: _Loop, cells: Indices, count: int) -> tuple[int, int]:
    """Return how many states were tried in time, and how many of them stay."""
    rng = np.random.default_rng(0)
    cell = cells[rng.integers(len(cells), size=count)]
    partition = loop.partition
    index = np.stack(partition.multi_index(cell), axis=-1)
    x = partition.low + (index + rng.random(index.shape)) * partition.width
    kept, part = 0, max(FEWEST, CHUNK // len(loop.nodes))
    for start in range(0, count, part):
        some = slice(start, min(start + part, count))
        try:
            kept += int(_stays(loop, x[some], cell[some]).sum())
        except TimeLimitReached:
            return start, kept
    return count, kept


def _stays(loop: _Loop, x: Floats, cell: Indices) -> Bools:
    """Return which states of attractor cells are mapped into A by every noise node."""
    u = loop.local(x, cell)
    states, controls = list(x.T[:, :, None]), list(u.T[:, :, None])
    stays = np.ones(len(x), dtype=np.bool_)
    width = max(1, CHUNK // max(len(x), 1))
    for start in range(0, len(loop.nodes), width):
        some = loop.nodes[start : start + width]
        shape, noise = (len(x), len(some)), list(some.T[:, None, :])
        images = loop.true_map(states, controls, noise, loop.guard)
        target = loop.partition.locate([np.broadcast_to(y, shape) for y in images])
        stays &= ((target >= 0) & loop.local.attractor[target]).all(axis=1)
    return stays


def _proved(loop: _Loop, cells: Indices) -> int | None:
    """Count the cells that are mapped into A as a whole; None where no formula allows it.

    Cells that are still undecided when the work is used up count as not proved.
    """
    if loop.true_map.map.enclose is None:
        return None
    proved, work, per_box = 0, WORK, loop.per_box
    for start in range(0, len(cells), CHUNK):
        some = cells[start : start + CHUNK]
        try:
            kept, spent = _kept(loop, some, work / per_box)
        except TimeLimitReached:
            break
        proved += int(kept.sum())
        work -= spent * per_box
        if work <= 0:
            break
    return proved


def keeping(problem: Problem, local: LocalController | HoldingLaw) -> Bools:
    """Return attractor cells that a law is proved to keep for ever, shape (N,).

    That is the greatest set in which all that a whole cell is mapped to lies, as far as some work
    shows; found from above: of a set, the cells that are not mapped into it are left out, first
    those of which that can be seen at a few states.
    """
    inside, work = _seen_to_stay(_Loop(problem, local, Deadline())), WORK
    while inside.any() and work > 0:
        loop, kept = _Loop(problem, replace(local, attractor=inside), Deadline()), inside.copy()
        cells = np.flatnonzero(inside)
        for start in range(0, len(cells), CHUNK):
            some = cells[start : start + CHUNK]
            found, spent = _kept(loop, some, max(work, 0.0) / loop.per_box)
            kept[some], work = found, work - spent * loop.per_box
        if kept.sum() == inside.sum():
            return inside
        inside = kept
    return np.zeros_like(inside)


def _seen_to_stay(loop: _Loop) -> Bools:
    """Return the greatest set of attractor cells of which no state tried is led out, shape (N,)."""
    partition, cells = loop.partition, np.flatnonzero(loop.local.attractor)
    index = np.stack(partition.multi_index(cells), axis=-1)
    noise, led = np.unique(np.concatenate(loop.parts), axis=0)[:CORNERS], []
    for corner in islice(product((0.5, 0.0, 1.0 - 1e-6), repeat=partition.dimension), CORNERS):
        x = partition.low + (index + np.array(corner)) * partition.width
        u = loop.local(x, cells)
        for w in noise:
            images = loop.true_map(list(x.T), list(u.T), list(w), loop.guard)
            led.append(partition.locate([np.broadcast_to(y, len(cells)) for y in images]))
    inside: Bools = loop.local.attractor.copy()
    while True:
        stays = np.all([(to >= 0) & inside[to] for to in led], axis=0) & inside[cells]
        if stays.sum() == inside.sum():
            return inside
        inside = np.zeros_like(inside)
        inside[cells[stays]] = True


def _kept(loop: _Loop, cells: Indices, limit: float) -> tuple[Bools, float]:
    """Return which of some cells are proved, and the work in boxes.

    A box whose image is not enclosed in A is halved along its longest side (in cell widths),
    unless its centre is mapped outside: then its cell is lost.
    """
    partition = loop.partition
    (low, high, owner), work = partition.domain(cells), 0.0
    lost = np.zeros(len(cells), dtype=np.bool_)
    for _ in range(ROUNDS * partition.dimension):
        work += len(owner) + OVERHEAD
        if not len(owner) or work > limit:
            break
        inside = np.ones(len(owner), dtype=np.bool_)
        with np.errstate(all="ignore"):
            for least, most in zip(*loop.parts, strict=True):
                loop.guard()
                images = _images(loop, cells[owner], low, high, Interval(least, most))
                inside &= _into(partition, loop.local.attractor, images)
        centre = low / 2 + high / 2
        lost[owner[~_stays(loop, centre, cells[owner])]] = True
        open_ = ~inside & ~lost[owner]
        low, high, owner = low[open_], high[open_], owner[open_]
        axis = np.argmax((high - low) / partition.width, axis=1)
        rows = np.arange(len(owner))
        upper, lower = low.copy(), high.copy()
        upper[rows, axis] = lower[rows, axis] = (low[rows, axis] + high[rows, axis]) / 2
        low, high = np.concatenate([low, upper]), np.concatenate([lower, high])
        owner = np.concatenate([owner, owner])
    lost[owner] = True
    return ~lost, work


def _images(
    loop: _Loop, cell: Indices, low: Floats, high: Floats, noise: Interval
) -> list[Interval]:
    """Enclose T(x, C0(x), w) on boxes."""
    centre = Interval.point(low / 2 + high / 2)
    away = subtract(Interval(low, high), centre)
    steps = [Interval(*(end[:, k] for end in away)) for k in range(loop.partition.dimension)]
    images = _closed(loop, cell, Interval(low, high), noise)
    middle = _closed(loop, cell, centre, noise)
    return [enclosure(image, at, steps) for image, at in zip(images, middle, strict=True)]


def _closed(loop: _Loop, cell: Indices, box: Interval, noise: Interval) -> tuple[Jet, ...]:
    """Return jets of the closed loop, derivatives with respect to the states."""
    d = loop.partition.dimension
    x = [Jet.variable(Interval(box.low[:, i], box.high[:, i]), i, d) for i in range(d)]

    def jets(values: Any) -> list[Jet]:
        return [y if isinstance(y, Jet) else Jet.constant(y, d) for y in values]

    def on_jets(operation: str, *operands: Any) -> Any:
        return apply(operation, jets(operands))

    ends = zip(noise.low[:, None], noise.high[:, None], strict=True)
    u, w = jets(loop.local.law(x, cell, on_jets)), [Jet.held(Interval(*end), d) for end in ends]
    images = loop.true_map.enclose(x, u, w, loop.guard)
    assert images is not None
    return images


def _into(partition: Partition, attractor: Bools, images: list[Interval]) -> Bools:
    """Return which image boxes lie in the attractor: every cell that they may meet is one.

    These are the cells between those of the ends, since locating is monotone (axis.py).
    """
    count = np.broadcast_shapes(*(np.shape(end) for image in images for end in image))[0]
    sure = np.ones(count, dtype=np.bool_)
    first = np.zeros((len(images), count), dtype=np.int64)
    size = np.ones((len(images), count), dtype=np.int64)
    for k, (image, axis) in enumerate(zip(images, partition.axes, strict=True)):
        ends = [axis.number(np.broadcast_to(end, count), partition.clip) for end in image]
        meets = ends[1] - ends[0] + 1
        sure &= meets <= MEETS  # NaN where an end is out
        first[k], size[k] = np.where(sure, ends[0], 0), np.where(sure, meets, 1)
    cells = np.prod(size.astype(np.float64), axis=0)
    sure &= cells <= MEETS
    for number in range(int(cells[sure].max(initial=0))):
        rest, cell = np.full(count, number), np.zeros(count, dtype=np.int64)
        for k in range(len(images)):  # the number-th cell of each image; beyond its last, repeats
            rest, step = np.divmod(rest, size[k])
            cell = cell * int(partition.cells[k]) + (first[k] + step) % int(partition.cells[k])
        sure &= attractor[cell]
    return sure

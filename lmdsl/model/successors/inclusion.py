"""Whether all that the pairs of a policy can meet lies in C u A, checked anew.

Nothing of what compiling found is used, nor the compiled loops that found it: arrays of intervals
judge them, which is fast enough for one control a cell. The cell of a pair is one box, cut in two
where its enclosure does not decide, first along the axes along which compiling cuts: what that
could show is shown here as well. A cell is given up where the image of the middle of a box is not
allowed.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.formulas.intervals import Interval
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.windows import Window, joined
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import counting
from lmdsl.model.successors.enclosing import StepBoxes, Stretch
from lmdsl.model.successors.following import Following, PathTables, WindowSets, WindowTables
from lmdsl.model.successors.ranges import taken
from lmdsl.model.successors.slabs import Slabs, met
from lmdsl.problem.problem import Problem

BOXES = 2**14  # number of boxes times parts of the noise that are enclosed at a time
CUTS = 2  # number of times that cells are halved along each axis beyond what compiling does
OPEN = 2**8  # number of open boxes of a cell above which nothing is claimed of it
BEYOND = 3  # of a step, beside what tables decide: its range leaves the window


class _Boxes(NamedTuple):
    """Boxes of states, shape (B, d), the pairs they belong to, and the places of their cells."""

    low: Floats
    high: Floats
    owner: Indices
    place: Indices

    def some(self, chosen: Bools | slice) -> "_Boxes":
        return _Boxes(self.low[chosen], self.high[chosen], self.owner[chosen], self.place[chosen])

    def halved(self, unit: Floats) -> "_Boxes":
        """Return the halves of all boxes, each cut along its longest side, in units by axis."""
        axis = np.argmax((self.high - self.low) / unit, axis=1)
        rows = np.arange(len(axis))
        upper, lower = self.low.copy(), self.high.copy()
        upper[rows, axis] = lower[rows, axis] = self.low[rows, axis] / 2 + self.high[rows, axis] / 2
        low, high = np.concatenate([self.low, upper]), np.concatenate([lower, self.high])
        return _Boxes(low, high, np.tile(self.owner, 2), np.tile(self.place, (2, 1)))


class Inclusion:
    """Decides of pairs whether all that they can meet, and their way, is allowed.

    Parameters
    ----------
    problem, partition, sets
        What is judged.
    allowed
        Where steps may end, shape (N,): C and A.
    window
        Of whose cells alone sets and ``allowed`` are, where it is not the box.
    """

    def __init__(
        self, problem: Problem, partition: Partition, sets: CellSets | WindowSets, allowed: Bools,
        window: Window | None = None,
    ) -> None:  # fmt: skip
        self.partition, self.path = partition, problem.judged == "path"
        grid = Slabs(problem, partition, Deadline())
        self.encloser, self.domains, self.controls = grid.encloser, grid.domains, grid.controls
        self.unit = partition.width / grid.pieces
        self.cuts = sum(int(n).bit_length() - 1 + CUTS for n in grid.pieces)
        self.window = Window.whole(partition) if window is None else window
        if isinstance(sets, WindowSets):
            self.judged = PathTables.within(problem, self.window, *sets)
        else:
            self.judged = PathTables.of(problem, sets, partition)
        self.others, self.allowed = counting.table(~allowed, self.window), allowed
        self.left = np.empty((0, 2), dtype=np.int64)
        self.true_map = grid.encloser.true_map
        self.admitted, self.names = grid.admitted, grid.names

    def __call__(
        self, cell: Indices, control: NDArray[np.integer], guard: Guard | None = None
    ) -> Bools:
        """Return for which pairs that is proved, shape (pairs,).

        The work ends where it is not proved of one: it is of none of those left undecided.
        """
        return self.within(cell, control, guard)[0]

    def within(
        self, cell: Indices, control: NDArray[np.integer], guard: Guard | None = None
    ) -> tuple[Bools, Bools]:
        """Return the same, and which pairs are not judged, as what they meet leaves the window.

        The planes that these need are noted in ``left``, as runs.
        """
        proved, boxes = np.ones(len(cell), dtype=np.bool_), self._cells(cell)
        beyond, step = np.zeros(len(cell), dtype=np.bool_), max(1, BOXES // self.encloser.parts)
        for cut in range(self.cuts + 1):
            decided, left, refuted = np.zeros((3, len(boxes.owner)), dtype=np.bool_)
            for start in range(0, len(decided), step):
                some = slice(start, start + step)
                part = boxes.some(some)
                u = self.controls[:, control[part.owner]]
                decided[some], left[some] = self._decided(part, u, guard)
                refuted[some] = ~decided[some] & self._refuted(part, u, guard)
            beyond[boxes.owner[left]] = True
            more = ~decided & ~beyond[boxes.owner]
            boxes, refuted = boxes.some(more), refuted[more]
            crowded = np.bincount(boxes.owner, minlength=len(cell)) > OPEN
            proved[crowded] = proved[boxes.owner[refuted]] = False
            if not len(boxes.owner) or not proved.all():
                break
            if cut < self.cuts:
                boxes = boxes.halved(self.unit)
        proved[boxes.owner] = False
        return proved, beyond

    def _refuted(self, boxes: _Boxes, u: Floats, guard: Guard | None) -> Bools:
        """Return for which boxes some noise sends the middle to where it may not.

        None where the path is judged: it may have been in the attractor before.
        """
        if self.path:
            return np.zeros(len(boxes.owner), dtype=np.bool_)
        middle = list((boxes.low / 2 + boxes.high / 2).T[:, :, None])
        noise = [w.midpoint[None] for w in self.encloser.noise]
        images = self.true_map(middle, list(u[:, :, None]), noise, guard)
        shape = (len(boxes.owner), self.encloser.parts)
        cell = self.partition.locate([np.broadcast_to(x, shape) for x in images])
        at = self.window.positions(cell)
        lost: Bools = np.any((cell < 0) | ((at >= 0) & ~self.allowed[at]), axis=1)
        return lost

    def _cells(self, cell: Indices) -> _Boxes:
        """Return the boxes of cells; one at the seam of a circle has another one there."""
        place = np.stack(self.partition.multi_index(cell), axis=-1)
        owner = np.arange(len(cell))
        for k in np.flatnonzero(self.partition.periodic):
            seam = place[:, k] == 0
            beyond = place[seam].copy()
            beyond[:, k] = self.partition.cells[k]
            place, owner = np.concatenate([place, beyond]), np.concatenate([owner, owner[seam]])
        axes = list(zip(self.domains, place.T, strict=True))
        low = np.stack([domain.low[at] for domain, at in axes], axis=-1)
        high = np.stack([domain.high[at] for domain, at in axes], axis=-1)
        return _Boxes(low, high, owner, place)

    def _decided(self, boxes: _Boxes, u: Floats, guard: Guard | None) -> tuple[Bools, Bools]:
        """Return which boxes are decided, and of which something leaves the window."""
        count, parts = len(boxes.owner), self.encloser.parts
        ends = zip(boxes.low.T, boxes.high.T, strict=True)
        states = [Interval(low[:, None], high[:, None]) for low, high in ends]
        controls = list(u[:, :, None])
        noise = [Interval(w.low[None], w.high[None]) for w in self.encloser.noise]
        every = StepBoxes(states, controls, noise)
        lost, judge = np.zeros((count, parts), dtype=np.uint8), self._judging()
        for stretch in self.encloser.path(every, guard) if self.path else ():
            self._met(stretch, boxes.place, judge, lost)
        first, last = self._met(self.encloser.images(every, guard), boxes.place, judge, lost)
        self.window.enter(first, last)
        kept: Bools = np.all(lost <= counting.ABSORBED, axis=1)
        counting.keep(self.others, first, last, kept)
        if self.admitted is not None:
            points = map(Interval.point, controls)
            values = dict(zip(self.names, (*states, *points), strict=True))
            surely = self.admitted.decide(values, guard)[0][0]
            kept = kept & np.broadcast_to(surely, (count, 1))[:, 0]
        return kept, np.any(lost == BEYOND, axis=1)

    def _judging(self) -> Callable[..., None]:
        """Return what judges the stretches of some boxes."""
        if self.window.is_whole:
            return partial(counting.judge, self.judged)
        return Following(lambda *_: WindowTables(self.window, self.judged)).judge

    def _met(
        self, stretch: Stretch, place: Indices, judge: Callable[..., None], lost: NDArray[np.uint8]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Judge a stretch; return the ranges that it meets, shape (B, parts, d) each."""
        axes = range(self.partition.dimension)
        own = [place[:, k, None].astype(np.float64) for k in axes]
        spans = [met(stretch, k, self.partition, own[k]) for k in axes]
        at = [np.arange(len(place))]
        first, last, out = taken(spans, at, self.partition, self.encloser.parts)
        judged = np.asarray(False if stretch.judged is None else stretch.judged)
        way = np.ascontiguousarray(np.broadcast_to(judged, out.shape))
        if not self.window.is_whole:
            going = (lost == counting.GOING) & ~out
            left = going & ~self.window.holds(first[..., 0], last[..., 0])
            lost[left] = BEYOND
            self.left = np.append(self.left, joined(first[left, 0], last[left, 0]), axis=0)
        judge(first, last, out, way, lost)
        return first, last

"""Whether all that the pairs of a policy can meet lies in C u A, checked anew.

Nothing of what compiling found is used, nor the compiled loops that found it: arrays of intervals
judge them, which is fast enough for one control a cell. The cell of a pair is one box, cut in two
where its enclosure does not decide, first along the axes along which compiling cuts: what that
could show is shown here as well. A cell is given up where the image of the middle of a box is not
allowed.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.formulas.intervals import Interval
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import counting
from lmdsl.model.successors.enclosing import StepBoxes, Stretch
from lmdsl.model.successors.following import PathTables
from lmdsl.model.successors.ranges import taken
from lmdsl.model.successors.slabs import Slabs, met
from lmdsl.problem.problem import Problem

BOXES = 2**14  # number of boxes times parts of the noise that are enclosed at a time
CUTS = 2  # number of times that cells are halved along each axis beyond what compiling does
OPEN = 2**8  # number of open boxes of a cell above which nothing is claimed of it


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
    """

    def __init__(
        self, problem: Problem, partition: Partition, sets: CellSets, allowed: Bools
    ) -> None:
        self.partition, self.path = partition, problem.judged == "path"
        grid = Slabs(problem, partition, Deadline())
        self.encloser, self.domains, self.controls = grid.encloser, grid.domains, grid.controls
        self.unit = partition.width / grid.pieces
        self.cuts = sum(int(n).bit_length() - 1 + CUTS for n in grid.pieces)
        self.judged = PathTables.of(problem, sets, partition)
        self.others, self.allowed = counting.table(~allowed, partition), allowed
        self.true_map = grid.encloser.true_map
        self.admitted, self.names = grid.admitted, grid.names

    def __call__(
        self, cell: Indices, control: NDArray[np.integer], guard: Guard | None = None
    ) -> Bools:
        """Return for which pairs that is proved, shape (pairs,).

        The work ends where it is not proved of one: it is of none of those left undecided.
        """
        proved, boxes = np.ones(len(cell), dtype=np.bool_), self._cells(cell)
        step = max(1, BOXES // self.encloser.parts)
        for cut in range(self.cuts + 1):
            decided, refuted = (np.zeros(len(boxes.owner), dtype=np.bool_) for _ in range(2))
            for start in range(0, len(decided), step):
                some = slice(start, start + step)
                part = boxes.some(some)
                u = self.controls[:, control[part.owner]]
                decided[some] = self._decided(part, u, guard)
                refuted[some] = ~decided[some] & self._refuted(part, u, guard)
            boxes, refuted = boxes.some(~decided), refuted[~decided]
            crowded = np.bincount(boxes.owner, minlength=len(cell)) > OPEN
            proved[crowded] = proved[boxes.owner[refuted]] = False
            if not len(boxes.owner) or not proved.all():
                break
            if cut < self.cuts:
                boxes = boxes.halved(self.unit)
        proved[boxes.owner] = False
        return proved

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
        lost: Bools = np.any((cell < 0) | ~self.allowed[cell], axis=1)
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

    def _decided(self, boxes: _Boxes, u: Floats, guard: Guard | None) -> Bools:
        count, parts = len(boxes.owner), self.encloser.parts
        ends = zip(boxes.low.T, boxes.high.T, strict=True)
        states = [Interval(low[:, None], high[:, None]) for low, high in ends]
        controls = list(u[:, :, None])
        noise = [Interval(w.low[None], w.high[None]) for w in self.encloser.noise]
        every = StepBoxes(states, controls, noise)
        lost = np.zeros((count, parts), dtype=np.uint8)
        for stretch in self.encloser.path(every, guard) if self.path else ():
            self._met(stretch, boxes.place, lost)
        first, last = self._met(self.encloser.images(every, guard), boxes.place, lost)
        kept: Bools = np.all(lost != counting.LOST, axis=1)
        counting.keep(self.others, first, last, kept)
        if self.admitted is not None:
            points = map(Interval.point, controls)
            values = dict(zip(self.names, (*states, *points), strict=True))
            surely = self.admitted.decide(values, guard)[0][0]
            kept = kept & np.broadcast_to(surely, (count, 1))[:, 0]
        return kept

    def _met(
        self, stretch: Stretch, place: Indices, lost: NDArray[np.uint8]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Judge a stretch; return the ranges that it meets, shape (B, parts, d) each."""
        axes = range(self.partition.dimension)
        own = [place[:, k, None].astype(np.float64) for k in axes]
        spans = [met(stretch, k, self.partition, own[k]) for k in axes]
        at = [np.arange(len(place))]
        first, last, out = taken(spans, at, self.partition, self.encloser.parts)
        judged = np.asarray(False if stretch.judged is None else stretch.judged)
        way = np.ascontiguousarray(np.broadcast_to(judged, out.shape))
        counting.judge(self.judged, first, last, out, way, lost)
        return first, last

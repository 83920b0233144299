"""What enclosures of whole cells do not rule out where no sample is lost: why pairs are dropped."""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Indices, Statuses
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid import boxes
from lmdsl.model.grid.boxes import Ends
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus, sets_of
from lmdsl.model.successors import counting
from lmdsl.model.successors.following import PathTables
from lmdsl.model.successors.ranges import pairwise, taken
from lmdsl.model.successors.slabs import Slab, Slabs, Span
from lmdsl.model.successors.survival import Successors
from lmdsl.problem.problem import Problem


def admissible(problem: Problem, partition: Partition, transitions: Transitions) -> Bools | None:
    """Return which pairs enclosures leave, shape (pairs,); None where samples decide."""
    found = Successors.asked_for(problem, partition, transitions, Deadline())
    return None if found is None else found.admissible


def refuse(problem: Problem) -> None:
    """Refuse the phase-one LP where successors are enclosed: it follows samples."""
    if problem.successors == "enclosed":
        raise BadInput(
            "successors are enclosed, and the phase-one LP follows samples; ask for it with "
            '"successors": "sampled"',
            "phase_one",
        )


class Doubt(NamedTuple):
    """What enclosures do not rule out of a pair.

    Attributes
    ----------
    kind
        ``can leave``, ``can enter avoid``, ``can enter`` (a cell that is lost) or ``not admissible
        everywhere``.
    meets
        What the image, or a part of the way, can meet, by axis.
    out
        Axes along which it can leave the box, or be undefined.
    cell
        Of ``can enter``: a cell that is lost.
    """

    kind: str
    meets: Ends | None = None
    out: tuple[str, ...] = ()
    cell: int | None = None


class WholeCells:
    """Encloses one pair at a time, as compiling does."""

    def __init__(self, problem: Problem, partition: Partition, status: Statuses) -> None:
        self.partition = partition
        self._slabs = Slabs(problem, partition, Deadline())
        self._judged = PathTables.of(problem, sets_of(status), partition)

    def inadmissible(self, cell: int, control: int) -> Doubt | None:
        """Return why a pair is not admissible; None where it is."""
        doubt, _, _ = self._followed(self._slab(cell, control))
        return doubt

    def lost(self, cell: int, control: int, status: Statuses) -> Doubt | None:
        """Return why a pair does not survive; None where it does."""
        doubt, first, last = self._followed(self._slab(cell, control))
        if doubt is not None:
            return doubt
        bad = ~np.isin(status, (CellStatus.STABILIZED, CellStatus.ATTRACTOR))
        for a, b in zip(first, last, strict=True):
            held = self._cells(a, b)
            if bad[held].any():
                lost = held[
                    bad[held]
                ]  # by cause: rather one that escapes than one that leads to it
                return Doubt("can enter", self._ends(a, b), cell=int(lost[np.argmin(status[lost])]))
        return None

    def _slab(self, cell: int, control: int) -> Slab:
        index = [int(k[0]) for k in self.partition.multi_index(np.array([cell]))]
        return Slab(tuple((k, k + 1) for k in index), (control, control + 1))

    def _followed(self, block: Slab) -> tuple[Doubt | None, Indices, Indices]:
        """Return what is wrong on the way or at the end, and the ranges there, (parts, d) each."""
        p, parts = self.partition, self._slabs.encloser.parts
        at = [np.zeros(1, dtype=np.int64)] * (p.dimension + 1)
        admitted = self._slabs.admits(block)
        doubt = None
        if admitted is not None and not admitted.all():
            doubt = Doubt("not admissible everywhere")
        state = np.zeros((1, parts), dtype=np.uint8)
        for spans, judged in self._slabs.stretches(block):
            first, last, out = taken(spans, at, p, parts)
            way = pairwise(judged, at, parts)
            counting.judge(self._judged, first, last, out, way, state)
            lost = state[0] == counting.LOST
            if doubt is None and lost.any():
                doubt = self._doubt(spans, first[0], last[0], out[0], lost)
        return doubt, first[0], last[0]

    def _doubt(
        self, spans: list[Span], first: Indices, last: Indices, out: Bools, lost: Bools
    ) -> Doubt:
        part = int(np.argmax(lost))
        meets = self._ends(first[part], last[part])
        if not out[part]:
            return Doubt("can enter avoid", meets)
        ends = [np.broadcast_to(low.ravel(), len(lost))[part] for low, _ in spans]
        names = tuple(
            name for name, end in zip(self.partition.names, ends, strict=True) if np.isnan(end)
        )
        kept = {name: end for name, end in meets.items() if name not in names}
        return Doubt("can leave", kept, names)

    def _ends(self, first: Indices, last: Indices) -> Ends:
        start = first.astype(np.int64)
        return boxes.ends(self.partition, start, last.astype(np.int64) - start + 1)

    def _cells(self, first: Indices, last: Indices) -> Indices:
        """Return the cells of a range, in order."""
        axes = zip(first, last, self.partition.cells, strict=True)
        index = [np.unique(np.arange(int(a), int(b) + 1) % int(n)) for a, b, n in axes]
        cells: Indices = np.ravel_multi_index(np.ix_(*index), self.partition.shape).ravel()
        return cells

"""Stretches of steps by compiled loops: the same operations as enclosing.py, on blocks of boxes.

What encloses is the natural and the mean value form, intersected; along a path the hulls of the
Bernstein points of the parts of its arcs. What is exact there, sums with 0 among them, is so here.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Guard
from lmdsl.formulas.compiled.machine import BLOCK
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.program import Program
from lmdsl.machine.kernels import fixed
from lmdsl.model.successors.compiled.sharing import Group, Shared, groups
from lmdsl.model.successors.compiled.substeps import GroupStretches, enclose_substeps, room_for
from lmdsl.model.successors.enclosing import Encloser, StepBoxes, Stretch, blossoms
from lmdsl.systems.runge_kutta import RungeKutta

SMALLEST = 2.0**-900  # width of a cell
WORK = 2**24  # operations on boxes between two looks at the clock


EnclosedGroup = tuple[Group, GroupStretches, tuple[int, ...]]


class CompiledEncloser:
    """Encloses as an :class:`Encloser` does whose map is made of formulas."""

    def __init__(self, encloser: Encloser, path: bool) -> None:
        true_map = encloser.true_map
        names = true_map.problem.noises
        self.parts = encloser.arc_parts if path else 0
        self.groups = groups(true_map, [names[j] for j in encloser.varying], self.parts)
        self.width = true_map.partition.width
        shape = (self.parts, 4, 3)
        self.points = fixed(np.array([*blossoms(max(self.parts, 1))])[: self.parts].reshape(shape))

    @classmethod
    def of(cls, encloser: Encloser, path: bool) -> "CompiledEncloser | None":
        """Return what encloses in place of another.

        None where the map is not made of formulas, and where cells are so small that least widths
        (ends.py) could be seen.
        """
        made = isinstance(encloser.true_map.map, Program | RungeKutta)
        return cls(encloser, path) if made and encloser.width.min() > SMALLEST else None

    @property
    def size(self) -> int:
        """Number of doubles that are kept of a box."""
        return max(
            2 * len(group.components) * (1 + group.shared.sizes[2] * self.parts)
            for group in self.groups
        )

    def stretches(
        self, boxes: StepBoxes, path: bool, guard: Guard | None = None
    ) -> Iterator[Stretch]:
        """Enclose the parts of the path, where it is judged, and last the images."""
        each = [(group, *self._enclosed(group, boxes, guard)) for group in self.groups]
        count = len(each[0][1].low)
        for s in range(count):
            lows, highs = (_by_axis(each, name, s) for name in ("low", "high"))
            places = tuple(Interval(*ends) for ends in zip(lows, highs, strict=True))
            if s == count - 1:
                yield Stretch(places)
                return
            rises, falls = (_by_axis(each, name, 0) for name in ("rises", "falls"))
            turns = (() if s else rises, () if s else falls)
            yield Stretch(places, turns[0], turns[1], self._judged(each, s))

    def _judged(self, each: list[EnclosedGroup], s: int) -> Bools:
        """Return whether a part certainly holds a place at which it is judged; see enclosing.py."""
        arc, part = divmod(s, self.parts)
        steep = np.zeros(())
        for _, found, shape in each:
            steep = np.maximum(steep, found.steep[arc].reshape(shape))
        return np.asarray((2 * steep > self.parts - 1 + 1e-6) | (part == self.parts - 1))

    def _enclosed(
        self, group: Group, boxes: StepBoxes, guard: Guard | None
    ) -> tuple[GroupStretches, tuple[int, ...]]:
        points = (Interval(u, u) for u in boxes.controls)
        every: list[Interval] = [*boxes.states, *points, *boxes.noise]
        shape = np.broadcast_shapes(
            (1,) * max(np.ndim(x.low) for x in every),
            *(np.shape(every[k].low) for k in group.given),
        )
        count, shared, own = int(np.prod(shape)), group.shared, len(group.components)
        given = np.empty((len(group.given), 2, count))
        for row, k in zip(given, group.given, strict=True):
            for end, ends in zip(row, every[k], strict=True):
                end.reshape(shape)[...] = ends
        arcs = shared.sizes[2] if self.parts else 0
        turns = (min(arcs, 1), own, count)
        found = GroupStretches(
            np.empty((arcs * self.parts + 1, own, count)),
            np.empty((arcs * self.parts + 1, own, count)),
            np.empty(turns, dtype=np.bool_), np.empty(turns, dtype=np.bool_),
            np.zeros((arcs, count)),
        )  # fmt: skip
        width = fixed(self.width[group.components])
        room, step = room_for(shared, own), _step(shared)
        with np.errstate(all="ignore"):
            for at in range(0, count, step):
                if guard is not None:
                    guard()
                limits = (at, min(at + step, count))
                enclose_substeps(shared, fixed(given), room, self.points, width, limits, found)
        return found, shape


def _by_axis(each: list[EnclosedGroup], name: str, s: int) -> tuple[NDArray[Any], ...]:
    """Return rows of what was found of a stretch in the order of the axes, shaped as boxes."""
    rows: dict[int, NDArray[Any]] = {}
    for group, found, shape in each:
        for i, row in zip(group.components, getattr(found, name)[s], strict=True):
            rows[i] = row.reshape(shape)
    return tuple(rows[i] for i in sorted(rows))


def _step(shared: Shared) -> int:
    """Return how many boxes are enclosed between two looks at the clock."""
    effort = shared.sizes[2] * max(len(shared.advance.box.code), 1)
    return max(WORK // effort // BLOCK, 1) * BLOCK

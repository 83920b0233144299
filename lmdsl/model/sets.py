"""Which cells are attractor, avoid or free, and where the weight m may be positive."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.faults import together
from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.model.grid import boxes, conditions
from lmdsl.model.grid.axis import AxisCells
from lmdsl.model.grid.conditions import OnAxes
from lmdsl.model.grid.declared_sets import CellBlock, DeclaredSet
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.room import free_room
from lmdsl.problem.problem import Problem
from lmdsl.problem.sets import Attractor, Measure
from lmdsl.systems import MatrixSystem

CELL = 32  # bytes of a cell while the sets are made

PART = 2**16  # number of cells of which the density is evaluated at a time


@dataclass(frozen=True, eq=False)
class CellSets:
    """Which cells are attractor (A), avoid (Z) or free (neither)."""

    # attractor, avoid: masks of shape (N,)
    attractor: Bools
    avoid: Bools
    mass: Floats  # weight of every cell before it is intersected with C and scaled, shape (N,)
    free: Indices  # indices of the cells outside A and Z, shape (F,), ascending
    # shape (N,), int32: position in ``free``; F for the attractor; -1 for avoid
    number: NDArray[np.int32]

    def meet(self, index: Floats | Indices) -> None:
        """Make known what some cells are, NaN for none: all are known here."""

    def meet_paths(self, state: Floats, slope: Floats) -> None:
        """Make known what paths lead to, of these places and slopes on the first axis.

        Both are those of the knots, shape (knots, samples); slopes in substeps.
        """

    def free_before(self, cell: int) -> int:
        """Return how many cells before one are free."""
        return int(np.searchsorted(self.free, cell))

    def room(self, partition: Partition) -> NDArray[np.uint8]:
        """Return the room of cells, shape (N,): :func:`~lmdsl.model.grid.room.free_room`."""
        free = (self.number >= 0) & ~self.attractor
        return free_room(free.reshape(partition.shape), partition.periodic)

    def weight(self, cells: NDArray[np.integer]) -> Floats:
        """Return m on the cells of C: their mass scaled to sum 1, all zero where they have none."""
        return scaled(self.mass[cells])

    @classmethod
    def of(cls, problem: Problem, partition: Partition, deadline: Deadline | None = None) -> Self:
        """Resolve the attractor, the avoid set and the weight of a problem.

        Raises
        ------
        TimeLimitReached
            The deadline has passed.
        BadInput
            A point or index lies outside the box, a set has no cell, or a cell is both
            attractor and avoid.
        """
        memory.require(CELL * partition.size, "the sets of cells")
        guard = partial(Deadline.of(deadline).raise_if_over, "compiling")
        declared = attractor_of(problem, partition, guard)
        attractor = declared.everywhere()
        if not (attractor.any() or problem.attractor.empty):
            raise no_cell(problem.attractor, partition, "attractor")
        avoid = avoid_of(problem, partition, guard).everywhere()
        require_apart(partition, np.flatnonzero(attractor & avoid))
        return cls.made(attractor, avoid, Mass(problem, partition, guard).everywhere())

    @classmethod
    def made(cls, attractor: Bools, avoid: Bools, mass: Floats) -> Self:
        """Return the sets of masks that are known."""
        free = np.flatnonzero(~attractor & ~avoid)
        number = np.full(len(attractor), -1, dtype=np.int32)
        number[free] = np.arange(len(free), dtype=np.int32)
        number[attractor] = len(free)
        return cls(attractor, avoid, mass, free, number)


def scaled(mass: Floats) -> Floats:
    """Return masses scaled to sum 1, all zero where they are."""
    if mass.max(initial=0.0) > 1e290:
        mass = mass / mass.max()  # the sum would overflow
    equal = len(mass) > 0 and bool((mass == mass[0]).all())
    total = len(mass) * float(mass[0]) if equal else math.fsum(mass)  # both correctly rounded
    return mass / total if total > 0 else np.zeros(len(mass))


def always_whole(problem: Problem) -> bool:
    """Return whether whoever compiles a part of a problem needs the sets of all cells."""
    return isinstance(problem.system, MatrixSystem)


def require_apart(partition: Partition, both: Indices) -> None:
    """Refuse a problem of which some cells are both attractor and avoid."""
    if len(both):
        cell = boxes.named(partition, int(both[0]))
        raise BadInput(f"{cell} is both attractor and avoid; shrink one of them", "avoid")


class Mass:
    """The weight of cells before it is intersected with C and scaled: of all, or of some.

    BadInput: there are not as many weights as cells.
    """

    def __init__(self, problem: Problem, partition: Partition, guard: Guard) -> None:
        self.problem, self.partition, self.guard = problem, partition, guard
        self.density = problem.density()
        weights = None if problem.measure is None else problem.measure.weights
        if weights is not None and len(weights) != partition.size:
            raise BadInput(
                f"{len(weights)} weights for {partition.size} cells; give one each",
                "measure.weights",
            )
        self.weights = None if weights is None else np.array(weights)

    def everywhere(self) -> Floats:
        """Return the mass of all cells, shape (N,); BadInput: a density is wrong, or all is 0."""
        N = self.partition.size
        if self.problem.measure is None:
            return np.broadcast_to(1.0, N)  # takes no memory
        mass = np.empty(N)
        for start in range(0, N, PART):
            mass[start : start + PART] = self.declared(start)
        if self.region is not None:
            mass[~self.region.everywhere()] = 0.0
        if not mass.any():
            raise weightless()
        return mass

    def on(self, cells: Indices) -> Floats:
        """Return the mass of some cells, ascending ones: as :meth:`everywhere`."""
        mass = np.ones(len(cells))
        if self.problem.measure is None:
            return mass
        for k in np.unique(cells // PART).tolist():
            some = slice(*np.searchsorted(cells, (k * PART, (k + 1) * PART)))
            mass[some] = self.declared(k * PART)[cells[some] - k * PART]
        if self.region is not None:
            mass[~self.region.on(cells, self.partition.multi_index(cells))] = 0.0
        return mass

    def declared(self, start: int) -> Floats:
        """Return what is declared of ``PART`` cells, of fewer at the end of the box.

        They are always evaluated together: what a density is to the last bit may depend on it.
        BadInput: the density is negative or not finite in one of them.
        """
        some = np.arange(start, min(start + PART, self.partition.size))
        if self.weights is not None:
            return self.weights[some]
        if self.density is None:
            return np.ones(len(some))
        centres = self.partition.centres(some)
        named = dict(zip(self.partition.names, centres.T, strict=True))
        mass = np.broadcast_to(self.density(named, self.guard)[0], len(some))
        bad = np.flatnonzero(~((mass >= 0) & np.isfinite(mass)))
        if len(bad):
            cell = boxes.named(self.partition, int(some[bad[0]]))
            raise BadInput(
                f"the density is {float(mass[bad[0]])!r} in {cell}; it must be finite and >= 0",
                "measure.density",
            )
        return mass

    @cached_property
    def region(self) -> DeclaredSet | None:
        """What carries weight; None: all may. BadInput: it has no cell."""
        declared, partition = self.problem.measure, self.partition
        if declared is None or (declared.boxes is None and declared.where is None):
            return None

        def blocks() -> Iterator[CellBlock]:
            for i, box in enumerate(declared.boxes or ()):
                yield partition.inside_box(box, f"measure.boxes[{i}]")

        held = _where(self.problem, "measure", partition, self.guard)
        found = DeclaredSet(partition, blocks, held, self.guard)
        if found.empty:
            raise no_cell(declared, partition, "measure")
        return found


def weightless() -> BadInput:
    """Return why a problem of which no cell carries weight is refused."""
    return BadInput("no cell carries weight; widen the boxes or the density", "measure")


def attractor_of(problem: Problem, partition: Partition, guard: Guard) -> DeclaredSet:
    """Return a declared attractor; BadInput: a point or index is outside the box."""
    declared, names = problem.attractor, partition.names
    for i, cell in enumerate(declared.cells):
        for k, index in enumerate(cell):
            if index >= partition.cells[k]:
                raise BadInput(
                    f"index {index} is outside 0..{partition.cells[k] - 1} of axis {names[k]}",
                    f"attractor.cells[{i}]",
                )

    def blocks() -> Iterator[CellBlock]:
        for i, point in enumerate(declared.points):
            place = [point[name] for name in names] if isinstance(point, dict) else point
            yield partition.around_point(place, f"attractor.points[{i}]")
        for i, box in enumerate(declared.boxes):
            yield partition.inside_box(box, f"attractor.boxes[{i}]")
        for cell in declared.cells:
            yield tuple(np.array([index]) for index in cell)

    return DeclaredSet(partition, blocks, _where(problem, "attractor", partition, guard), guard)


def avoid_of(problem: Problem, partition: Partition, guard: Guard) -> DeclaredSet:
    """Return a declared avoid set."""

    def blocks() -> Iterator[CellBlock]:
        for i, box in enumerate((problem.avoid and problem.avoid.boxes) or ()):
            yield partition.overlapping_box(box, f"avoid.boxes[{i}]")

    constants = problem.system.constants()
    held = [conditions.maybe(c, constants, partition, guard) for c in problem.conditions("avoid")]
    return DeclaredSet(partition, blocks, tuple(held), guard)


def _where(problem: Problem, where: str, partition: Partition, guard: Guard) -> tuple[OnAxes, ...]:
    """Return where the conditions of ``attractor`` or ``measure`` certainly hold."""
    constants = problem.system.constants()
    found = [conditions.surely(c, constants, partition, guard) for c in problem.conditions(where)]
    return tuple(found)


def no_cell(declared: Attractor | Measure, partition: Partition, where: str) -> BadInput:
    """Return why a set that is declared by boxes and conditions has no cell, box by box."""
    faults = []
    for i, box in enumerate(declared.boxes or ()):
        for name, block in zip(
            partition.names, partition.inside_box(box, f"{where}.boxes[{i}]"), strict=True
        ):
            if not block:
                why = _why_empty(partition, name, box[name])
                faults.append(BadInput(why, f"{where}.boxes[{i}].{name}"))
    if declared.where is not None:
        why = "on no cell as a whole the condition certainly holds; widen it, or use smaller cells"
        faults.append(BadInput(why, f"{where}.where"))
    return together(faults)


def _why_empty(partition: Partition, name: str, ends: tuple[float, float]) -> str:
    """Return why an axis has no cell between two ends, and what to write."""
    axis = partition.axes[partition.names.index(name)]
    a, b = ends
    told = f"[{a!r}, {b!r}]"
    if b <= axis.low or a >= axis.high:
        return (
            f"{told} lies outside the axis, [{axis.low!r}, {axis.high!r}]; move it inside, or "
            f"widen {name} in state_box"
        )
    first, last = (axis.low + k * axis.width for k in (
        np.floor((a - axis.low) / axis.width), np.ceil((b - axis.low) / axis.width)))  # fmt: skip
    first, last = max(first, axis.low) + 0.0, min(last, axis.high) + 0.0
    return (
        f"{told} holds no whole cell, which is {axis.width:.6g} wide; write [{first:.6g}, "
        f"{last:.6g}], or use more cells"
    )


MOST_BOXES = 3  # boxes of which is said what became of them


def attractor_note(problem: Problem, partition: Partition) -> str:
    """Return what became of attractor boxes that are no unions of cells, empty where all are.

    A part of a cell that a box covers is not in the attractor.
    """
    notes = []
    for i, box in enumerate(problem.attractor.boxes):
        block = partition.inside_box(box, f"attractor.boxes[{i}]")
        if not all(block):
            notes.append(f"attractor.boxes[{i}] holds no cell")
            continue
        parts = [
            part
            for axis, name, cells in zip(partition.axes, partition.names, block, strict=True)
            if (part := _asked(axis, name, cells, box.get(name, (axis.low, axis.high))))
        ]
        if parts:
            notes.append(f"attractor.boxes[{i}] asked for {' and '.join(parts)}")
    more = f"; and {len(notes) - MOST_BOXES} boxes more" if len(notes) > MOST_BOXES else ""
    return "; ".join(notes[:MOST_BOXES]) + more


def _asked(axis: AxisCells, name: str, cells: range, ends: tuple[float, float]) -> str:
    """Return what was asked for on an axis and what it became, empty where it is the same."""
    a, b = max(ends[0], axis.low), min(ends[1], axis.high)
    first, last = (axis.low + k * axis.width for k in (cells.start, cells.stop))
    if max(abs(a - first), abs(b - last)) <= 2 * axis.margin * axis.width:
        return ""
    got = f"[{first + 0.0:.6g}, {last + 0.0:.6g}], whole cells"
    return f"{name} in [{a + 0.0:.6g}, {b + 0.0:.6g}], got {got}"

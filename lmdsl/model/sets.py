"""Which cells are attractor, avoid or free, and where the weight m may be positive."""

import itertools
import math
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
from lmdsl.model.grid import boxes, conditions
from lmdsl.model.grid.axis import AxisCells
from lmdsl.model.grid.partition import Partition
from lmdsl.problem.problem import Problem
from lmdsl.problem.sets import Attractor, Measure

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

    def weight(self, cells: NDArray[np.integer]) -> Floats:
        """Return m on the cells of C: their mass scaled to sum 1, all zero where they have none."""
        mass = self.mass[cells]
        if mass.max(initial=0.0) > 1e290:
            mass = mass / mass.max()  # the sum would overflow
        equal = len(mass) > 0 and bool((mass == mass[0]).all())
        total = len(mass) * float(mass[0]) if equal else math.fsum(mass)  # both correctly rounded
        return mass / total if total > 0 else np.zeros(len(cells))

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
        attractor = _attractor(problem, partition, guard)
        avoid = _avoid(problem, partition, guard)
        both = np.flatnonzero(attractor & avoid)
        if len(both):
            cell = boxes.named(partition, int(both[0]))
            raise BadInput(f"{cell} is both attractor and avoid; shrink one of them", "avoid")
        return cls.made(attractor, avoid, _mass(problem, partition, guard))

    @classmethod
    def made(cls, attractor: Bools, avoid: Bools, mass: Floats) -> Self:
        """Return the sets of masks that are known."""
        free = np.flatnonzero(~attractor & ~avoid)
        number = np.full(len(attractor), -1, dtype=np.int32)
        number[free] = np.arange(len(free), dtype=np.int32)
        number[attractor] = len(free)
        return cls(attractor, avoid, mass, free, number)


def _conditions(problem: Problem, where: str, partition: Partition, guard: Guard) -> Bools:
    """Return the cells on which a condition of ``attractor`` or ``measure`` certainly holds."""
    found = np.zeros(partition.size, dtype=np.bool_)
    for condition in problem.conditions(where):
        found |= conditions.certain(condition, problem.system.constants(), partition, guard)
    return found


def _avoid(problem: Problem, partition: Partition, guard: Guard) -> Bools:
    blocks = (
        partition.overlapping_box(box, f"avoid.boxes[{i}]")
        for i, box in enumerate((problem.avoid and problem.avoid.boxes) or ())
    )
    mask = partition.mask(blocks, guard)
    for condition in problem.conditions("avoid"):
        mask |= conditions.possible(condition, problem.system.constants(), partition, guard)
    return mask


def _mass(problem: Problem, partition: Partition, guard: Guard) -> Floats:
    declared = problem.measure
    if declared is None:
        return np.broadcast_to(1.0, partition.size)  # takes no memory
    mass = np.ones(partition.size)
    density = problem.density()
    if declared.weights is not None:
        if len(declared.weights) != partition.size:
            raise BadInput(
                f"{len(declared.weights)} weights for {partition.size} cells; give one each",
                "measure.weights",
            )
        mass = np.array(declared.weights)
    elif density is not None:
        for start in range(0, partition.size, PART):
            some = np.arange(start, min(start + PART, partition.size))
            centres = partition.centres(some)
            mass[some] = density(dict(zip(partition.names, centres.T, strict=True)), guard)[0]
        bad = np.flatnonzero(~((mass >= 0) & np.isfinite(mass)))
        if len(bad):
            cell = boxes.named(partition, int(bad[0]))
            raise BadInput(
                f"the density is {float(mass[bad[0]])!r} in {cell}; it must be finite and >= 0",
                "measure.density",
            )
    if declared.boxes is not None or declared.where is not None:
        blocks = (
            partition.inside_box(box, f"measure.boxes[{i}]")
            for i, box in enumerate(declared.boxes or ())
        )
        inside = partition.mask(blocks, guard)
        inside |= _conditions(problem, "measure", partition, guard)
        if not inside.any():
            raise _no_cell(declared, partition, "measure")
        mass[~inside] = 0.0
    if not mass.any():
        raise BadInput("no cell carries weight; widen the boxes or the density", "measure")
    return mass


def _attractor(problem: Problem, partition: Partition, guard: Guard) -> Bools:
    declared = problem.attractor
    points = (
        partition.around_point(
            [point[name] for name in partition.names] if isinstance(point, dict) else point,
            f"attractor.points[{i}]",
        )
        for i, point in enumerate(declared.points)
    )
    blocks = (
        partition.inside_box(box, f"attractor.boxes[{i}]") for i, box in enumerate(declared.boxes)
    )
    cells = (tuple(np.array([index]) for index in cell) for cell in declared.cells)
    for i, cell in enumerate(declared.cells):
        for k, index in enumerate(cell):
            if index >= partition.cells[k]:
                raise BadInput(
                    f"index {index} is outside 0..{partition.cells[k] - 1} of axis "
                    f"{partition.names[k]}",
                    f"attractor.cells[{i}]",
                )
    mask = partition.mask(itertools.chain(points, blocks, cells), guard)  # one at a time
    mask |= _conditions(problem, "attractor", partition, guard)
    if not (mask.any() or declared.empty):
        raise _no_cell(declared, partition, "attractor")
    return mask


def _no_cell(declared: Attractor | Measure, partition: Partition, where: str) -> BadInput:
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

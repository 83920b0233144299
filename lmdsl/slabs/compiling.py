"""A problem compiled over ranks: every rank keeps the LP of its own cells of C.

What must hold: the LPs of all ranks, one after the other and in global numbers, are the one that
:func:`lmdsl.model.lp.compile` makes, to the bit: statuses, cells, pairs, rows, costs, weights.
"""

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from lmdsl.common.on_disk import Disk, beside, taken
from lmdsl.common.types import Bools, Floats, Indices, Statuses
from lmdsl.machine.deadline import Deadline
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.estimates import unless_short
from lmdsl.model.assembly.substeps import settled
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.rows import Rows
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus, Stabilizable, _ends, _keep
from lmdsl.problem import Problem
from lmdsl.ranks.mesh import Mesh
from lmdsl.ranks.verbs import Ranks
from lmdsl.slabs.graph import levels
from lmdsl.slabs.graph.pairs import OwnPairs, assembled
from lmdsl.slabs.graph.pieces import PieceSets


def compiled(
    ranks: Ranks, problem: Problem, deadline: Deadline | None = None, disk: Disk | None = None,
    dropped: Any = None,
) -> StabilizationLP:  # fmt: skip
    """Return the LP of the own cells of C; collective. ``dropped`` as of :func:`lmdsl.compile`.

    Its ``cell_status``, ``sure_levels`` and ``hold`` are those of the own part of the box: from the
    first own free cell to that of the next rank.
    """
    deadline = Deadline.of(deadline)
    problem = _settled(ranks, problem, deadline)
    partition = ranks.agreed(lambda: Partition.of(problem))
    pairs = assembled(ranks, problem, partition, deadline, disk, dropped)
    rows = pairs.rows if problem.ends_in_time else pairs.rows.without_end()
    found = levels.stabilizable(pairs.mesh, pairs.pair_pointer, rows, deadline,
                                pairs.successors, pairs.left)  # fmt: skip
    inside = found.inside[: pairs.mesh.own]
    mesh, kept, own = kept_part(pairs.mesh, pairs.rows, inside, found.surviving)
    first, last = pairs.mesh.division.own(ranks.rank)
    cells = pairs.sets.free[first:last][inside]
    part = _part(pairs)
    level, pair = found.level[inside], found.pair[inside]
    per_cell = _per_cell(pairs.pair_pointer, found.surviving)[inside]
    return StabilizationLP(
        problem=problem,
        partition=partition,
        controls=control_vectors(problem),
        cell_status=_statuses(pairs, found),
        cells=cells,
        pair_pointer=np.append(0, np.cumsum(per_cell)).astype(np.int64),
        control=taken(pairs.control, kept),
        rows=own,
        cost=taken(pairs.cost, kept),
        gamma=problem.gamma,
        weight=_weight(ranks, pairs.sets, cells),
        sure_levels=None if pairs.successors is None else pairs.successors.sure_levels(*part),
        hold=None if pairs.hold is None else pairs.hold.on(*part),
        dropped=pairs.dropped,
        mesh=mesh,
        _known=(level, pair if isinstance(kept, slice) else np.searchsorted(kept, pair)),
    )


def _settled(ranks: Ranks, problem: Problem, deadline: Deadline) -> Problem:
    """Return a problem whose substeps are a number, which rank 0 finds; collective."""
    system: Any = problem.system
    if getattr(system, "substeps", None) != "auto":
        return problem

    def settle() -> int:
        sets = PieceSets.alone(problem, unless_short(problem, deadline))
        found: Any = settled(problem, deadline, sets)
        return int(found.system.substeps)

    count = ranks.by_first(settle)
    return problem.replaced(system=system.replaced(substeps=count))


def _per_cell(pair_pointer: Indices, surviving: Bools) -> Indices:
    """Return the number of surviving pairs of every cell."""
    if surviving.all():
        return np.diff(pair_pointer)
    return np.diff(np.append(0, np.cumsum(surviving))[pair_pointer])


def kept_part(
    before: Mesh, rows: Rows, inside: Bools, surviving: Bools
) -> tuple[Mesh, Indices | slice, Rows]:
    """Return the mesh of own cells that stay, the pairs that do, and rows in its local numbers.

    Every row that is kept leads to cells that stay, of any rank. Collective.
    """
    if before.ranks.all(bool(inside.all() and surviving.all())):
        return before, slice(None), rows
    division = before.division.within(before.ranks, inside)
    number = np.full(before.own, -1, dtype=np.int64)
    number[inside] = division.own(before.ranks.rank)[0] + np.arange(inside.sum())
    numbers = before.spread(number, division.cells)
    count = int(surviving.sum())
    kept_pairs = beside(rows.target, count, np.int64)
    pointer = beside(rows.target, count + 1, np.int64)
    pointer[0] = 0
    entries = _ends(surviving, rows.pointer, kept_pairs, pointer)
    target = beside(rows.target, entries, np.int32)
    code = beside(rows.target, entries, rows.code.dtype)
    same = np.arange(before.columns + 1, dtype=np.int32)
    _keep(surviving, rows.pointer, rows.target, rows.code, same, target, code)
    used = np.zeros(before.columns + 1, dtype=np.bool_)
    used[target] = True
    named = np.flatnonzero(used)
    mesh = Mesh.of(before.ranks, division, numbers[named])
    local = np.full(before.columns + 1, -1, dtype=np.int32)
    local[named] = mesh.local(numbers[named])
    kept = Rows(pointer, taken(local, target), code, rows.shares, mesh.columns)
    return mesh, kept_pairs, kept


def _statuses(pairs: OwnPairs, found: Stabilizable) -> Statuses:
    """Return the status code of every cell of the own part of the box, as of one process."""
    code = np.full(len(found.level), CellStatus.LEADS_TO_THESE, dtype=np.uint8)
    code[~found.reaches] = CellStatus.TRAPPED
    if not pairs.empty:
        code[_choices(pairs, found) == 0] = CellStatus.ESCAPES
    code[found.inside[: len(code)]] = CellStatus.STABILIZED
    sets, (first, last) = pairs.sets, _part(pairs)
    status = np.full(last - first, CellStatus.AVOID, dtype=np.uint8)
    status[sets.attractor[first:last]] = CellStatus.ATTRACTOR
    a, b = pairs.mesh.division.own(pairs.mesh.ranks.rank)
    status[sets.free[a:b] - first] = code
    return status


def _choices(pairs: OwnPairs, found: Stabilizable) -> Indices:
    """Return how many pairs may be used in every own cell."""
    if found.admissible is None:
        return np.diff(pairs.pair_pointer)
    cells = owner(pairs.pair_pointer)[found.admissible]
    return np.bincount(cells, minlength=len(pairs.pair_pointer) - 1)


def _part(pairs: OwnPairs) -> tuple[int, int]:
    """Return the first cell of the own part of the box, and the one after its last."""
    sets, rank, starts = pairs.sets, pairs.mesh.ranks.rank, pairs.mesh.division.starts

    def begins(position: int) -> int:
        """Return where a free cell is, or the end of the box after the last."""
        free = sets.free
        return int(free[position]) if position < len(free) else len(sets.number)

    return begins(int(starts[rank])) if rank else 0, begins(int(starts[rank + 1]))


def _weight(ranks: Ranks, sets: CellSets, cells: Indices) -> Floats:
    """Return m on own cells of C, scaled to sum 1 over all: as :meth:`CellSets.weight`."""
    mass = sets.mass[cells]
    top = max(ranks.collect(float(mass.max(initial=0.0))))
    if top > 1e290:
        mass = mass / top
    every = ranks.collect((len(mass), *_ends_of(mass)))
    count = sum(n for n, *_ in every)
    ends = {x for n, low, high, _ in every if n for x in (low, high)}
    if len(ends) == 1:
        total = count * ends.pop()
    else:
        total = math.fsum(x for *_, exactly in every for x in exactly)
    return mass / total if total > 0 else np.zeros(len(cells))


def _ends_of(mass: Floats) -> tuple[float, float, list[float]]:
    """Return the least and largest mass, and doubles whose sum is exactly that of all."""
    return float(mass.min(initial=np.inf)), float(mass.max(initial=0.0)), exact_sum(mass)


def exact_sum(mass: Floats) -> list[float]:
    """Return doubles whose sum is exactly that of all."""
    if len(mass) and mass.min() == mass.max():  # a product of integers of 53 bits: two hold it
        total = Fraction(float(mass[0])) * len(mass)
        return [float(total), float(total - Fraction(float(total)))]
    exactly: list[float] = []
    while (rest := math.fsum([*mass, *(-x for x in exactly)])) != 0:
        exactly.append(rest)
    return exactly


def local(lp: StabilizationLP) -> StabilizationLP:
    """Return a whole model as one rank has it that is alone: for what is made over ranks."""
    from lmdsl.ranks.ranges import Division
    from lmdsl.ranks.verbs import Alone

    division = Division.cut(np.diff(lp.pair_pointer), 1)
    return replace(lp, mesh=Mesh.of(Alone(), division, lp.rows.target), _known=lp._algorithm_1)

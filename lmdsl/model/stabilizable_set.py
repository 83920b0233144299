"""The stabilizable set C, the cause of every other cell, and Algorithm 1, corrected.

C is the greatest set of cells in which every cell keeps an admissible control whose successors
all lie in C u A, and from which A is reachable through such controls: the almost-sure reachability
fixed point of Markov decision processes. It alternates "remove cells that cannot reach A" and
"remove pairs that can leave C" until nothing changes.

Algorithm 1 of the paper grows a tree from A: level L + 1 holds the cells, not in a lower level,
that some control can send to level L. As printed it never stops with success (it compares the
levels, A among them, with the cells without A); here it stops when a level is empty, and succeeds
when every cell has one.

Levels are found by sweeps over the rows as they are stored, one for each level: a cell is on level
L + 1 if it is on none so far and a pair of it has a target on level L. Where there are many levels
that is too slow; then, and to remove cells, passes run over the predecessors of each cell, at one
visit per entry in all.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.html import facts
from lmdsl.common.on_disk import disk_of, empty, taken
from lmdsl.common.types import Bools, Floats, Indices, Statuses
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import kernel
from lmdsl.model.algorithm_1 import Predecessors, owner, tree
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows
from lmdsl.model.sets import CellSets
from lmdsl.model.successors.survival import Successors
from lmdsl.problem.problem import Problem


class CellStatus(IntEnum):
    """What became of a cell; the codes of ``cell_status``."""

    ATTRACTOR = 0
    STABILIZED = 1
    ESCAPES = 2
    TRAPPED = 3
    LEADS_TO_THESE = 4
    AVOID = 5
    BEYOND_GAMMA = 6


LOST = (CellStatus.ESCAPES, CellStatus.TRAPPED, CellStatus.LEADS_TO_THESE)


@dataclass(frozen=True, eq=False)
class Stabilizable:
    """The stabilizable set of a set of transitions."""

    inside: Bools  # which free cells lie in C, shape (F,)
    surviving: Bools  # which pairs survive: cell in C, every successor in C u A, shape (pairs,)
    reaches: Bools  # free cells from which A can be reached through admissible pairs, shape (F,)
    # level, pair: algorithm 1 on the surviving pairs, see :func:`tree`; each of shape (F,)
    level: NDArray[np.int32]
    pair: Indices
    # which pairs enclosures leave, of those that were not dropped, shape (pairs,); None: all
    admissible: Bools | None = None


def stabilizable(
    pair_pointer: Indices,
    rows: Rows,
    deadline: Deadline | None = None,
    successors: Successors | None = None,
    left: Bools | None = None,
) -> Stabilizable:
    """Return the greatest set from which A is reached almost surely, and the pairs it keeps.

    With ``successors`` a pair is kept only if all that its image can meet lies in C u A. Pairs
    that are not ``left`` are not used; None: all are.
    """
    deadline = Deadline.of(deadline)
    before: Predecessors | None = None
    admissible = left if successors is None else successors.admissible
    if successors is not None and left is not None:
        admissible = successors.admissible & left
    alive = np.ones(rows.count, dtype=np.bool_) if admissible is None else admissible.copy()
    inside = np.ones(rows.columns, dtype=np.bool_)
    choices = np.diff(pair_pointer)
    if left is not None:
        choices = np.bincount(owner(pair_pointer)[left], minlength=len(choices))
    reaches = None
    while True:
        level, pair = tree(pair_pointer, rows, alive, before)
        reached = level >= 0
        if reaches is None:
            reaches = reached
        lost = np.flatnonzero(inside & ~reached)
        if not len(lost):
            return Stabilizable(inside, alive, reaches, level, pair, admissible)
        deadline.raise_if_over("looking for the stabilizable set")
        if successors is not None:
            successors.remove(inside & ~reached, alive, inside)
            continue
        before = before or Predecessors.of(rows)
        cell = owner(pair_pointer)
        _remove(lost, before.pointer, before.pair, cell, pair_pointer, alive, inside, choices)


def keeping(
    pair_pointer: Indices, rows: Rows, successors: Successors | None = None
) -> tuple[Bools, Bools]:
    """Return the greatest set of cells that can be kept, and the pairs that keep it.

    In it every cell has a pair all of whose successors lie in it: those of the rows, or all that
    images can meet. A run that ends by discount has not left it.
    """
    alive = np.ones(rows.count, dtype=np.bool_)
    if successors is not None:
        alive &= successors.admissible
    inside = np.ones(rows.columns, dtype=np.bool_)
    cell = owner(pair_pointer)
    choices = np.bincount(cell[alive], minlength=rows.columns).astype(np.int64)
    if successors is not None:
        successors.remove(choices == 0, alive, inside)
        return inside, alive
    before = Predecessors.of(rows.without_end())
    lost = np.flatnonzero(choices == 0)
    _remove(lost, before.pointer, before.pair, cell, pair_pointer, alive, inside, choices)
    return inside, alive


def of_problem(
    problem: Problem,
    transitions: Transitions,
    deadline: Deadline | None = None,
    successors: Successors | None = None,
    left: Bools | None = None,
) -> Stabilizable:
    """Return the stabilizable set of a problem's transitions.

    With a discount b a run that ends counts as one that reached A, as long as gamma b < 1: then
    staying for ever costs a finite amount, and C is the greatest set that can be kept. Where
    gamma b >= 1 it does not, and A has to be reached as without a discount.
    """
    rows = transitions.rows if problem.ends_in_time else transitions.rows.without_end()
    return stabilizable(transitions.pair_pointer, rows, deadline, successors, left)


def of_transitions(
    problem: Problem,
    partition: Partition,
    transitions: Transitions,
    deadline: Deadline | None = None,
) -> Stabilizable:
    """Return the stabilizable set of a problem, with enclosed successors where it asks for them."""
    deadline = Deadline.of(deadline)
    successors = Successors.asked_for(problem, partition, transitions, deadline)
    return of_problem(problem, transitions, deadline, successors)


def statuses(transitions: Transitions, found: Stabilizable, empty: bool = False) -> Statuses:
    """Return the status code of every cell (see :class:`CellStatus`), shape (N,).

    Where A is ``empty`` it cannot be reached, whatever the pairs are.
    """
    free = np.full(len(found.inside), CellStatus.LEADS_TO_THESE, dtype=np.uint8)
    free[~found.reaches] = CellStatus.TRAPPED
    if not empty:
        free[_choices(transitions, found.admissible) == 0] = CellStatus.ESCAPES
    free[found.inside] = CellStatus.STABILIZED
    status = np.full(len(transitions.sets.number), CellStatus.AVOID, dtype=np.uint8)
    status[transitions.sets.free] = free
    status[transitions.sets.attractor] = CellStatus.ATTRACTOR
    return status


def sets_of(status: Statuses) -> CellSets:
    """Return the sets that were compiled; their mass is not known here: 1 everywhere."""
    attractor, avoid = status == CellStatus.ATTRACTOR, status == CellStatus.AVOID
    return CellSets.made(attractor, avoid, np.ones(len(status)))


def _choices(transitions: Transitions, admissible: Bools | None) -> Indices:
    """Return how many admissible pairs every free cell has, shape (F,)."""
    if admissible is None:
        return np.diff(transitions.pair_pointer)
    cells = owner(transitions.pair_pointer)[admissible]
    return np.bincount(cells, minlength=len(transitions.sets.free))


@dataclass(frozen=True, eq=False)
class Survivors:
    """The surviving pairs, by cells of C.

    Attributes
    ----------
    pair_pointer
        Pairs by cell of C.
    control, cost
        Of every pair.
    rows
        Targets number the cells of C, |C| stands for the attractor.
    first
        The pair of every cell of C by Algorithm 1.
    """

    pair_pointer: Indices
    control: NDArray[np.int32]
    cost: Floats
    rows: Rows
    first: Indices


def restrict(transitions: Transitions, found: Stabilizable) -> Survivors:
    """Keep the surviving pairs and number the cells of C."""
    rows, control, cost = transitions.rows, transitions.control, transitions.cost
    n, first = int(found.inside.sum()), found.pair[found.inside]
    if n == rows.columns and found.surviving.all():
        every = control[:], cost[:]  # views: who holds the transitions keeps arrays of its own
        return Survivors(transitions.pair_pointer, *every, rows, first)
    count, disk = int(found.surviving.sum()), disk_of(rows.target)
    row = len(rows.target) / max(rows.count, 1) * (4 + rows.code.itemsize)
    if disk is None:
        memory.require(count * (28 + row), "the pairs of the stabilizable set")
    kept = empty(disk, count, np.int64)
    per_cell = np.add.reduceat(
        np.append(found.surviving, False), transitions.pair_pointer[:-1], dtype=np.int64
    )
    per_cell[np.diff(transitions.pair_pointer) == 0] = 0
    pair_pointer = np.concatenate([[0], np.cumsum(per_cell[found.inside])]).astype(np.int64)
    renumber = np.full(rows.columns + 1, -1, dtype=np.int32)
    renumber[np.flatnonzero(found.inside)] = np.arange(n, dtype=np.int32)
    renumber[rows.columns] = n
    pointer = empty(disk, count + 1, np.int64)
    pointer[0] = 0
    entries = _ends(found.surviving, rows.pointer, kept, pointer)
    target, code = empty(disk, entries, np.int32), empty(disk, entries, rows.code.dtype)
    _keep(found.surviving, rows.pointer, rows.target, rows.code, renumber, target, code)
    return Survivors(
        pair_pointer, taken(control, kept), taken(cost, kept),
        Rows(pointer, target, code, rows.shares, n), np.searchsorted(kept, first),
    )  # fmt: skip


@kernel(allocates=True)
def _remove(lost, pointer, pair, cell, pair_pointer, alive, inside, choices):  # type: ignore[no-untyped-def]
    """Remove cells, the pairs that can reach them, and cells left without a pair."""
    queue = np.empty(len(inside), dtype=np.int64)
    end = 0
    for i in lost:
        inside[i] = False
        queue[end] = i
        end += 1
    start = 0
    while start < end:
        j = queue[start]
        start += 1
        for k in range(pair_pointer[j], pair_pointer[j + 1]):
            alive[k] = False
        for e in range(pointer[j], pointer[j + 1]):
            k = pair[e]
            if alive[k]:
                alive[k] = False
                i = cell[k]
                choices[i] -= 1
                if choices[i] == 0 and inside[i]:
                    inside[i] = False
                    queue[end] = i
                    end += 1


@kernel
def _ends(kept, pointer, number, ends):  # type: ignore[no-untyped-def]
    """Write the numbers of the rows that are kept, and their ends; return the last end."""
    row = end = 0
    for k in range(len(kept)):
        if kept[k]:
            number[row] = k
            row, end = row + 1, end + pointer[k + 1] - pointer[k]
            ends[row] = end
    return end


@kernel
def _keep(kept, pointer, target, code, renumber, new_target, new_code):  # type: ignore[no-untyped-def]
    """Copy the rows that are kept, their targets renumbered."""
    at = 0
    for k in range(len(kept)):
        if kept[k]:
            for e in range(pointer[k], pointer[k + 1]):
                new_target[at], new_code[at] = renumber[target[e]], code[e]
                at += 1


def counted(cell_status: Statuses) -> list[tuple[str, int]]:
    """Return how many cells have each status, in words; those that none has are left out."""
    count = np.bincount(cell_status, minlength=len(CellStatus))
    return [(s.name.lower().replace("_", " "), int(count[s])) for s in CellStatus if count[s]]


def html(lp: Any) -> str:
    """Return a table of the sizes of a model on its stabilizable set, as notebooks show it."""
    sizes = [("rows (cells of C)", lp.n), ("columns (surviving pairs)", lp.K),
             ("transitions", len(lp.rows.target)), ("controls", len(lp.controls))]  # fmt: skip
    cells = [f"{number:,} {name}" for name, number in counted(lp.cell_status)]
    rows = [("problem", lp.problem.name)] * bool(lp.problem.name)
    rows += [(name, f"{number:,}") for name, number in sizes]
    return facts(
        [*rows, ("gamma", repr(lp.gamma)), ("cells", "\n".join(cells))], "Stabilization LP"
    )

"""Algorithm 1 and the stabilizable set over ranks, to the same levels, pairs and sets.

Levels: each rank puts its own cells on level L + 1 that have a pair with a target on level L, which
is what one process does cell by cell; then all tell each other which of their cells are on it.
Removal: each rank removes what follows from its own cells and the ghosts that it knows are lost,
then all tell what they lost, until nobody has news. The set that is left is the greatest one,
whatever the order; so are the pairs.
"""

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.machine.kernels import fixed, kernel
from lmdsl.model.algorithm_1 import PATIENCE, Graph, Predecessors, _sweep, owner
from lmdsl.model.rows import Rows
from lmdsl.model.stabilizable_set import Stabilizable, _remove
from lmdsl.ranks.mesh import Mesh
from lmdsl.slabs.graph.meeting import OwnSuccessors


class OwnRows:
    """The rows of a rank, and the pairs that can reach each cell: made once they are needed."""

    def __init__(self, pair_pointer: Indices, rows: Rows) -> None:
        self.pair_pointer, self.rows = pair_pointer, rows

    @cached_property
    def before(self) -> Predecessors:
        """The pairs that reach each cell."""
        return Predecessors.of(self.rows)

    @cached_property
    def cell(self) -> NDArray[np.int32]:
        """The cell of every pair."""
        return owner(self.pair_pointer)


def tree(mesh: Mesh, known: OwnRows, alive: Bools) -> tuple[NDArray[np.int32], Indices]:
    """Return level and first stabilizing pair of every own cell, -1 where there is none.

    Where sweeps over the rows have read them often, the rest is searched by predecessors, on all
    ranks from the same level on: what is found is the same.
    """
    own, pair_pointer, rows = mesh.own, known.pair_pointer, known.rows
    level = np.full(own, -1, dtype=np.int32)
    pair = np.full(own, -1, dtype=np.int64)
    pointer, target, _, _ = rows.kernel
    pairs = fixed(pair_pointer.view(np.uint64))
    graph = Graph(pairs, fixed(pointer), fixed(target), fixed(alive))
    all_alive, below, left = bool(alive.all()), 0, PATIENCE * len(rows.target)
    front = np.zeros(mesh.columns + 1, dtype=np.bool_)
    front[mesh.columns], search = True, False
    while True:
        if search:
            before = known.before
            start = np.flatnonzero(front)
            _enter(start, before.pointer, before.pair, known.cell, alive, below, level, pair)
        else:
            left -= int(_sweep(0, own, graph, all_alive, fixed(front), below, level, pair))
        below += 1
        reached = level == below
        every = mesh.ranks.collect((bool(reached.any()), left < 0))
        if not any(some for some, _ in every):
            return level, pair
        search = search or any(read for _, read in every)
        front = mesh.spread(reached, False)


def stabilizable(
    mesh: Mesh, pair_pointer: Indices, rows: Rows, deadline: Deadline | None = None,
    successors: OwnSuccessors | None = None, left: Bools | None = None,
) -> Stabilizable:  # fmt: skip
    """Return what :func:`lmdsl.model.stabilizable_set.stabilizable` does, of own cells and pairs.

    ``inside`` is of own cells and ghosts; the rest of own cells.
    """
    deadline = Deadline.of(deadline)
    own, ranks = mesh.own, mesh.ranks
    known = OwnRows(pair_pointer, rows)
    # Ghosts have no pairs here.
    pairs = np.append(pair_pointer, np.full(mesh.columns - own, pair_pointer[-1]))
    admissible = _both(None if successors is None else successors.own.admissible, left)
    alive = np.ones(rows.count, dtype=np.bool_) if admissible is None else admissible.copy()
    inside = np.ones(mesh.columns, dtype=np.bool_)
    choices = np.diff(pair_pointer)
    if left is not None:
        choices = np.bincount(owner(pair_pointer)[left], minlength=own)
    reaches = None
    while True:
        level, pair = tree(mesh, known, alive)
        reached = level >= 0
        reaches = reached if reaches is None else reaches
        lost = np.flatnonzero(inside[:own] & ~reached)
        if not ranks.any(len(lost) > 0):
            return Stabilizable(inside, alive, reaches, level, pair, admissible)
        ranks.agreed(lambda: deadline.raise_if_over("looking for the stabilizable set"))
        if successors is not None:
            kept = inside[:own].copy()
            successors.remove(kept & ~reached, alive, kept)
            inside = mesh.spread(kept, True)[:-1]
            continue
        while True:
            before = known.before
            _remove(lost, before.pointer, before.pair, known.cell, pairs, alive, inside, choices)
            told = mesh.spread(inside[:own], True)[:-1]
            lost = np.flatnonzero(inside & ~told)
            if not ranks.any(len(lost) > 0):
                break


def _both(some: Bools | None, others: Bools | None) -> Bools | None:
    """Return which pairs may be used by both; None: all may."""
    if some is None or others is None:
        return others if some is None else some
    return some & others


@kernel
def _enter(front, pointer, before, cell, alive, below, level, pair):  # type: ignore[no-untyped-def]
    """Put on level ``below + 1`` the own cells without level of which a pair enters the front."""
    for j in front:
        for e in range(pointer[j], pointer[j + 1]):
            k = before[e]
            if alive[k]:
                i = cell[k]
                if level[i] < 0:
                    level[i], pair[i] = below + 1, k
                elif level[i] == below + 1 and k < pair[i]:
                    pair[i] = k

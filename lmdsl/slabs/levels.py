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
from lmdsl.machine.kernels import fixed
from lmdsl.model.algorithm_1 import Graph, Predecessors, _sweep, owner
from lmdsl.model.rows import Rows
from lmdsl.model.stabilizable_set import Stabilizable, _remove
from lmdsl.ranks.mesh import Mesh


def tree(
    mesh: Mesh, pair_pointer: Indices, rows: Rows, alive: Bools
) -> tuple[NDArray[np.int32], Indices]:
    """Return level and first stabilizing pair of every own cell, -1 where there is none."""
    own = mesh.own
    level = np.full(own, -1, dtype=np.int32)
    pair = np.full(own, -1, dtype=np.int64)
    pointer, target, _, _ = rows.kernel
    pairs = fixed(pair_pointer.view(np.uint64))
    graph = Graph(pairs, fixed(pointer), fixed(target), fixed(alive))
    all_alive, below = bool(alive.all()), 0
    front = np.zeros(mesh.columns + 1, dtype=np.bool_)
    front[mesh.columns] = True
    while True:
        _sweep(0, own, graph, all_alive, fixed(front), below, level, pair)
        below += 1
        reached = level == below
        if not mesh.ranks.any(bool(reached.any())):
            return level, pair
        front = mesh.spread(reached, False)


def stabilizable(
    mesh: Mesh, pair_pointer: Indices, rows: Rows, deadline: Deadline | None = None
) -> Stabilizable:
    """Return what :func:`lmdsl.model.stabilizable_set.stabilizable` does, of own cells and pairs.

    ``inside`` is of own cells and ghosts; the rest of own cells.
    """
    deadline = Deadline.of(deadline)
    own, ranks = mesh.own, mesh.ranks
    before = Predecessors.of(rows)
    cell = owner(pair_pointer)
    # Ghosts have no pairs here.
    pairs = np.append(pair_pointer, np.full(mesh.columns - own, pair_pointer[-1]))
    alive = np.ones(rows.count, dtype=np.bool_)
    inside = np.ones(mesh.columns, dtype=np.bool_)
    choices = np.diff(pair_pointer)
    reaches = None
    while True:
        level, pair = tree(mesh, pair_pointer, rows, alive)
        reached = level >= 0
        reaches = reached if reaches is None else reaches
        lost = np.flatnonzero(inside[:own] & ~reached)
        if not ranks.any(len(lost) > 0):
            return Stabilizable(inside, alive, reaches, level, pair, None)
        ranks.agreed(lambda: deadline.raise_if_over("looking for the stabilizable set"))
        while True:
            _remove(lost, before.pointer, before.pair, cell, pairs, alive, inside, choices)
            told = mesh.spread(inside[:own], True)[:-1]
            lost = np.flatnonzero(inside & ~told)
            if not ranks.any(len(lost) > 0):
                break

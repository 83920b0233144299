"""Algorithm 1 of the paper: levels towards the attractor, by sweeps or by a search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.on_disk import beside, disk_of
from lmdsl.common.types import Bools, Indices, Policy
from lmdsl.errors import BadInput
from lmdsl.machine import memory, threads
from lmdsl.machine.kernels import ONE, fixed, kernel
from lmdsl.model.rows import Rows

if TYPE_CHECKING:
    from lmdsl.model.lp import StabilizationLP


@dataclass(frozen=True, eq=False)
class Predecessors:
    """For every target, the pairs that can reach it: the transpose of the rows' pattern."""

    # shape (columns + 2,): pairs that reach j are ``pair[pointer[j]:pointer[j + 1]]``; the
    # attractor is the last j
    pointer: Indices
    pair: NDArray[Any]  # pair indices, int32 (int64 where needed), ascending for each target

    @classmethod
    def of(cls, rows: Rows) -> Predecessors:
        """Transpose the pattern of rows."""
        large = 0 if disk_of(rows.target) else 8 * len(rows.target)
        memory.require(large + 16 * rows.columns + 8 * rows.count, "predecessors")
        pointer = np.zeros(rows.columns + 2, dtype=np.int64)
        small = rows.count < 2**31
        pair = beside(rows.target, len(rows.target), np.int32 if small else np.int64)
        _transpose(rows.pointer, rows.target, pointer, pair)
        return cls(pointer, pair)


def own_columns(policy: Any, pair_pointer: Indices) -> Policy:
    """Return a policy; BadInput unless it names one column of each cell's own."""
    found = inputs.indices(policy, int(pair_pointer[-1]), "policy", "columns")
    first, last = pair_pointer[:-1], pair_pointer[1:]
    if len(found) != len(first) or not ((found >= first) & (found < last)).all():
        raise BadInput("a policy names one column of each cell's own", "policy")
    return found


class Graph(NamedTuple):
    """The pairs of every cell, their rows, and which may be used, as compiled loops read them."""

    pair_pointer: NDArray[np.uint64]
    pointer: NDArray[np.uint64]
    target: NDArray[np.uint32]
    alive: Bools


Levels = tuple[NDArray[np.int32], Indices]  # level and first stabilizing column of every cell

# Number of visits per entry above which predecessors are made: they cost about as much.
PATIENCE = 8

PARTS = 16  # number of ranges of cells that threads work on

# Number of entries of rows from which on ranges of cells are searched in threads.
PARALLEL_FROM = 2**20


def tree(
    pair_pointer: Indices,
    rows: Rows,
    allowed: Bools | None = None,
    before: Predecessors | None = None,
) -> tuple[NDArray[np.int32], Indices]:
    """Algorithm 1, corrected: breadth-first levels from A, and the pair that put a cell there.

    Parameters
    ----------
    pair_pointer, rows
        The pairs by cell, ordered by control, and their transitions.
    allowed
        Which pairs may be used; default all.
    before
        The predecessors, where they are at hand: then no sweeps are made.

    Returns
    -------
    level : ndarray of int32, shape (cells,)
        Number of steps in which A can be reached; -1 where it cannot.
    pair : ndarray of int64, shape (cells,)
        The first pair of the cell (smallest control) that can enter the level below; -1 where
        there is none. On the surviving pairs this policy is stabilizing: each cell has a positive
        chance to descend, and none can leave.
    """
    alive = np.ones(rows.count, dtype=np.bool_) if allowed is None else allowed
    cells = rows.columns
    level = np.full(cells + 1, -1, dtype=np.int32)
    level[cells] = 0
    pair = np.full(cells, -1, dtype=np.int64)
    front = level == 0
    parts = 1 if len(rows.target) < PARALLEL_FROM else PARTS
    spans = threads.ranges(cells, parts)
    left = 0 if before else PATIENCE * len(rows.target)
    below = 0

    pointer, target, _, _ = rows.kernel
    pairs = fixed(pair_pointer.view(np.uint64))
    model = Graph(pairs, fixed(pointer), fixed(target), fixed(alive))
    all_alive, front_now = bool(alive.all()), fixed(front)

    def sweep(span: tuple[int, int]) -> int:
        return int(_sweep(*span, model, all_alive, front_now, below, level, pair))

    while left > 0 and front.any():
        left -= sum(threads.each(sweep, spans))
        below += 1
        np.equal(level, below, out=front)
    if front.any():
        before = before or Predecessors.of(rows)
        start = np.flatnonzero(front)
        _search(before.pointer, before.pair, owner(pair_pointer), alive, start, level, pair)
    return level[:-1], pair


def owner(pair_pointer: Indices) -> NDArray[np.int32]:
    """Return the cell of every pair, shape (pairs,)."""
    return np.repeat(np.arange(len(pair_pointer) - 1, dtype=np.int32), np.diff(pair_pointer))


@kernel(allocates=True)
def _transpose(pointer, target, out_pointer, pair):  # type: ignore[no-untyped-def]
    for e in range(len(target)):
        out_pointer[target[e] + 1] += 1
    for j in range(len(out_pointer) - 1):
        out_pointer[j + 1] += out_pointer[j]
    position = out_pointer[:-1].copy()
    for k in range(len(pointer) - 1):
        for e in range(pointer[k], pointer[k + 1]):
            j = target[e]
            pair[position[j]] = k
            position[j] += 1


@kernel
def _sweep(first, last, model, all_alive, front, below, level, pair):  # type: ignore[no-untyped-def]
    """Put on level ``below + 1`` the cells first..last-1 without level that can enter the front.

    Returns the number of entries visited. ``front`` is the cells on level ``below``.
    """
    pair_pointer, pointer, target, alive = model
    visits = np.uint64(0)
    for i in range(np.uint64(first), np.uint64(last)):
        if level[i] >= 0:
            continue
        begin, end = pair_pointer[i], pair_pointer[i + ONE]
        if all_alive:  # all entries of the cell at once: most cells of most sweeps do not enter
            enters = False
            for e in range(pointer[begin], pointer[end]):
                enters |= front[target[e]]
            visits += pointer[end] - pointer[begin]
            if not enters:
                continue
        for k in range(begin, end):
            if not alive[k]:
                continue
            enters = False
            for e in range(pointer[k], pointer[k + ONE]):
                enters |= front[target[e]]
            visits += pointer[k + ONE] - pointer[k]
            if enters:
                level[i], pair[i] = below + 1, k
                break
    return visits


@kernel(allocates=True)
def _search(pointer, before, cell, alive, start, level, pair):  # type: ignore[no-untyped-def]
    """Breadth-first search from the cells of the highest level so far, over predecessors."""
    queue = np.empty(len(level), dtype=np.int64)
    at, end = 0, len(start)
    queue[:end] = start
    while at < end:
        j = queue[at]
        at += 1
        for e in range(pointer[j], pointer[j + 1]):
            k = before[e]
            if alive[k]:
                i = cell[k]
                if level[i] < 0:
                    level[i], pair[i] = level[j] + 1, k
                    queue[end] = i
                    end += 1
                elif level[i] == level[j] + 1 and k < pair[i]:
                    pair[i] = k


def reaches_attractor(lp: StabilizationLP, policy: Policy) -> Bools:
    """Return the cells from which the policy can reach A, shape (n,)."""
    reaches = np.zeros(lp.n + 1, dtype=np.bool_)
    reaches[-1] = True
    if not _reach(policy.view(np.uint64), lp.rows.kernel, reaches, 64):
        level, _ = tree(np.arange(lp.n + 1, dtype=np.int64), lp.rows.take(policy))
        return level >= 0
    return reaches[:-1]


@kernel
def _reach(policy, rows, reaches, sweeps):  # type: ignore[no-untyped-def]
    """Mark cells with a marked successor until nothing changes; False where sweeps run out."""
    pointer, target, n = rows.pointer, rows.target, np.uint64(len(policy))
    for sweep in range(sweeps):
        changed = False
        for t in range(n):
            i = t if sweep % 2 == 0 else n - ONE - t
            if reaches[i]:
                continue
            for e in range(pointer[policy[i]], pointer[policy[i] + ONE]):
                if reaches[target[e]]:
                    reaches[i] = changed = True
                    break
        if not changed:
            return True
    return False

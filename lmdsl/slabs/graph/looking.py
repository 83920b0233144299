"""Some cells of C over ranks, and where they lead: the same ones for every number of ranks."""

import numpy as np

from lmdsl.common.types import Indices
from lmdsl.model.lp import StabilizationLP
from lmdsl.ranks.reading import read
from lmdsl.slabs.graph import cuts
from lmdsl.systems import MatrixSystem

MOST_BLOCKS = 2**16  # blocks of which the middles may lie in C
MOST_CELLS, LEAST_CELLS = 4096, 256  # of C that are looked at
MOST_PAIRS, LEAST_PAIRS = 64, 4  # of a cell, evenly chosen
MOST_TARGETS = 2**17  # of all cells that are looked at


def ghosts_by_axis(lp: StabilizationLP) -> dict[str, float] | None:
    """Return how many cells of others ranks would know, for each of C, by axis of cuts; collective.

    Of more than ``MOST_SLABS`` ranks, what so many would. None where there is nothing to choose:
    one rank, one axis, no cell, a finite model or recorded data.
    """
    mesh = lp.mesh
    assert mesh is not None
    ranks, problem = mesh.ranks, lp.problem
    several = sum(n > 1 for n in lp.partition.shape) > 1
    if ranks.count == 1 or not several or isinstance(problem.system, MatrixSystem):
        return None
    return estimated(lp, min(ranks.count, cuts.MOST_SLABS))


def estimated(lp: StabilizationLP, count: int) -> dict[str, float] | None:
    """Return the same for any number of slabs, of the cells of a model over ranks; collective."""
    mesh = lp.mesh
    assert mesh is not None
    ranks = mesh.ranks
    every = np.sum(ranks.collect((lp.n, lp.K, len(lp.rows.target))), axis=0).tolist()
    if not every[0]:
        return None
    most, pairs = _wanted(lp.partition.size, *every)
    blocks = cuts.Blocks.of(lp.partition, most)
    block, own, targets = ranks.agreed(lambda: _own(lp, blocks, pairs))
    numbers = np.unique(targets[1])
    cells = read(ranks, mesh.division, numbers, lp.cells.astype(np.float64))
    targets[1] = cells[np.searchsorted(numbers, targets[1])]
    parts = ranks.gather((block, np.diff(lp.pair_pointer)[own], *targets))

    def counted() -> dict[str, float] | None:
        return None if parts is None else cuts.ghosts(blocks, _joined(parts), count)

    return ranks.told(counted)[0]


def _wanted(cells: int, inside: int, pairs: int, entries: int) -> tuple[int, int]:
    """Return how many blocks the box has, so that enough middles lie in C, and pairs of a cell."""
    each = entries / max(pairs, 1)
    some = min(max(MOST_TARGETS / LEAST_CELLS / max(each, 1), LEAST_PAIRS), MOST_PAIRS)
    targets = each * min(pairs / inside, some)
    most = min(max(MOST_TARGETS / max(targets, 1), LEAST_CELLS), MOST_CELLS)
    return int(min(most * cells / inside, MOST_BLOCKS)), int(some)


def _own(lp: StabilizationLP, blocks: cuts.Blocks, most: int) -> tuple[Indices, Indices, Indices]:
    """Return blocks whose middles are own cells of C, these, and what ``most`` pairs lead to.

    The last are whose they are, and global numbers of cells of C, shape (2, t), each once.
    """
    assert lp.mesh is not None
    middles = blocks.middles
    at = np.searchsorted(lp.cells, middles)
    block = np.flatnonzero(np.append(lp.cells, -1)[at] == middles)
    own = at[block]
    first, count = lp.pair_pointer[own], np.diff(lp.pair_pointer)[own]
    taken = np.minimum(count, most)
    whose, k = _ranged(taken)
    pair = first[whose] + k * (count[whose] - 1) // np.maximum(taken[whose] - 1, 1)
    begin, length = lp.rows.pointer[pair], np.diff(lp.rows.pointer)[pair]
    of, k = _ranged(length)
    number = lp.mesh.numbers[lp.rows.target[begin[of] + k]]
    cells = lp.mesh.division.cells
    key = np.unique(whose[of] * (cells + 1) + number)
    found = np.stack(np.divmod(key, cells + 1))
    return block, own, found[:, found[1] < cells]


def _ranged(count: Indices) -> tuple[Indices, Indices]:
    """Return i, and 0 to count[i] - 1, for every i."""
    whose = np.repeat(np.arange(len(count)), count)
    return whose, np.arange(len(whose)) - np.repeat(np.cumsum(count) - count, count)


def _joined(parts: list[tuple[Indices, ...]]) -> cuts.Looked:
    """Return what all ranks looked at, in their order: that of the cells."""
    before = np.cumsum([0] + [len(block) for block, *_ in parts[:-1]])
    block, pairs, source, target = zip(*parts, strict=True)
    whose = [of + n for of, n in zip(source, before.tolist(), strict=True)]
    joined = (np.concatenate(x).astype(np.int64) for x in (block, pairs, whose, target))
    return cuts.Looked(*joined)

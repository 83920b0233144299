"""The assembly kernels: samples of pairs -> rows and mean costs.

The samples of many pairs stand side by side, one lane per pair. So the steps that treat all
samples alike (sorting, summing the cost) run on vectors of pairs.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices
from lmdsl.machine.kernels import ONE, kernel

Array = NDArray[Any]


class Numbering(NamedTuple):
    """How cells and samples are numbered in the rows.

    Attributes
    ----------
    target
        Target of every cell, negative where it counts as leaving, shape (N,).
    group, bits
        Group of every sample, shape (S,), below ``2**bits``, of the type of keys.
    first_code
        Code of one sample of each group; n samples have ``first_code + n - 1``.
    """

    target: NDArray[np.int32]
    group: Array
    bits: int
    first_code: Indices


class BlockRows(NamedTuple):
    """The admissible pairs of a block, ordered by cell, then control.

    Attributes
    ----------
    per_cell
        Number of pairs of each cell.
    control, cost, end
        Per pair: control index, mean cost, end of its row.
    target, code
        The rows one after the other.
    """

    per_cell: Indices
    control: NDArray[np.int32]
    cost: Floats
    end: Indices
    target: NDArray[np.int32]
    code: NDArray[np.uint32]


@kernel
def merge(index, cells_last, mean, numbers, key, high, wide, rows):  # type: ignore[no-untyped-def]
    """Turn the image cells of every pair into a row: sorted (target, code), equal ones counted.

    Parameters
    ----------
    index
        Shape (controls, S, cells), or (cells, S, controls) where not ``cells_last``: image cells,
        NaN where a sample leaves.
    mean
        Mean costs, the first and last axis of ``index``, each of its length or 1.
    numbers
        :class:`Numbering`.
    key
        Space for ``target << bits | group`` of the samples of a tile, an integer type wide enough
        for it, shape (S, high * wide).
    high, wide
        Cells and controls of a tile: :func:`tile`.
    rows
        The result, :class:`BlockRows` with space enough, ``per_cell`` zeros on entry.

    Returns
    -------
    pairs, entries : int
        How many were written.
    """
    per_cell, control, cost, end, target, code = rows
    pairs = entries = np.uint64(0)
    first, _, last = index.shape
    height, width = mean.shape
    down, right = np.uint64(height > 1), np.uint64(width > 1)
    cells = len(per_cell)
    controls = first * last // cells
    for c0 in range(0, cells, high):
        for a0 in range(0, controls, wide):
            c1 = c0 + high if c0 + high < cells else cells
            a1 = a0 + wide if a0 + wide < controls else controls
            across = a1 - a0
            _keys(
                index, np.uint64(a0 if cells_last else c0), np.uint64(a1 if cells_last else c1),
                np.uint64(c0 if cells_last else a0), np.uint64(c1 if cells_last else a1),
                np.uint64(1 if cells_last else across), np.uint64(across if cells_last else 1),
                numbers, key,
            )  # fmt: skip
            _sort(key, np.uint64((c1 - c0) * (a1 - a0)))
            k = np.uint64(0)
            for c in range(c0, c1):
                for a in range(a0, a1):
                    if key[0, k] >= 0:  # a sample that leaves has a negative key, now the first
                        entries = _row(key, k, numbers, entries, target, code)
                        i, j = np.uint64(a if cells_last else c), np.uint64(c if cells_last else a)
                        cost[pairs] = mean[down * i, right * j]
                        control[pairs], end[pairs] = a, entries
                        per_cell[c] += 1
                        pairs += ONE
                    k += ONE
    return pairs, entries


def merge_one(index: Array, numbers: Numbering) -> tuple[Array, Array]:
    """Return the targets and codes of one pair of many samples, none where one leaves.

    The same as by :func:`merge`, sorted by NumPy: fewer comparisons, and no long call of native
    code that nothing can end. Parameters as there.
    """
    number, group, bits, first_code = numbers
    image = index.reshape(-1)
    inside = image >= 0.0
    if not inside.all():
        return number[:0], first_code[:0]
    target = number[image.astype(np.int64)]
    if target.min() < 0:
        return target[:0], first_code[:0]
    key = target.astype(group.dtype)
    key <<= bits
    key |= group
    key.sort()
    first = np.flatnonzero(np.diff(key, prepend=-1))
    samples = np.diff(first, append=len(key))
    distinct = key[first]
    return distinct >> bits, first_code[distinct & ((1 << bits) - 1)] + samples - 1


def tile(cells_last: bool, controls: int) -> tuple[int, int]:
    """Return how many cells and controls are sorted at a time.

    Their keys stay in the first-level cache, and images are read by the cache line.
    """
    return (8, controls) if cells_last else (1, min(64, controls))


@kernel
def _keys(index, f0, f1, l0, l1, down, right, numbers, key):  # type: ignore[no-untyped-def]
    """Gather ``target << bits | group`` of every sample of a tile, columns by cell and control.

    A step along the first axis of ``index`` is ``down`` columns, along the last ``right``. All
    samples of a pair one after the other: they land near each other, in ``number`` too.
    """
    number, group, bits, _ = numbers
    for f in range(f0, f1):
        for s in range(np.uint64(len(key))):
            column = (f - f0) * down
            for x in range(l0, l1):
                image = index[f, s, x]
                inside = image >= 0.0
                t = number[np.uint64(np.int64(image if inside else 0.0))]  # not from the end
                key[s, column] = ((t if inside else -1) << bits) | group[s]
                column += right


@kernel
def _sort(key, count):  # type: ignore[no-untyped-def]
    """Sort each of the first columns by Batcher's merge exchange.

    The same comparisons whatever the keys, so that all columns do them together. (Knuth, The Art
    of Computer Programming, volume 3, 5.2.2, algorithm M.)
    """
    S = len(key)
    top = 1
    while 2 * top < S:
        top *= 2
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while d > 0:
            for s in range(S - d):
                if s & p == r:
                    low, high = np.uint64(s), np.uint64(s + d)
                    for i in range(count):
                        a, b = key[low, i], key[high, i]
                        key[low, i] = a if a < b else b
                        key[high, i] = b if a < b else a
            d, q, r = q - p, q // 2, p
        p //= 2


@kernel
def _row(key, k, numbers, entries, target, code):  # type: ignore[no-untyped-def]
    """Append one entry per distinct key of column k; return the new number of entries.

    Every sample overwrites the last entry or begins the next: no branch that depends on the keys.
    """
    bits, first_code = numbers.bits, numbers.first_code
    mask = (1 << bits) - 1
    last = key[np.uint64(0), k]
    count = first_code[np.uint64(last & mask)]
    target[entries], code[entries] = last >> bits, count
    for s in range(ONE, np.uint64(len(key))):
        here = key[s, k]
        same = here == last
        count = count + 1 if same else first_code[np.uint64(here & mask)]
        entries += np.uint64(not same)
        target[entries], code[entries] = here >> bits, count
        last = here
    return entries + ONE


@kernel
def add_cost(cost, weight, mean, least):  # type: ignore[no-untyped-def]
    """Add the cost of one sample to its pairs, and note the least."""
    for j in range(len(mean)):
        least[j] = cost[j] if cost[j] < least[j] else least[j]
        mean[j] += weight * cost[j]


@kernel
def settle_cost(mean, least, total):  # type: ignore[no-untyped-def]
    """Turn sums into means, NaN where a sample was negative or not finite."""
    for j in range(len(mean)):
        g = mean[j] / total  # not finite as soon as one sample is not
        mean[j] = g if (least[j] >= 0.0) & (g < np.inf) else np.nan


@kernel
def mean_cost(cost, points, weights, mean, least):  # type: ignore[no-untyped-def]
    """Average the stage cost over points and nodes, NaN where a sample is negative or not finite.

    Parameters
    ----------
    cost
        Shape (first, points, nodes, last); one point or node stands for all if they cost the same.
    points
        Number of points.
    weights
        Weights of the nodes.
    mean
        Shape (first, last), zeros on entry; the sum of weight times cost, in the order of the
        samples, over the total weight.
    least
        Space in the shape of ``mean``, zeros on entry.
    """
    total = 0.0
    for weight in weights:
        total += weight
    _, rows, columns, _ = cost.shape
    down, right = np.uint64(rows > 1), np.uint64(columns > 1)
    for i in range(np.uint64(len(mean))):
        for p in range(np.uint64(points)):
            for q in range(np.uint64(len(weights))):
                add_cost(cost[i, p * down, q * right], weights[q], mean[i], least[i])
        settle_cost(mean[i], least[i], points * total)

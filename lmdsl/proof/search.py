"""What images of boxes meet: the search of the tree, compiled."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats
from lmdsl.machine.kernels import kernel
from lmdsl.model.successors.compiled.places import BITS, LAST, MAY_ARRIVE, MAY_LEAVE

UNDECIDED, ARRIVES, LOST, STAYS = range(4)  # states of nodes
MEETS_UNDECIDED, MEETS_ARRIVING, MEETS_LOST, MEETS_STAYING = 1, 2, 4, 8  # 1 << state
EVERY, LEAVING = range(2)  # what ends a search: nothing, or leaving a set


class Met(NamedTuple):
    """What a search found.

    Attributes
    ----------
    bits
        Of every state that is met, 1 << state.
    leaf
        An undecided leaf that is met; without one, the dearest that is met and arrives; or -1.
    most, least
        Bounds of the cost over all that is met and arrives.
    near
        The least upper bound among them; of nodes taken as a whole the least lower one.
    level
        The largest level of what is met.
    """

    bits: int
    leaf: int
    most: float
    least: float
    near: float
    level: int


class Search(NamedTuple):
    """What a search needs.

    Attributes
    ----------
    tree, places
        The nodes, and the places of their images.
    cells, stride, periodic
        Of the axes, shape (d,).
    entry
        Bounds of the cost paid where a path enters the attractor: least, most.
    stack, odometer
        Room for the search: nodes, and per axis first, last and current cell, and the range of
        places within it, shape (5, d).
    mark
        By node: whether a search that is LEAVING counts an undecided leaf as left, or an inner
        node as one that has such a leaf.
    """

    tree: "object"
    places: NDArray[np.int64]
    cells: NDArray[np.int64]
    stride: NDArray[np.int64]
    entry: Floats
    stack: NDArray[np.int64]
    odometer: NDArray[np.int64]
    mark: NDArray[np.uint8]


@kernel
def measure(tree, nodes, volume):  # type: ignore[no-untyped-def]
    """Fill in the volumes of nodes, in cells."""
    for j in range(len(nodes)):
        volume[j] = 0.5 ** depth(tree, nodes[j])


@kernel
def depth(tree, n):  # type: ignore[no-untyped-def]
    """Return by how many bisections a node is made."""
    found = np.int64(0)
    for k in range(tree.split.shape[1]):
        found += np.int64(tree.split[n, k])
    return found


@kernel
def tally(tree, count, volume):  # type: ignore[no-untyped-def]
    """Add the volumes of the leaves of C by state, shape (4,)."""
    for n in range(count):
        if tree.child[n] < 0 and tree.images[n] > 0:
            volume[tree.state[n]] += 0.5 ** depth(tree, n)


@kernel
def meet(search, b, until):  # type: ignore[no-untyped-def]
    """Return what the images of a node meet; until it is known to be LEAVING, or EVERY node."""
    tree = search.tree
    bits, least, most = 0, search.entry[0], search.entry[1]
    if tree.flags[b] & MAY_LEAVE:
        bits |= MEETS_LOST
    met = Met(bits, -1, -np.inf, np.inf, np.inf, 0)
    if tree.flags[b] & MAY_ARRIVE:
        met = Met(bits | MEETS_ARRIVING, -1, most, least, most, 0)
    for j in range(tree.first[b], tree.first[b] + tree.images[b]):
        image = search.places[j]
        if image[0, 0] > image[0, 1]:
            continue  # nothing of it is in the box
        met = _meet_cells(search, image, until, met)
        if (met.bits & MEETS_UNDECIDED) and until != EVERY:
            break
    return met


@kernel
def _meet_cells(search, image, until, met):  # type: ignore[no-untyped-def]
    enter(search, image)
    while True:
        met = _descend(search, root(search, image), until, met)
        if (met.bits & MEETS_UNDECIDED) and until != EVERY:
            return met
        if not onward(search):
            return met


@kernel
def enter(search, image):  # type: ignore[no-untyped-def]
    """Begin with the first cell that an image meets."""
    first, last, at = search.odometer[0], search.odometer[1], search.odometer[2]
    for k in range(len(search.cells)):
        first[k], last[k] = image[k, 0] >> BITS, image[k, 1] >> BITS
        at[k] = first[k]


@kernel
def root(search, image):  # type: ignore[no-untyped-def]
    """Return the node of the cell, and fill in the range of places within it."""
    first, last, at, low, high = search.odometer
    found = np.int64(0)
    for k in range(len(search.cells)):
        low[k] = image[k, 0] & LAST if at[k] == first[k] else 0
        high[k] = image[k, 1] & LAST if at[k] == last[k] else LAST
        cell, cells = at[k], search.cells[k]
        found += (cell - cells if cell >= cells else cell) * search.stride[k]
    return found


@kernel
def onward(search):  # type: ignore[no-untyped-def]
    """Go on to the next cell; return whether there is one."""
    first, last, at = search.odometer[0], search.odometer[1], search.odometer[2]
    for k in range(len(search.cells) - 1, -1, -1):
        at[k] += 1
        if at[k] <= last[k]:
            return True
        at[k] = first[k]
    return False


@kernel
def inside(tree, n, low, high):  # type: ignore[no-untyped-def]
    """Return whether all of a node lies in a range of places within its cell."""
    for k in range(len(low)):
        shift = BITS - np.int64(tree.split[n, k])
        first = np.int64(tree.place[n, k]) << shift
        if first < low[k] or first + (np.int64(1) << shift) - 1 > high[k]:
            return False
    return True


@kernel
def _descend(search, root, until, met):  # type: ignore[no-untyped-def]
    """Search below a cell; decided nodes are taken as a whole, for EVERY leaf if all are met."""
    tree, stack = search.tree, search.stack
    low, high = search.odometer[3], search.odometer[4]
    bits, leaf, most, least, near, level = met
    stack[0], size = root, 1
    while size > 0:
        size -= 1
        n = stack[size]
        state, child = tree.state[n], tree.child[n]
        if (child >= 0) and (
            state == UNDECIDED or (until == EVERY and not inside(tree, n, low, high))
        ):
            if (until == LEAVING) & (search.mark[n] == 0):
                continue
            axis = tree.axis[n]
            middle = np.int64(tree.place[child + 1, axis]) << (BITS - tree.split[child + 1, axis])
            if low[axis] < middle:
                stack[size], size = child, size + 1
            if high[axis] >= middle:
                stack[size], size = child + 1, size + 1
            continue
        if (until == LEAVING) & (state == UNDECIDED) & (search.mark[n] == 0):
            continue
        bits |= 1 << state
        if state == ARRIVES:
            leaf = n if tree.cost[n] > most else leaf
            most, least = max(most, tree.cost[n]), min(least, tree.least[n])
            near = min(near, tree.least[n] if child >= 0 else tree.cost[n])
            level = max(level, tree.level[n])
        elif state == LOST:
            level = max(level, tree.level[n])
        elif state == UNDECIDED:
            leaf = n
            if until != EVERY:
                break
        if (until == LEAVING) & (bits & (MEETS_ARRIVING | MEETS_LOST) != 0):
            break
    return Met(bits, leaf, most, least, near, level)

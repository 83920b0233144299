"""Fixed points on the boxes: which surely arrive, or are lost; compiled.

An undecided box waits for one undecided box that its images meet; when that is decided or
bisected, it is looked at anew. So every box is looked at a few times, whatever their number. It is
done in rounds: all that is to be looked at, by several threads, on what was known before; then all
that was found is noted, in order. So nothing depends on the number of threads.
"""

import numpy as np

from lmdsl.machine.kernels import kernel
from lmdsl.model.successors.compiled.places import BITS, MAY_ARRIVE, MAY_LEAVE
from lmdsl.proof.search import (
    ARRIVES,
    EVERY,
    LOST,
    MEETS_ARRIVING,
    MEETS_LOST,
    STAYS,
    UNDECIDED,
    depth,
    enter,
    meet,
    onward,
    root,
)

AXES = 16  # one more than the number of the last axis: a way is child * AXES + axis
KNOWN, MANY = 3, 2**20  # binary digits of flags, and a number of images that is not packed


@kernel
def renew(tree, count):  # type: ignore[no-untyped-def]
    """Fill in the ways of nodes."""
    for n in range(count):
        if (tree.child[n] >= 0) & (tree.state[n] == UNDECIDED):
            lead(tree, n)
        else:
            tree.way[n, 0] = -1 - np.int64(tree.state[n])
            pack(tree, n)


@kernel
def pack(tree, n):  # type: ignore[no-untyped-def]
    """Put what a search needs of a leaf in one place: one read from memory, not three."""
    images = min(np.int64(tree.images[n]), MANY - 1)
    tree.way[n, 1] = ((tree.first[n] * MANY + images) << KNOWN) + np.int64(tree.flags[n])


@kernel
def pack_all(tree, nodes):  # type: ignore[no-untyped-def]
    """Do so for nodes."""
    for j in range(len(nodes)):
        pack(tree, nodes[j])


@kernel
def lead(tree, n):  # type: ignore[no-untyped-def]
    """Fill in the way of an undecided node that is bisected."""
    child, axis = np.int64(tree.child[n]), np.int64(tree.axis[n])
    split = np.int64(tree.split[child + 1, axis])
    tree.way[n, 0] = child * AXES + axis
    tree.way[n, 1] = np.int64(tree.place[child + 1, axis]) << (BITS - split)


@kernel
def halve(tree, nodes, first):  # type: ignore[no-untyped-def]
    """Make the halves of leaves, nodes from ``first`` on."""
    d = tree.split.shape[1]
    for j in range(len(nodes)):
        n, axis = nodes[j], tree.axis[nodes[j]]
        tree.child[n] = first + 2 * j
        for half in range(2):
            m = first + 2 * j + half
            tree.cell[m], tree.parent[m] = tree.cell[n], n
            tree.flags[m], tree.axis[m] = tree.flags[n], axis
            for k in range(d):
                tree.split[m, k], tree.place[m, k] = tree.split[n, k], tree.place[n, k]
            tree.split[m, axis] += 1
            tree.place[m, axis] = 2 * tree.place[m, axis] + half
            tree.state[m], tree.way[m, 0] = UNDECIDED, -1 - UNDECIDED
        if tree.state[n] == UNDECIDED:
            lead(tree, n)


@kernel
def _sink(way, n, low, high, stack, bits):  # type: ignore[no-untyped-def]
    """Search below a cell; return what is met, 1 << state, and an undecided leaf or -1.

    What meets decided nodes of two kinds is known to be torn: the search ends.
    """
    stack[0], size = n, 1
    while size > 0:
        size -= 1
        n = stack[size]
        c = way[n, 0]
        if c >= 0:
            axis, middle = c % AXES, way[n, 1]
            c //= AXES
            if low[axis] < middle:
                stack[size], size = c, size + 1
            if high[axis] >= middle:
                stack[size], size = c + 1, size + 1
            continue
        if c == -1:
            return bits, n
        bits |= 1 << (-1 - c)
        if bits & (bits - 1):
            break
    return bits, np.int64(-1)


@kernel
def look(search, b):  # type: ignore[no-untyped-def]
    """Return an undecided leaf that the images of a node meet; without one -1 less what is met."""
    tree = search.tree
    packed, bits, leaf = tree.way[b, 1], 0, np.int64(-1)
    flags, count, start = packed & ((1 << KNOWN) - 1), (packed >> KNOWN) % MANY, packed >> KNOWN
    start //= MANY
    if count == MANY - 1:
        count = np.int64(tree.images[b])
    bits |= MEETS_LOST if flags & MAY_LEAVE else 0
    bits |= MEETS_ARRIVING if flags & MAY_ARRIVE else 0
    for j in range(start, start + count):
        image = search.places[j]
        if image[0, 0] > image[0, 1]:
            continue  # nothing of it is in the box
        enter(search, image)
        more = True
        while more & (bits & (bits - 1) == 0):
            low, high = search.odometer[3], search.odometer[4]
            bits, leaf = _sink(tree.way, root(search, image), low, high, search.stack, bits)
            if leaf >= 0:
                return leaf
            more = onward(search)
    return -1 - np.int64(bits)


@kernel
def seek(search, nodes, found):  # type: ignore[no-untyped-def]
    """Look at nodes; see :func:`look`."""
    for j in range(len(nodes)):
        found[j] = look(search, nodes[j])


@kernel
def wake(tree, b, nodes, size):  # type: ignore[no-untyped-def]
    """Add those that wait for a node to others; return their number."""
    n = tree.waiting[b]
    tree.waiting[b] = -1
    while n >= 0:
        if (tree.child[n] < 0) & (tree.state[n] == UNDECIDED):
            nodes[size], size = n, size + 1
        tree.waits[n] = -1
        n = tree.following[n]
    return size


@kernel
def wake_all(tree, nodes, woken):  # type: ignore[no-untyped-def]
    """List all that wait for any of some nodes; return their number."""
    size = 0
    for j in range(len(nodes)):
        size = wake(tree, nodes[j], woken, size)
    return size


@kernel
def decide(tree, b, state, level):  # type: ignore[no-untyped-def]
    """Note what became of a leaf, and of the nodes above it whose halves are alike now."""
    tree.state[b], tree.level[b], tree.way[b, 0] = state, level, -1 - np.int64(state)
    n = tree.parent[b]
    while n >= 0:
        if tree.state[tree.child[n]] != state or tree.state[tree.child[n] + 1] != state:
            break
        tree.state[n], tree.way[n, 0] = state, -1 - np.int64(state)
        tree.level[n] = max(tree.level[tree.child[n]], tree.level[tree.child[n] + 1])
        n = tree.parent[n]


@kernel
def note(search, nodes, found, after, shares, level):  # type: ignore[no-untyped-def]
    """Note what was found of nodes; return how many are to be looked at next, in ``after``.

    ``level`` of what arrives now is above that of all that did; it is no number of steps until
    bounds are worked out (settling.py). That of what is lost is. ``shares`` is by state.
    """
    tree, size = search.tree, 0
    for j in range(len(nodes)):
        b, leaf = nodes[j], found[j]
        if leaf >= 0:
            if tree.state[leaf] == UNDECIDED:
                tree.waits[b] = leaf
                tree.following[b] = tree.waiting[leaf]
                tree.waiting[leaf] = b
            else:
                after[size], size = b, size + 1
            continue
        bits = -1 - leaf
        if (bits == 0) | (bits & (bits - 1) != 0):
            continue  # it meets what ends differently: only bisecting helps
        state = ARRIVES if bits == MEETS_ARRIVING else LOST if bits == MEETS_LOST else STAYS
        decide(tree, b, state, meet(search, b, EVERY).level + 1 if state == LOST else level)
        shares[state] += 0.5 ** depth(tree, b)
        size = wake(tree, b, after, size)
    return size


@kernel
def arrange(tree, nodes, sorted_, start):  # type: ignore[no-untyped-def]
    """List nodes by cell: what their images meet lies together then. ``start`` is by cell, 0."""
    for j in range(len(nodes)):
        start[tree.cell[nodes[j]]] += 1
    at = np.int64(0)
    for i in range(len(start)):
        at, start[i] = at + start[i], at
    for j in range(len(nodes)):
        i = tree.cell[nodes[j]]
        sorted_[start[i]] = nodes[j]
        start[i] += 1


@kernel
def settle(search, room, size, shares, level, most):  # type: ignore[no-untyped-def]
    """Make rounds until there are more than ``most`` nodes to look at, or none.

    ``room`` has these, room for those after them, and for what is found. Return their number, and
    the level of the round before.
    """
    nodes, after, found = room
    while (size > 0) & (size <= most):
        seek(search, nodes[:size], found)
        level += 1
        size = note(search, nodes[:size], found, after, shares, level)
        for j in range(size):
            nodes[j] = after[j]
    return size, level

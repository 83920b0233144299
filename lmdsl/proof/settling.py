"""Fixed points on the boxes: which surely arrive, are lost, or stay; compiled.

An undecided box waits for one undecided box that its images meet; when that is decided or
bisected, it is looked at anew. So every box is looked at a few times, whatever their number.
"""

import numpy as np

from lmdsl.machine.kernels import kernel
from lmdsl.proof.search import (
    ANY,
    ARRIVES,
    EVERY,
    LEAVING,
    LOST,
    MEETS_ARRIVING,
    MEETS_LOST,
    MEETS_STAYING,
    MEETS_UNDECIDED,
    STAYS,
    UNDECIDED,
    depth,
    meet,
)

SLACK = (
    2.0**-40
)  # by how much bounds are loosened, relative: more than versions of functions differ
LARGEST, OTHER = -1, -2  # of a leaf in a circle of leaves that wait for each other


@kernel
def wake(tree, b, stack, size):  # type: ignore[no-untyped-def]
    """Put those that wait for a node on the stack; return its size."""
    n = tree.waiting[b]
    tree.waiting[b] = -1
    while n >= 0:
        if (tree.child[n] < 0) & (tree.state[n] == UNDECIDED):
            stack[size], size = n, size + 1
        tree.waits[n] = -1
        n = tree.following[n]
    return size


@kernel
def wake_all(tree, nodes, stack):  # type: ignore[no-untyped-def]
    """Put all that wait for any of some nodes on the stack; return its size."""
    size = 0
    for j in range(len(nodes)):
        size = wake(tree, nodes[j], stack, size)
    return size


@kernel
def decide(tree, b, state, met, stage):  # type: ignore[no-untyped-def]
    """Note what became of a leaf, and of the nodes above it whose halves are alike now."""
    tree.state[b], tree.level[b] = state, met.level + 1
    if state == ARRIVES:
        tree.cost[b], tree.least[b] = stage[0], stage[1]
    n = tree.parent[b]
    while n >= 0:
        if tree.state[tree.child[n]] != state or tree.state[tree.child[n] + 1] != state:
            break
        unite(tree, n)
        n = tree.parent[n]


@kernel
def stage_bounds(tree, b, met, factor, slack):  # type: ignore[no-untyped-def]
    """Return bounds of the cost from a node: its stage cost and what follows, rounded outward.

    ``slack`` is relative, at least 2^-50.
    """
    after, before = factor * met.most, factor * met.least
    cost, least = tree.dearest[b] + after, tree.cheapest[b] + before
    cost += (abs(cost) + abs(after)) * slack
    least -= (abs(least) + abs(before)) * slack
    return cost if cost < np.inf else np.inf, least if least > -np.inf else -np.inf


@kernel
def settle(search, stack, size, factor):  # type: ignore[no-untyped-def]
    """Decide what can be decided, beginning with leaves on the stack; return the searches made."""
    tree, searches = search.tree, 0
    while size > 0:
        size -= 1
        b = stack[size]
        if (tree.child[b] >= 0) | (tree.state[b] != UNDECIDED) | (tree.waits[b] >= 0):
            continue
        searches += 1
        met = meet(search, b, ANY)
        if met.bits & MEETS_UNDECIDED:
            tree.waits[b] = met.leaf
            tree.following[b] = tree.waiting[met.leaf]
            tree.waiting[met.leaf] = b
            continue
        if met.bits == MEETS_ARRIVING:
            decide(tree, b, ARRIVES, met, stage_bounds(tree, b, met, factor, SLACK))
        elif met.bits == MEETS_LOST:
            decide(tree, b, LOST, met, (0.0, 0.0))
        elif met.bits == MEETS_STAYING:
            decide(tree, b, STAYS, met, (0.0, 0.0))
        else:
            continue  # it meets what ends differently: only bisecting helps
        size = wake(tree, b, stack, size)
    return searches


@kernel
def mark_inner(tree, mark, count):  # type: ignore[no-untyped-def]
    """Mark nodes with anything below them that is decided and does not stay; the rest 0."""
    for n in range(count):
        mark[n] = (tree.state[n] == ARRIVES) | (tree.state[n] == LOST)
    for n in range(count - 1, -1, -1):
        if mark[n] & (tree.parent[n] >= 0):
            mark[tree.parent[n]] = 1


@kernel
def leave(search, leaves, most):  # type: ignore[no-untyped-def]
    """Mark undecided leaves that may leave the set of those not marked, until none does.

    ``leaves`` keeps those that stay at its start; return their number, -1 after ``most`` searches.
    """
    tree, mark, n = search.tree, search.mark, len(leaves)
    outside = MEETS_ARRIVING | MEETS_LOST | MEETS_UNDECIDED
    sweep, made = 0, 0
    while made <= most:
        kept, sweep, made = 0, sweep + 1, made + n
        for j in range(n):
            b = leaves[j] if sweep % 2 == 0 else leaves[n - 1 - j]
            if meet(search, b, LEAVING).bits & outside:
                while b >= 0 and mark[b] == 0:
                    mark[b] = 1
                    b = tree.parent[b]
        for j in range(n):
            if mark[leaves[j]] == 0:
                leaves[kept], kept = leaves[j], kept + 1
        if kept == n:
            return n
        n = kept
    return -1


@kernel
def stay(search, leaves, stack):  # type: ignore[no-untyped-def]
    """Decide that leaves stay; return how many that wait are on the stack."""
    tree, size = search.tree, 0
    met = meet(search, leaves[0], LEAVING)
    for j in range(len(leaves)):
        decide(tree, leaves[j], STAYS, met, (0.0, 0.0))
        tree.level[leaves[j]] = 0
    for j in range(len(leaves)):
        size = wake(tree, leaves[j], stack, size)
    return size


@kernel
def worth(tree, leaves, volume, order, score, waiting):  # type: ignore[no-untyped-def]
    """Fill in for undecided leaves the volume that waits for them, themselves included.

    Those that wait for each other in a circle have the volume of all of it, and ``waiting`` is
    then LARGEST or OTHER. ``waiting`` and ``score`` are by node, ``waiting`` zero on entry.
    """
    n, first, last = len(leaves), 0, 0
    for j in range(n):
        b = leaves[j]
        score[b] = volume[j]
        if tree.waits[b] >= 0:
            waiting[tree.waits[b]] += 1
    for j in range(n):
        if waiting[leaves[j]] == 0:
            order[last], last = leaves[j], last + 1
    while first < last:
        b, first = order[first], first + 1
        w = tree.waits[b]
        if w >= 0:
            score[w] += score[b]
            waiting[w] -= 1
            if waiting[w] == 0:
                order[last], last = w, last + 1
    return _circles(tree, leaves, score, waiting)


@kernel
def _circles(tree, leaves, score, waiting):  # type: ignore[no-untyped-def]
    """Give all leaves of every circle the score of it, and say which are the largest."""
    circles = 0
    for j in range(len(leaves)):
        b = leaves[j]
        if waiting[b] <= 0:
            continue
        circles += 1
        total, shallow, n = 0.0, np.int64(2**31), b
        while True:
            total += score[n]
            shallow = min(shallow, depth(tree, n))
            n = tree.waits[n]
            if n == b:
                break
        while True:
            waiting[n] = LARGEST if depth(tree, n) == shallow else OTHER
            score[n] = total
            n = tree.waits[n]
            if n == b:
                break
    return circles


@kernel
def refine(search, leaves, factor, torn):  # type: ignore[no-untyped-def]
    """Work out levels and bounds of decided leaves, in order of levels, from those they meet.

    Arriving leaves are noted to wait for the dearest that they meet, and in ``torn`` by how much
    their upper bound may exceed what it is for smaller boxes.
    """
    tree = search.tree
    for j in range(len(leaves)):
        b = leaves[j]
        met = meet(search, b, EVERY)
        tree.level[b] = met.level + 1
        if tree.state[b] == ARRIVES:
            tree.cost[b], tree.least[b] = stage_bounds(tree, b, met, factor, SLACK)
            tree.waits[b] = _dearest(tree, met.leaf)
            torn[j] = (tree.dearest[b] - tree.cheapest[b]) + factor * (met.most - met.near)
        n = tree.parent[b]
        while n >= 0 and tree.state[n] != UNDECIDED:
            unite(tree, n)
            n = tree.parent[n]


@kernel
def _dearest(tree, n):  # type: ignore[no-untyped-def]
    """Return a leaf below a node that is as dear as it is."""
    while n >= 0 and tree.child[n] >= 0:
        c = tree.child[n]
        n = c if tree.cost[c] >= tree.cost[c + 1] else c + 1
    return n


@kernel
def unite(tree, n):  # type: ignore[no-untyped-def]
    """Note of a node what its halves have in common: a state, if any, and bounds."""
    one, other = tree.child[n], tree.child[n] + 1
    same = tree.state[one] == tree.state[other]
    tree.state[n] = tree.state[one] if same else UNDECIDED
    tree.cost[n] = max(tree.cost[one], tree.cost[other])
    tree.least[n] = min(tree.least[one], tree.least[other])
    tree.level[n] = max(tree.level[one], tree.level[other])


@kernel
def unite_all(tree, count):  # type: ignore[no-untyped-def]
    """Note of all nodes that are bisected what their halves have in common; these come later."""
    for n in range(count - 1, -1, -1):
        if tree.child[n] >= 0:
            unite(tree, n)


@kernel
def inherit(search, nodes, failed):  # type: ignore[no-untyped-def]
    """Give the halves of arriving nodes what is known of these, and note which it does not fit.

    The image of a half may reach beyond that of the whole, and meet what does not arrive as soon.
    """
    tree = search.tree
    for j in range(len(nodes)):
        b = nodes[j]
        for c in range(tree.child[b], tree.child[b] + 2):
            tree.state[c], tree.level[c] = ARRIVES, tree.level[b]
            tree.cost[c], tree.least[c] = tree.cost[b], tree.least[b]
    for j in range(len(nodes)):
        b = nodes[j]
        for c in range(tree.child[b], tree.child[b] + 2):
            met = meet(search, c, EVERY)
            if met.bits != MEETS_ARRIVING or met.level >= tree.level[b]:
                failed[j] = True


@kernel
def blame(tree, leaves, factor, share):  # type: ignore[no-untyped-def]
    """Add to the volume of leaves that of all whose upper bound is made of theirs.

    By powers of the factor, in reverse order of levels; ``share`` is by node.
    """
    for j in range(len(leaves) - 1, -1, -1):
        b = leaves[j]
        if tree.waits[b] >= 0:
            share[tree.waits[b]] += factor * share[b]

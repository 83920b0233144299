"""Levels and bounds of the cost of decided boxes, from those that their images meet; compiled."""

import numpy as np

from lmdsl.machine.kernels import kernel
from lmdsl.proof.search import ARRIVES, EVERY, MEETS_ARRIVING, UNDECIDED, meet

SLACK = (
    2.0**-40
)  # by how much bounds are loosened, relative: more than versions of functions differ


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

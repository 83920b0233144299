"""Which undecided boxes stay: the greatest set whose images meet nothing else; compiled."""

from lmdsl.machine.kernels import kernel
from lmdsl.proof.deciding.rounds import decide, wake
from lmdsl.proof.search import (
    ARRIVES,
    LEAVING,
    LOST,
    MEETS_ARRIVING,
    MEETS_LOST,
    MEETS_UNDECIDED,
    STAYS,
    UNDECIDED,
    depth,
    meet,
)

OUTSIDE = MEETS_ARRIVING | MEETS_LOST | MEETS_UNDECIDED


@kernel
def mark_inner(tree, mark, count):  # type: ignore[no-untyped-def]
    """Mark nodes with anything below them that is decided and does not stay; the rest 0."""
    for n in range(count):
        mark[n] = (tree.state[n] == ARRIVES) | (tree.state[n] == LOST)
    for n in range(count - 1, -1, -1):
        if mark[n] & (tree.parent[n] >= 0):
            mark[tree.parent[n]] = 1


@kernel
def _marked(tree, mark, n):  # type: ignore[no-untyped-def]
    """Mark a leaf and the nodes above it."""
    while n >= 0 and mark[n] == 0:
        mark[n] = 1
        n = tree.parent[n]


@kernel
def _spread(tree, mark, b, stack):  # type: ignore[no-untyped-def]
    """Mark a leaf, and all that wait for it, for those, and so on: they meet what is marked."""
    _marked(tree, mark, b)
    stack[0], size = b, 1
    while size > 0:
        size -= 1
        n = tree.waiting[stack[size]]
        while n >= 0:
            if (tree.child[n] < 0) & (tree.state[n] == UNDECIDED) & (mark[n] == 0):
                _marked(tree, mark, n)
                stack[size], size = n, size + 1
            n = tree.following[n]


@kernel
def leave(search, leaves, stack, most):  # type: ignore[no-untyped-def]
    """Mark undecided leaves that may leave the set of those not marked, until none does.

    Those that wait for nothing come first: what waits for them leaves with them. ``leaves`` keeps
    those that stay at its start; return their number, -1 after ``most`` searches.
    """
    tree, mark, n = search.tree, search.mark, len(leaves)
    for j in range(n):
        b = leaves[j]
        if (tree.waits[b] < 0) & (mark[b] == 0) and meet(search, b, LEAVING).bits & OUTSIDE:
            _spread(tree, mark, b, stack)
    sweep, made = 0, 0
    while made <= most:
        kept, sweep = 0, sweep + 1
        for j in range(n):
            b = leaves[j] if sweep % 2 == 0 else leaves[n - 1 - j]
            if mark[b]:
                continue
            made += 1
            if meet(search, b, LEAVING).bits & OUTSIDE:
                _spread(tree, mark, b, stack)
        for j in range(n):
            if mark[leaves[j]] == 0:
                leaves[kept], kept = leaves[j], kept + 1
        if kept == n:
            return n
        n = kept
    return -1


@kernel
def stay(tree, leaves, nodes, shares):  # type: ignore[no-untyped-def]
    """Decide that leaves stay; return how many that wait for them are in ``nodes``."""
    size = 0
    for j in range(len(leaves)):
        decide(tree, leaves[j], STAYS, 0)
        shares[STAYS] += 0.5 ** depth(tree, leaves[j])
    for j in range(len(leaves)):
        size = wake(tree, leaves[j], nodes, size)
    return size

"""Which undecided boxes to bisect: those for which most volume waits; compiled."""

from lmdsl.machine.kernels import kernel
from lmdsl.proof.search import UNDECIDED, depth

LARGEST, OTHER = -1, -2  # of a leaf in a circle of leaves that wait for each other


@kernel
def still(tree, leaves):  # type: ignore[no-untyped-def]
    """Put those leaves first that are undecided leaves still; return their number and volume."""
    count, volume = 0, 0.0
    for j in range(len(leaves)):
        n = leaves[j]
        if (tree.child[n] < 0) & (tree.state[n] == UNDECIDED):
            leaves[count], count = n, count + 1
            volume += 0.5 ** depth(tree, n)
    return count, volume


@kernel
def worth(tree, leaves, position, up, size, score, waiting, order):  # type: ignore[no-untyped-def]
    """Fill in for undecided leaves the volume that waits for them, themselves included.

    Those that wait for each other in a circle have the volume of all of it, and ``waiting`` is
    then LARGEST or OTHER, else 0. ``position`` is by node, the rest by leaf: ``up`` which leaf each
    waits for, ``size`` by how many bisections it is made.
    """
    n, first, last = len(leaves), 0, 0
    for j in range(n):
        b = leaves[j]
        position[b], size[j], waiting[j] = j, depth(tree, b), 0
        score[j] = 0.5 ** size[j]
    for j in range(n):
        w = tree.waits[leaves[j]]
        up[j] = position[w] if w >= 0 else -1
        if w >= 0:
            waiting[up[j]] += 1
    for j in range(n):
        if waiting[j] == 0:
            order[last], last = j, last + 1
    while first < last:
        j, first = order[first], first + 1
        w = up[j]
        if w >= 0:
            score[w] += score[j]
            waiting[w] -= 1
            if waiting[w] == 0:
                order[last], last = w, last + 1
    for j in range(n):
        if waiting[j] > 0:
            _circle(j, up, size, score, waiting)


@kernel
def _circle(j, up, size, score, waiting):  # type: ignore[no-untyped-def]
    """Give all leaves of a circle the score of it, and say which are the largest."""
    total, shallow, n = 0.0, size[j], j
    while True:
        total += score[n]
        shallow = min(shallow, size[n])
        n = up[n]
        if n == j:
            break
    while True:
        waiting[n] = LARGEST if size[n] == shallow else OTHER
        score[n] = total
        n = up[n]
        if n == j:
            break


@kernel
def able(tree, leaves, up, size, score, waiting, deepest, less, found):  # type: ignore[no-untyped-def]
    """List the leaves whose bisection may help, and their worth; return their number.

    ``less`` is what a score counts after so many bisections.
    """
    count = 0
    for j in range(len(leaves)):
        w, split = up[j], tree.split[leaves[j]]
        helps = (w < 0) | (waiting[j] == LARGEST)
        if not helps and waiting[j] == 0:
            helps = size[w] > size[j]
        deep = True
        for k in range(len(split)):
            deep &= split[k] >= deepest
        if helps & (not deep):
            score[count] = score[j] * less[size[j]]
            found[count], count = leaves[j], count + 1
    return count

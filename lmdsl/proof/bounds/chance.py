"""How likely runs arrive, with noise: proved lower bounds, box by box.

P = 1 on A, 0 where runs are lost; of every other box P(b) <= KEPT sum over parts of the noise of
(probability of the part) times (least P over what the images of b with this part meet). Then
P(x_0) <= E[KEPT^n P(x_n)] as long as the run has not ended, so that P(x_0) <= Pr(it enters A): what
has not ended by then counts KEPT^n at most, which tends to 0. Iterated from 0, P only grows.
"""

import math

import numpy as np

from lmdsl.common.types import Floats, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import kernel
from lmdsl.model.successors.compiled.places import BITS, MAY_ARRIVE, MAY_LEAVE
from lmdsl.problem.noise import NoiseNormal
from lmdsl.problem.problem import Problem
from lmdsl.proof.cover import Cover
from lmdsl.proof.prover import Prover
from lmdsl.proof.search import ARRIVES, depth, enter, inside, onward, root

KEPT = 1.0 - 2.0**-30  # what is left of a probability a step, when it is proved
CHECKED = 1.0 - 2.0**-31  # and when it is checked
GAIN = 1e-7  # mean growth in a pass below which P is as good as it gets
PASSES = 10_000
SOME = 2**16  # boxes between two looks at the clock


def weights(problem: Problem) -> tuple[Floats, bool]:
    """Return at most the probabilities of the parts of the noise, and whether it stays in these.

    Of a uniform variable parts are equal intervals, of a normal one of which a range is covered
    intervals, too: what lies outside counts as not arriving. Otherwise they are the nodes.
    """
    whole, total = True, np.ones(1)
    for noise in (problem.noise or {}).values():
        low, high = noise.parts()
        weight = noise.nodes()[1]
        weight = weight[weight > 0] / math.fsum(weight)
        if isinstance(noise, NoiseNormal) and noise.normal.within is not None:
            whole, scale = False, math.sqrt(2) * noise.normal.std
            ends = zip(low / scale, high / scale, strict=True)
            weight = np.array([0.5 * (math.erf(b) - math.erf(a)) for a, b in ends])
        total = np.multiply.outer(total, np.maximum(weight - 1e-15, 0.0)).ravel()
    return total, whole


def chances(prover: Prover, deadline: Deadline) -> Floats:
    """Return lower bounds of the probability to arrive by node, of the leaves of a cover."""
    cover, problem = prover.cover, prover.images.problem
    tree, leaves = cover.tree, cover.leaves()
    leaves = leaves[tree.images[leaves] > 0]
    weight, whole = weights(problem)
    chance = beginning(cover, leaves, np.where(tree.state[leaves] == ARRIVES, 1.0 * whole, 0.0))
    rest = leaves[(tree.state[leaves] != ARRIVES) | (not whole)]
    # what arrives sooner comes first
    rest = rest[np.argsort(np.where(tree.state[rest] == ARRIVES, tree.level[rest], 2**31 - 1))]
    for k in range(PASSES):
        order = rest if k % 2 == 0 else rest[::-1].copy()
        grown = 0.0
        for start in range(0, len(order), SOME):
            if deadline() and start + k > 0:
                return chance
            some = order[start : start + SOME]
            grown += grow(prover.search, cover.more, chance, some, weight)
        if grown <= GAIN * prover.volume:
            break
    return chance


def beginning(cover: Cover, leaves: Indices, of_leaves: Floats) -> Floats:
    """Return probabilities by node, of those of leaves."""
    tree = cover.tree
    chance: Floats = np.where(tree.state[: cover.count] == ARRIVES, 1.0, 0.0)
    chance[leaves] = of_leaves
    gather(tree, chance, cover.count)
    return chance


def unproved(prover: Prover, leaves: Indices, chance: Floats) -> Indices:
    """Return positions of leaves whose probability does not follow from those they meet."""
    weight, whole = weights(prover.images.problem)
    fault = np.zeros(len(leaves), dtype=np.bool_)
    find = prover.search
    doubt(find, prover.cover.more, beginning(prover.cover, leaves, chance), leaves, weight, fault)
    sure = whole & (prover.cover.tree.state[leaves] == ARRIVES)
    return np.flatnonzero((fault & ~sure) | ~((chance >= 0.0) & (chance <= 1.0)))


@kernel
def gather(tree, chance, count):  # type: ignore[no-untyped-def]
    """Fill in the least of both halves for nodes that are bisected."""
    for n in range(count - 1, -1, -1):
        if tree.child[n] >= 0:
            chance[n] = min(chance[tree.child[n]], chance[tree.child[n] + 1])


@kernel
def _sink(search, n, chance, least):  # type: ignore[no-untyped-def]
    """Return the least chance below a cell, or ``least``."""
    tree, stack = search.tree, search.stack
    low, high = search.odometer[3], search.odometer[4]
    stack[0], size = n, 1
    while size > 0:
        size -= 1
        n = stack[size]
        if chance[n] >= least:
            continue
        c = tree.child[n]
        if c < 0 or inside(tree, n, low, high):
            least = chance[n]
            continue
        axis = tree.axis[n]
        middle = np.int64(tree.place[c + 1, axis]) << (BITS - np.int64(tree.split[c + 1, axis]))
        if low[axis] < middle:
            stack[size], size = c, size + 1
        if high[axis] >= middle:
            stack[size], size = c + 1, size + 1
    return least


@kernel
def _least(search, image, chance, least):  # type: ignore[no-untyped-def]
    """Return the least chance of what an image meets, or ``least``."""
    enter(search, image)
    more = True
    while more & (least > 0.0):
        least = _sink(search, root(search, image), chance, least)
        more = onward(search)
    return least


@kernel
def value(search, more, chance, b, weight):  # type: ignore[no-untyped-def]
    """Return the probability that a node is worth, rounded down."""
    tree, parts, total = search.tree, len(weight), 0.0
    pieces = tree.images[b] // parts  # of a node at both ends of a circle
    for j in range(parts):
        least = 1.0
        for i in range(tree.first[b] + j * pieces, tree.first[b] + (j + 1) * pieces):
            image = search.places[i]
            nowhere = image[0, 0] > image[0, 1]  # it is absorbed on the way, or has left the box
            if (more[i] & MAY_LEAVE) | (nowhere & (more[i] & MAY_ARRIVE == 0)):
                least = 0.0
            elif nowhere:
                continue
            elif least > 0.0:
                least = _least(search, image, chance, least)
        total += weight[j] * least
    return total * (1.0 - (parts + 4.0) * 2.0**-52)


@kernel
def grow(search, more, chance, leaves, weight):  # type: ignore[no-untyped-def]
    """Let the chances of leaves grow once; return by how much in all, by volume."""
    tree, grown = search.tree, 0.0
    for j in range(len(leaves)):
        b = leaves[j]
        found = KEPT * value(search, more, chance, b, weight)
        if found <= chance[b]:
            continue
        grown += (found - chance[b]) * 0.5 ** depth(tree, b)
        chance[b] = found
        n = tree.parent[b]
        while n >= 0:
            least = min(chance[tree.child[n]], chance[tree.child[n] + 1])
            if least == chance[n]:
                break
            chance[n] = least
            n = tree.parent[n]
    return grown


@kernel
def doubt(search, more, chance, leaves, weight, fault):  # type: ignore[no-untyped-def]
    """Note which leaves have a chance that does not follow from those they meet."""
    for j in range(len(leaves)):
        b = leaves[j]
        fault[j] = not chance[b] <= CHECKED * value(search, more, chance, b, weight)

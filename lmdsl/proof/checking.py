"""Checking a proof box by box: nothing of how the boxes were found is used, or trusted.

The boxes must cover every cell of C exactly. The image of each is enclosed anew, and must meet what
its class says only, with levels and bounds that follow from those of the boxes it meets. By
induction over levels the theorems hold then, whatever made the boxes.
"""

from collections.abc import Callable

import numpy as np

from lmdsl.common.types import Bools, Guard, Indices
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.boxes import named
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.bounds import chance
from lmdsl.proof.bounds.optimum.averages import Arrays
from lmdsl.proof.cover import Cover, node_bytes
from lmdsl.proof.deciding.settling import stage_bounds, unite_all
from lmdsl.proof.images.entering import entered
from lmdsl.proof.images.pieces import DEEPEST
from lmdsl.proof.loop import Loop
from lmdsl.proof.prover import Prover
from lmdsl.proof.search import (
    ARRIVES,
    EVERY,
    LOST,
    MEETS_ARRIVING,
    MEETS_LOST,
    MEETS_STAYING,
    STAYS,
    meet,
)

SOME = 2**16  # boxes checked between two looks at the clock

FAULTS = {
    1: "is said to {kind}, but its image may meet something else",
    2: "is said to {kind} in {level} steps, but may take more",
    3: "is said to cost at most {cost!r}, but may cost more",
    4: "is said to cost at least {lower!r}, but may cost less",
    5: "has a level or a bound, but none follows from its class",
}
DOES = {ARRIVES: "arrive", LOST: "be lost", STAYS: "stay"}


def faults(loop: Loop, arrays: Arrays, guard: Guard, entry: Bools | None = None) -> list[str]:
    """Return what does not hold of the boxes of a proof, one sentence each; at most a few.

    In ``entry``, shape (N,), the attractor cells are marked that what arrives can enter.
    """
    partition, count = loop.partition, len(arrays["cell"])
    guard()
    images = loop.images(whole=loop.whole(Deadline()))
    each = node_bytes(partition.dimension, len(images.noise[0]))
    memory.require(each * (2.0 * count + partition.size), "the boxes of the proof")
    wrong = malformed(loop, arrays)
    if wrong:
        return [wrong]
    cover = Cover(partition, loop.status)
    cover.grow(2 * count)
    place = np.zeros(count, dtype=np.int64)
    if not _planted(cover, arrays, place):
        return ["proof.npz: the boxes do not cover the cells of C, each point once"]
    prover = Prover(cover, images, loop.factor, loop.entry(images), settle=False)
    tree = cover.tree
    for name, array in (
        ("state", "class"),
        ("level", "level"),
        ("cost", "cost"),
        ("least", "lower"),
    ):
        getattr(tree, name)[place] = arrays[array]
    unite_all(tree, cover.count)
    for start in range(0, count, SOME):
        guard()
        prover.enclose(place[start : start + SOME])
    if entry is not None:
        entry |= entered(cover, place[arrays["class"] == ARRIVES], loop.attractor)
    found = _judged(prover, arrays, place, guard)
    if found or "probability" not in arrays:
        return found
    guard()
    return [
        f"proof.npz: box {i} of {named(partition, int(arrays['cell'][i]))} is said to arrive with "
        f"a probability of at least {arrays['probability'][i].item()!r}, but it may be less"
        for i in chance.unproved(prover, place, arrays["probability"])[:3]
    ]


def malformed(loop: Loop, arrays: Arrays) -> str:
    """Return why arrays cannot be those of a proof, if they cannot."""
    cell, split, place = arrays["cell"], arrays["split"], arrays["place"]
    sound = (
        (np.diff(cell) >= 0).all()
        and ((cell >= 0) & (cell < loop.partition.size)).all()
        and (split <= DEEPEST).all()
        and (place.astype(np.float64) < 2.0**split).all()
        and (arrays["class"] <= STAYS).all()
        and (arrays["level"] >= 0).all()
        and not np.isnan(arrays["cost"]).any()
        and not np.isnan(arrays["lower"]).any()
    )
    if not sound:
        return "proof.npz: the boxes are not what lmdsl writes"
    inside = np.flatnonzero(loop.status == CellStatus.STABILIZED)
    if not np.array_equal(np.unique(cell), inside):
        return "proof.npz: the boxes do not cover the cells of C, each point once"
    return ""


def _planted(cover: Cover, arrays: Arrays, place: Indices) -> bool:
    """Make the tree that has the boxes as leaves; False where there is none."""
    cell = arrays["cell"]
    order = np.arange(len(cell))
    begin = np.flatnonzero(np.diff(cell, prepend=-1) != 0)
    end = np.append(begin[1:], len(cell))
    room = np.zeros((64 * cover.partition.dimension + 64, 3), dtype=np.int64)
    split, where = arrays["split"].astype(np.int64), arrays["place"].astype(np.int64)
    boxes = (order, split, where, cell)
    cover.count = int(plant_all(cover.tree, boxes, (begin, end), (cover.count, room), place))
    return cover.count >= 0


@kernel
def plant_all(tree, boxes, spans, free, leaf):  # type: ignore[no-untyped-def]
    """Make the nodes below cells, whose boxes stand together; see :func:`plant`."""
    count, room = free
    order, split, place, cell = boxes
    begin, end = spans
    for j in range(len(begin)):
        span = (cell[begin[j]], begin[j], end[j])
        count = plant(tree, (order, split, place), span, (count, room), leaf)
        if count < 0:
            return count
    return count


@kernel
def plant(tree, boxes, span, free, leaf):  # type: ignore[no-untyped-def]
    """Make the nodes below a cell of which some boxes are the leaves; return the nodes in use.

    A cell, or a half of it, is bisected along an axis that none of its boxes reaches across; so
    boxes that cover it, and no point twice, are found apart. -1 where they do not.
    """
    order, split, place = boxes
    cell, first, last = span
    count, stack = free
    d, size = split.shape[1], 1
    stack[0, 0], stack[0, 1], stack[0, 2] = cell, first, last
    while size > 0:
        size -= 1
        n, begin, end = stack[size, 0], stack[size, 1], stack[size, 2]
        axis = -1
        for k in range(d):
            s, able = np.int64(tree.split[n, k]), True
            for j in range(begin, end):
                able &= split[order[j], k] > s
            axis = k if able & (axis < 0) else axis
        if axis < 0:
            b = order[begin]
            if end - begin != 1:
                return -1
            for k in range(d):
                if split[b, k] != tree.split[n, k] or place[b, k] != tree.place[n, k]:
                    return -1
            leaf[b] = n
            continue
        middle = _parted(order, (split, place), (begin, end), axis, tree.split[n, axis])
        if (middle == begin) | (middle == end) | (count + 2 > len(tree.cell)):
            return -1
        tree.child[n], tree.axis[n] = count, axis
        for half in range(2):
            m = count + half
            tree.cell[m], tree.parent[m] = tree.cell[n], n
            for k in range(d):
                tree.split[m, k], tree.place[m, k] = tree.split[n, k], tree.place[n, k]
            tree.split[m, axis] += 1
            tree.place[m, axis] = 2 * tree.place[m, axis] + half
            stack[size, 0], stack[size, 1] = m, middle if half else begin
            stack[size, 2], size = end if half else middle, size + 1
        count += 2
    return count


@kernel
def _parted(order, boxes, span, axis, depth):  # type: ignore[no-untyped-def]
    """Put boxes of the lower half before those of the upper one; return where these begin."""
    split, place = boxes
    begin, end = span
    middle = begin
    for j in range(begin, end):
        b = order[j]
        if (place[b, axis] >> (split[b, axis] - np.int64(depth) - 1)) & 1 == 0:
            order[j], order[middle] = order[middle], b
            middle += 1
    return middle


def _judged(
    prover: Prover, arrays: Arrays, place: Indices, guard: Callable[[], object]
) -> list[str]:
    """Return what the boxes say that does not follow."""
    found: list[str] = []
    for start in range(0, len(place), SOME):
        guard()
        some = place[start : start + SOME]
        fault = np.zeros(len(some), dtype=np.int64)
        judge(prover.search, some, prover.factor, fault)
        for j in np.flatnonzero(fault)[:3]:
            i = start + int(j)
            said = {name: arrays[name][i].item() for name in ("level", "cost", "lower")}
            text = FAULTS[int(fault[j])].format(kind=DOES.get(int(arrays["class"][i]), ""), **said)
            cell = named(prover.cover.partition, int(arrays["cell"][i]))
            found.append(f"proof.npz: box {i} of {cell} {text}")
        if len(found) >= 3:
            break
    return found


@kernel
def judge(search, nodes, factor, fault):  # type: ignore[no-untyped-def]
    """Fill in what is wrong with what is said of nodes: a key of FAULTS, 0 where nothing is."""
    tree = search.tree
    for j in range(len(nodes)):
        b = nodes[j]
        state = tree.state[b]
        if state != ARRIVES and (tree.cost[b] != 0.0 or tree.least[b] != 0.0):
            fault[j] = 5
        if state != ARRIVES and state != LOST:
            fault[j] = 5 if tree.level[b] != 0 else fault[j]
            if state != STAYS:
                continue
        met = meet(search, b, EVERY)
        wanted = MEETS_ARRIVING if state == ARRIVES else MEETS_LOST
        wanted = MEETS_STAYING if state == STAYS else wanted
        if met.bits != wanted:
            fault[j] = 1
        elif state != STAYS and tree.level[b] <= met.level:
            fault[j] = 2
        elif state == ARRIVES:
            cost, least = stage_bounds(tree, b, met, factor, 2.0**-50)
            if not tree.cost[b] >= cost:
                fault[j] = 3
            elif not tree.least[b] <= least:
                fault[j] = 4

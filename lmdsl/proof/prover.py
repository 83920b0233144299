"""Proving: bisect where it helps, until enough of C is decided.

Images of boxes are enclosed, the fixed points of settling.py decide boxes, and those undecided
boxes are bisected for which most volume waits, large ones first.
"""

from collections.abc import Callable

import numpy as np

from lmdsl.common.types import Floats, Indices, Progress
from lmdsl.machine import memory
from lmdsl.machine.deadline import Deadline
from lmdsl.proof import settling
from lmdsl.proof.cover import Cover, node_bytes
from lmdsl.proof.images.seen import BoxImages, deep
from lmdsl.proof.search import UNDECIDED, Search, tally

DEEP_FIRST = 0.75  # by how many halvings of its volume a score counts half as much
EQUAL = 0.5  # share of the best score that is as good
FEWEST = 0.03  # least share of the undecided leaves that is bisected at a time
MOST = 2**18  # most leaves that are bisected at a time
LOOK_AGAIN = 1.5  # growth of the undecided leaves after which those that stay are looked for
HELPED = 0.99  # share of what was undecided, above which bisecting has not helped
IN_VAIN, FEW = 32, 50_000  # by how many times the undecided boxes may grow in vain, and from what
SWEEPS = 20  # looks at each undecided leaf after which the search for those that stay is given up


class Prover:
    """The state of a proof.

    Parameters
    ----------
    cover, images
        The boxes, and what encloses their images.
    factor
        What the cost after a step counts: gamma, times the discount.
    entry
        The attractor cells, and bounds of what is paid on entering each.
    settle
        Whether to begin with the cells of C.
    """

    def __init__(
        self, cover: Cover, images: BoxImages, factor: float,
        entry: tuple[Indices, Floats, Floats], settle: bool = True,
    ) -> None:  # fmt: skip
        self.cover, self.images, self.factor = cover, images, factor
        targets, least, most = entry
        self.entry = np.array([least.min(initial=np.inf), most.max(initial=-np.inf)])
        d = cover.partition.dimension
        self._stack, self._odometer = np.zeros(0, dtype=np.int64), np.zeros((5, d), dtype=np.int64)
        self._path = np.zeros(64 * (d + 1), dtype=np.int64)
        self._mark = np.zeros(0, dtype=np.uint8)
        self._looked = 0
        tree = cover.tree
        tree.cost[targets], tree.least[targets] = most, least
        self.volume = float((tree.state[: cover.count] == UNDECIDED).sum())  # of C, in cells
        if settle:
            self.add(np.flatnonzero(tree.state[: cover.count] == UNDECIDED))

    @property
    def search(self) -> Search:
        """What searches need, of the arrays as they are now."""
        cover, partition = self.cover, self.cover.partition
        if len(self._stack) < len(cover.tree.cell):
            self._stack = np.zeros(len(cover.tree.cell), dtype=np.int64)
            self._mark = np.zeros(len(cover.tree.cell), dtype=np.uint8)
        stride = np.array([axis.stride for axis in partition.axes]).astype(np.int64)
        return Search(
            cover.tree, cover.places, partition.cells, stride, self.entry, self._path,
            self._odometer, self._mark,
        )  # fmt: skip

    def enclose(self, nodes: Indices) -> None:
        """Enclose the images of leaves."""
        tree = self.cover.tree
        if len(nodes):
            seen = self.images(tree.cell[nodes], tree.split[nodes], tree.place[nodes])
            count = np.bincount(seen.owner, minlength=len(nodes))
            tree.first[nodes], tree.images[nodes] = self.cover.keep(count), count
            self.cover.places[self.cover.used - len(seen.owner) : self.cover.used] = seen.place
            tree.flags[nodes], tree.axis[nodes] = seen.flags, seen.axis
            tree.dearest[nodes], tree.cheapest[nodes] = seen.dearest, seen.cheapest

    def add(self, nodes: Indices, bisected: Indices | None = None) -> None:
        """Enclose the images of new leaves, and decide what can be decided.

        What waited for the leaves that were ``bisected`` is looked at anew.
        """
        self.enclose(nodes)
        find, size = self.search, 0
        if bisected is not None:
            size = settling.wake_all(find.tree, bisected, self._stack)
        self._stack[size : size + len(nodes)] = nodes[::-1]
        settling.settle(find, self._stack, size + len(nodes), self.factor)

    def room(self, bisected: int) -> bool:
        """Return whether there is memory to bisect so many leaves, arrays made anew included."""
        cover = self.cover
        each = node_bytes(cover.partition.dimension, len(self.images.noise[0]))
        return memory.fits(2.0 * each * (2 * bisected + cover.count))

    def undecided(self, leaves: Indices) -> Indices:
        """Return which of some leaves are undecided still."""
        tree = self.cover.tree
        return np.asarray(leaves[(tree.child[leaves] < 0) & (tree.state[leaves] == UNDECIDED)])

    def shares(self) -> Floats:
        """Return the shares of the volume of C by state."""
        volume = np.zeros(4)
        tally(self.cover.tree, self.cover.count, volume)
        return np.asarray(volume / max(self.volume, 1.0))

    def chosen(self, leaves: Indices) -> Indices:
        """Return the undecided leaves that are to be bisected now."""
        tree, count = self.cover.tree, self.cover.count
        volume = self.cover.volume(leaves)
        score, waiting = np.zeros(count), np.zeros(count, dtype=np.int32)
        order = np.zeros(len(leaves), dtype=np.int64)
        settling.worth(tree, leaves, volume, order, score, waiting)
        worth = score[leaves] * volume**DEEP_FIRST
        waits = tree.waits[leaves]
        smaller = self.cover.volume(np.maximum(waits, 0)) < volume
        circle = waiting[leaves]
        able = (waits < 0) | (circle == settling.LARGEST) | ((circle == 0) & smaller)
        worth[~able | deep(tree.split[leaves])] = 0.0
        best = worth.max(initial=0.0)
        if best <= 0.0:
            return leaves[:0]
        least = EQUAL * best
        fewest = min(max(int(FEWEST * len(leaves)), 1), int((worth > 0).sum()))
        if (worth >= least).sum() < fewest:
            least = np.partition(worth, -fewest)[-fewest]
        found = np.flatnonzero((worth >= least) & (worth > 0))
        return leaves[found[np.argsort(-worth[found], kind="stable")[:MOST]]]

    def look_for_staying(self, leaves: Indices) -> None:
        """Decide which undecided leaves stay: the greatest set that none of them leaves."""
        find, left = self.search, leaves.copy()
        settling.mark_inner(find.tree, find.mark, self.cover.count)
        kept = settling.leave(find, left, SWEEPS * len(left) + FEW)
        if kept > 0:
            size = settling.stay(find, left[:kept], self._stack)
            settling.settle(find, self._stack, size, self.factor)

    def run(
        self, enough: Callable[[Floats], bool], deadline: Deadline, progress: Progress | None
    ) -> None:
        """Bisect until enough is decided, nothing helps, or time or memory is used up."""
        cover, leaves = self.cover, self.undecided(self.cover.leaves())
        self._looked = len(leaves)
        self.look_for_staying(leaves)
        seen, boxes = np.inf, FEW  # the undecided share when bisecting last helped
        while True:
            leaves = self.undecided(leaves)
            if len(leaves) > LOOK_AGAIN * self._looked:
                self._looked = len(leaves)
                self.look_for_staying(leaves)
                leaves = self.undecided(leaves)
            open_ = float(cover.volume(leaves).sum()) / max(self.volume, 1.0)
            if progress is not None:
                progress("prove", 1.0 - open_)
            if not len(leaves) or deadline() or enough(self.shares()):
                break
            if open_ < HELPED * seen:
                seen, boxes = open_, max(len(leaves), FEW)
            elif len(leaves) > IN_VAIN * boxes:
                break
            some = self.chosen(leaves)
            if not len(some) or not self.room(len(some)):
                break
            new = cover.bisect(some)
            self.add(new, some)
            leaves = np.concatenate([leaves, new])
        self.look_for_staying(self.undecided(leaves))

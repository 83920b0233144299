"""Proving: bisect where it helps, until enough of C is decided.

Images of boxes are enclosed, the fixed points of deciding/ decide boxes, and those undecided boxes
are bisected for which most volume waits, large ones first.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Progress
from lmdsl.machine import memory, threads
from lmdsl.machine.deadline import Deadline
from lmdsl.proof.cover import Cover, node_bytes
from lmdsl.proof.deciding import choosing, rounds, staying
from lmdsl.proof.images.pieces import DEEPEST
from lmdsl.proof.images.seen import BoxImages
from lmdsl.proof.search import UNDECIDED, Search, tally

DEEP_FIRST = 0.5  # by how many halvings of its volume a score counts half as much
EQUAL = 0.5  # share of the best score that is as good
FEWEST = 0.03  # least share of the undecided leaves that is bisected at a time
MOST = 2**18  # most leaves that are bisected at a time
LOOK_AGAIN = 1.5  # growth of the undecided leaves after which those that stay are looked for
HELPED = 0.99  # share of what was undecided, above which bisecting has not helped
IN_VAIN, FEW = 32, 50_000  # by how many times the undecided boxes may grow in vain, and from what
ALONE = 2**10  # most leaves that one thread looks at by itself
PART = 2**11  # leaves that a thread looks at at a time
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
        self._mark = np.zeros(0, dtype=np.uint8)
        # nodes to look at now, those to look at next, what was found
        self._room: list[NDArray[np.int32]]
        self._looked, self._level = 0, 0
        self._shares = np.zeros(4)  # of volume, in cells, of what was decided by state
        tree = cover.tree
        tree.cost[targets], tree.least[targets] = most, least
        self.volume = float((tree.state[: cover.count] == UNDECIDED).sum())  # of C, in cells
        if settle:
            rounds.renew(tree, self.cover.count)
            self.add(np.flatnonzero(tree.state[: cover.count] == UNDECIDED))

    @property
    def search(self) -> Search:
        """What searches need, of the arrays as they are now."""
        cover, partition, nodes = self.cover, self.cover.partition, len(self.cover.tree.cell)
        if len(self._mark) < nodes:
            self._mark = np.zeros(nodes, dtype=np.uint8)
            self._room = [np.zeros(nodes, dtype=np.int32) for _ in range(3)]
        stride = np.array([axis.stride for axis in partition.axes]).astype(np.int64)
        d = partition.dimension
        return Search(
            cover.tree, cover.places, partition.cells, stride, self.entry,
            np.zeros(64 * (d + 1), dtype=np.int64), np.zeros((5, d), dtype=np.int64), self._mark,
        )  # fmt: skip

    def enclose(self, nodes: Indices) -> None:
        """Enclose the images of leaves."""
        tree = self.cover.tree
        if len(nodes):
            seen = self.images(tree.cell[nodes], tree.split[nodes], tree.place[nodes])
            count = np.bincount(seen.owner, minlength=len(nodes))
            tree.first[nodes], tree.images[nodes] = self.cover.keep(count), count
            at = slice(self.cover.used - len(seen.owner), self.cover.used)
            self.cover.places[at], self.cover.more[at] = seen.place, seen.more
            tree.flags[nodes], tree.axis[nodes] = seen.flags, seen.axis
            tree.dearest[nodes], tree.cheapest[nodes] = seen.dearest, seen.cheapest
            rounds.pack_all(tree, nodes)

    def add(self, nodes: Indices, bisected: Indices | None = None) -> None:
        """Enclose the images of new leaves, and decide what can be decided.

        What waited for the leaves that were ``bisected`` is looked at anew.
        """
        self.enclose(nodes)
        find, size = self.search, len(nodes)
        first = self._room[0]
        first[:size] = nodes
        if bisected is not None:
            size += rounds.wake_all(find.tree, bisected, first[size:])
        self._settle(find, size)

    def _settle(self, find: Search, size: int) -> None:
        """Look at so many nodes that are listed first, and at what these wake."""
        while True:
            size, self._level = rounds.settle(
                find, tuple(self._room), size, self._shares, self._level, ALONE
            )
            if not size:
                break
            nodes, after, found = self._room
            if 4 * size > self.cover.partition.size:
                start = np.zeros(self.cover.partition.size, dtype=np.int32)
                rounds.arrange(find.tree, nodes[:size], after, start)
                nodes, after = after, nodes
            self._seek(nodes[:size], found)
            self._level += 1
            size = rounds.note(find, nodes[:size], found, after, self._shares, self._level)
            self._room = [after, nodes, found]

    def _seek(self, nodes: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Look at nodes; several threads work."""

        def some(start: int) -> None:
            at = slice(start, start + PART)
            rounds.seek(self.search, nodes[at], found[at])

        threads.each(some, range(0, len(nodes), PART))

    def room(self, bisected: int) -> bool:
        """Return whether there is memory to bisect so many leaves, arrays made anew included."""
        cover, parts = self.cover, len(self.images.noise[0])
        images = cover.used + 4 * bisected * parts  # two each at the seam of a circle
        if cover.count + 2 * bisected <= len(cover.tree.cell) and images <= len(cover.places):
            return True  # none is needed
        each = node_bytes(cover.partition.dimension, parts)
        return memory.fits(2.0 * each * (2 * bisected + cover.count))

    def undecided(self, leaves: Indices) -> Indices:
        """Return which of some leaves are undecided still."""
        tree = self.cover.tree
        return np.asarray(leaves[(tree.child[leaves] < 0) & (tree.state[leaves] == UNDECIDED)])

    def _still(self, leaves: Indices) -> tuple[Indices, float]:
        """Return those of some leaves that are undecided still, and their volume, in cells."""
        count, volume = choosing.still(self.cover.tree, leaves)
        self._shares[UNDECIDED] = volume
        return leaves[:count], volume

    def shares(self) -> Floats:
        """Return the shares of the volume of C by state."""
        volume = np.zeros(4)
        tally(self.cover.tree, self.cover.count, volume)
        return np.asarray(volume / max(self.volume, 1.0))

    def chosen(self, leaves: Indices) -> Indices:
        """Return the undecided leaves that are to be bisected now."""
        tree, count = self.cover.tree, len(leaves)
        up, size, waiting, order = (np.empty(count, dtype=np.int32) for _ in range(4))
        score = np.empty(count)
        choosing.worth(tree, leaves, self._room[0], up, size, score, waiting, order)
        less = 0.5 ** (DEEP_FIRST * np.arange(DEEPEST * self.cover.partition.dimension + 1))
        able = choosing.able(tree, leaves, up, size, score, waiting, DEEPEST, less, order)
        worth, found = score[:able], order[:able].astype(np.int64)
        if not able:
            return leaves[:0]
        least = EQUAL * worth.max()
        fewest = min(max(int(FEWEST * count), 1), able)
        if (worth >= least).sum() < fewest:
            least = np.partition(worth, -fewest)[-fewest]
        good = np.flatnonzero(worth >= least)
        if len(good) > MOST:
            good = good[np.argsort(-worth[good], kind="stable")[:MOST]]
        return np.asarray(found[good])

    def look_for_staying(self, leaves: Indices) -> None:
        """Decide which undecided leaves stay: the greatest set that none of them leaves."""
        find, left = self.search, leaves.copy()
        staying.mark_inner(find.tree, find.mark, self.cover.count)
        kept = staying.leave(find, left, self._room[0], SWEEPS * len(left) + FEW)
        if kept > 0:
            size = staying.stay(find.tree, left[:kept], self._room[0], self._shares)
            self._settle(find, size)

    def run(
        self, enough: Callable[[Floats], bool], deadline: Deadline, progress: Progress | None
    ) -> None:
        """Bisect until enough is decided, nothing helps, or time or memory is used up."""
        cover, leaves = self.cover, self.undecided(self.cover.leaves())
        rounds.renew(cover.tree, cover.count)
        self._level = max(self._level, int(cover.tree.level.max()))
        self._shares, whole = self.shares() * self.volume, max(self.volume, 1.0)
        self._looked = len(leaves)
        self.look_for_staying(leaves)
        seen, boxes = np.inf, FEW  # the undecided share when bisecting last helped
        while True:
            leaves, volume = self._still(leaves)
            if len(leaves) > LOOK_AGAIN * self._looked:
                self._looked = len(leaves)
                self.look_for_staying(leaves)
                leaves, volume = self._still(leaves)
            open_ = volume / whole
            if progress is not None:
                progress("prove", 1.0 - open_)
            if not len(leaves) or deadline() or enough(self._shares / whole):
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

"""The cover: boxes in a tree below every cell, their images, and what is known of them.

Nodes 0 to N - 1 are the cells; those of C are bisected where it helps, the others are what they
are. A node is the part ``place`` of 2^``split`` equal parts of its cell, by axis. The outer faces
of a cell include the margin in which states may lie that are located in it; the first cell of a
circle has states at both ends of the axis, and so have its first boxes.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices, Statuses
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.deciding.rounds import halve
from lmdsl.proof.search import ARRIVES, LOST, UNDECIDED, measure


class Tree(NamedTuple):
    """Arrays by node, the first ``count`` of which are in use.

    Attributes
    ----------
    cell, parent, child
        Cell, node above (-1: none) and first of the two nodes below (-1: a leaf).
    axis
        Along which it is or would be bisected.
    way
        Shape (nodes, 2), what a search for undecided leaves reads: of an undecided node that is
        bisected, child * 16 + axis and the place of its middle; of others -1 less the state and,
        packed, first, images and flags.
    split, place
        Shape (nodes, d): see the module.
    state, flags
        What is known of it; what its images may do besides meeting cells (places.py).
    level, cost, least
        Steps to the attractor, or to the loss; bounds of the cost from there.
    dearest, cheapest
        Bounds of the stage cost on it.
    first, images
        Position of its images in the store, and their number.
    waits, waiting, following
        Undecided leaf that it waits for (-1: none); first of those that wait for it, and the next
        of those that wait for the same.
    """

    cell: NDArray[np.int32]
    parent: NDArray[np.int32]
    child: NDArray[np.int32]
    axis: NDArray[np.int8]
    way: NDArray[np.int64]
    split: NDArray[np.uint8]
    place: NDArray[np.uint32]
    state: NDArray[np.uint8]
    flags: NDArray[np.uint8]
    level: NDArray[np.int32]
    cost: Floats
    least: Floats
    dearest: Floats
    cheapest: Floats
    first: NDArray[np.int64]
    images: NDArray[np.int32]
    waits: NDArray[np.int32]
    waiting: NDArray[np.int32]
    following: NDArray[np.int32]


_KINDS = {
    "cell": "i4", "parent": "i4", "child": "i4", "axis": "i1", "way": "i8", "split": "u1",
    "place": "u4", "state": "u1", "flags": "u1", "level": "i4", "cost": "f8", "least": "f8",
    "dearest": "f8", "cheapest": "f8", "first": "i8", "images": "i4", "waits": "i4",
    "waiting": "i4", "following": "i4",
}  # fmt: skip
_WIDE = {"way": 2}  # entries a node; of others one, or one an axis
_NONE = ("way", "parent", "child", "waits", "waiting", "following")


def node_bytes(d: int, images: int) -> int:
    """Return the bytes of a node with so many images."""
    return 130 + 5 * d + (16 * d + 1) * images


class Cover:
    """The nodes of a proof.

    Attributes
    ----------
    partition
        The cells.
    tree, places, more
        The nodes, the places of their images, shape (images, d, 2), and what these may do besides.
    count, used
        Number of nodes and of images.
    """

    def __init__(self, partition: Partition, status: Statuses) -> None:
        self.partition, N, d = partition, partition.size, partition.dimension
        self.tree = self._empty(max(2 * N, 1024))
        self.places = np.zeros((max(N, 1024), d, 2), dtype=np.int64)
        self.more = np.zeros(len(self.places), dtype=np.uint8)
        self.count, self.used = N, 0
        tree = self.tree
        tree.cell[:N] = np.arange(N)
        state = np.full(N, LOST, dtype=np.uint8)
        state[status == CellStatus.ATTRACTOR] = ARRIVES
        state[status == CellStatus.STABILIZED] = UNDECIDED
        tree.state[:N] = state

    def _empty(self, size: int) -> Tree:
        d = self.partition.dimension
        arrays: dict[str, Any] = {}
        for name, kind in _KINDS.items():
            shape = (size, d) if name in ("split", "place") else (size,)
            shape = (size, _WIDE[name]) if name in _WIDE else shape
            arrays[name] = np.full(shape, -1 if name in _NONE else 0, dtype=kind)
        return Tree(**arrays)

    def leaves(self) -> Indices:
        """Return the nodes that are not bisected."""
        return np.flatnonzero(self.tree.child[: self.count] < 0)

    def volume(self, nodes: Indices) -> Floats:
        """Return volumes of nodes, in cells."""
        volume = np.empty(len(nodes))
        measure(self.tree, nodes, volume)
        return volume

    def grow(self, more: int) -> None:
        """Make room for nodes."""
        if self.count + more > len(self.tree.cell):
            size = max(self.count + more, len(self.tree.cell) * 3 // 2)
            larger = self._empty(size)
            for name in _KINDS:
                getattr(larger, name)[: self.count] = getattr(self.tree, name)[: self.count]
            self.tree = larger

    def bisect(self, nodes: Indices) -> Indices:
        """Bisect leaves along their axes; return the new nodes."""
        self.grow(2 * len(nodes))
        halve(self.tree, nodes, self.count)
        self.count += 2 * len(nodes)
        return np.arange(self.count - 2 * len(nodes), self.count)

    def keep(self, count: Indices) -> Indices:
        """Make room for images; return the position of the first of each."""
        first = self.used + np.concatenate([[0], np.cumsum(count)])
        total = int(first[-1])
        if total > len(self.places):
            larger = np.empty((max(total, len(self.places) * 3 // 2), *self.places.shape[1:]),
                              dtype=np.int64)  # fmt: skip
            larger[: self.used] = self.places[: self.used]
            self.places = larger
            self.more = np.append(self.more, np.zeros(len(larger) - len(self.more), dtype=np.uint8))
        self.used = total
        return np.asarray(first[:-1])

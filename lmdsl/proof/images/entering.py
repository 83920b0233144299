"""Which attractor cells what arrives can enter: whether it then stays is a question of these."""

import numpy as np

from lmdsl.common.types import Bools, Indices
from lmdsl.machine.kernels import kernel
from lmdsl.model.successors.compiled.places import BITS, MAY_ARRIVE
from lmdsl.proof.cover import Cover


def entered(cover: Cover, nodes: Indices, attractor: Bools) -> Bools:
    """Return the attractor cells in which a step from nodes can end, shape (N,).

    Where a path may enter the attractor on its way, these are all.
    """
    tree, partition = cover.tree, cover.partition
    if (tree.flags[nodes] & MAY_ARRIVE).any():
        return attractor.copy()
    stride = np.array([axis.stride for axis in partition.axes]).astype(np.int64)
    met = np.zeros(partition.size, dtype=np.bool_)
    _enter(tree, cover.places, (partition.cells, stride), nodes, met)
    return met & attractor


@kernel(allocates=True)
def _enter(tree, places, axes, nodes, met):  # type: ignore[no-untyped-def]
    """Mark the cells that images of nodes meet."""
    cells, stride = axes
    d = len(cells)
    at = np.zeros(d, dtype=np.int64)
    for j in range(len(nodes)):
        b = nodes[j]
        for i in range(tree.first[b], tree.first[b] + tree.images[b]):
            image = places[i]
            if image[0, 0] > image[0, 1]:
                continue  # nothing of it is in the box
            for k in range(d):
                at[k] = image[k, 0] >> BITS
            k = 0
            while k >= 0:
                root = 0
                for m in range(d):
                    root += (at[m] % cells[m]) * stride[m]
                met[root] = True
                k = d - 1
                while k >= 0:
                    at[k] += 1
                    if at[k] <= image[k, 1] >> BITS:
                        break
                    at[k] = image[k, 0] >> BITS
                    k -= 1

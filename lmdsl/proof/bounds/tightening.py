"""Tighter bounds of the cost: boxes that arrive are bisected where their bounds are loose."""

import time
from collections.abc import Callable

import numpy as np

from lmdsl.common.types import Floats, Indices, Progress
from lmdsl.machine.deadline import Deadline
from lmdsl.proof.deciding import settling
from lmdsl.proof.images.seen import deep
from lmdsl.proof.prover import Prover
from lmdsl.proof.search import ARRIVES

CLOSE = 0.05  # part of the upper bound that the lower one may lack: then it is tight enough
HALF = 0.5  # of all that is loose, the part that is bisected at a time
FEWEST, MOST = 0.1, 0.5  # parts of all boxes: of which so many are bisected at a time


def tighten(
    prover: Prover, enough: Callable[[int], bool], deadline: Deadline, progress: Progress | None
) -> None:
    """Bisect arriving boxes until their mean bounds are close, or there are enough boxes."""
    cover = prover.cover
    whole = np.zeros(0, dtype=np.int64)  # leaves whose halves are not proved to arrive as soon
    began = time.monotonic()
    while True:
        leaves = arriving(prover)
        torn = np.zeros(len(leaves))
        settling.refine(prover.search, leaves, prover.factor, torn)
        tree = cover.tree
        volume = cover.volume(leaves)
        low, high = ((volume * ends[leaves]).sum() for ends in (tree.least, tree.cost))
        gap = (high - low) / high if 0 < high < np.inf else 0.0
        if progress is not None:
            progress("tighten", min(1.0, CLOSE / max(gap, CLOSE)))
        began, taken = time.monotonic(), time.monotonic() - began
        late = deadline.left is not None and deadline.left < taken
        if gap <= CLOSE or enough(len(leaves)) or late or not prover.room(len(leaves)):
            break
        torn[np.isin(leaves, whole)] = 0.0
        some = _loose(prover, leaves, volume, torn)
        if not len(some):
            break
        whole = np.concatenate([whole, _bisect(prover, some)])


def arriving(prover: Prover) -> Indices:
    """Return the leaves that arrive, by level."""
    tree = prover.cover.tree
    leaves = prover.cover.leaves()
    leaves = leaves[(tree.images[leaves] > 0) & (tree.state[leaves] == ARRIVES)]
    return np.asarray(leaves[np.argsort(tree.level[leaves], kind="stable")])


def _loose(prover: Prover, leaves: Indices, volume: Floats, torn: Floats) -> Indices:
    """Return the leaves by which most of the mean upper bound may be lowered."""
    cover = prover.cover
    share = np.zeros(cover.count)
    share[leaves] = volume
    settling.blame(cover.tree, leaves, prover.factor, share)
    loose = share[leaves] * torn
    loose[deep(cover.tree.split[leaves]) | ~np.isfinite(loose)] = 0.0
    order = np.argsort(-loose, kind="stable")
    total = np.cumsum(loose[order])
    count = int(np.searchsorted(total, HALF * total[-1])) + 1 if total[-1] > 0 else 0
    fewest, most = (int(part * len(leaves)) + 1 for part in (FEWEST, MOST))
    count = min(max(count, fewest), most, int((loose > 0).sum()))
    return np.asarray(leaves[order[:count]])


def _bisect(prover: Prover, nodes: Indices) -> Indices:
    """Bisect arriving leaves; return where it was taken back: halves are not proved to arrive."""
    prover.enclose(prover.cover.bisect(nodes))
    tree, failed = prover.cover.tree, np.zeros(len(nodes), dtype=np.bool_)
    settling.inherit(prover.search, nodes, failed)
    gone = (tree.child[nodes[failed]][:, None] + np.arange(2)).ravel()
    tree.images[gone], tree.parent[gone] = 0, -1
    tree.child[nodes[failed]] = -1
    return np.asarray(nodes[failed])

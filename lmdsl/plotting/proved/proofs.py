"""What is proved of the true map, box by box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.types import Bools, Indices, Statuses
from lmdsl.errors import BadInput
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.plotting import layers, regions
from lmdsl.plotting.quantities import codes_of, view_of
from lmdsl.plotting.view import At, View
from lmdsl.proof.record import Proof
from lmdsl.proof.search import ARRIVES, LOST, STAYS, UNDECIDED
from lmdsl.results.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What becomes of boxes: name and colour, those last that are drawn over the others.
KINDS = {
    ARRIVES: ("arrives", "#a6cee3"),
    UNDECIDED: ("undecided", "#222222"),
    STAYS: ("stays elsewhere", "#ff8c00"),
    LOST: ("lost", "#d7301f"),
}
PIXELS = 1600  # most pixels an axis, but for one a cell
NOTHING = 4  # where there is no box


@own_arithmetic
def proof(
    result: Result,
    proof: Proof,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    legend: bool = True,
) -> Axes:
    """Draw what is proved of the true map: what arrives, is lost, stays elsewhere, is undecided.

    Boxes that are smaller than a pixel fill it; what arrives is then drawn below the rest.

    Parameters
    ----------
    result
        The result of which ``proof`` is a proof.
    proof
        What :meth:`Result.prove` returns.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where the others are held.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    BadInput
        The proof is of another result.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    inputs.kind(proof, Proof, "proof", "what Result.prove returns")
    view = view_of(result, axes, at)
    if proof.split.shape[1] != result.partition.dimension or (
        len(proof.cell) and proof.cell.max() >= result.partition.size
    ):
        raise BadInput("it is a proof of another result", "proof")
    drawn: Axes = layers.frame(ax, view, "proved of the true map" + view.note)
    pixels = painted(view, proof)
    colours = ListedColormap([KINDS[kind][1] for kind in range(NOTHING)])
    picture = layers.image(drawn, view, np.where(pixels < NOTHING, pixels, np.nan), colours)
    picture.set_clim(-0.5, NOTHING - 0.5)
    if len(view.axes) == 1:
        drawn.set_ylim(0, 1)
        drawn.set_yticks([])
    regions.regions(drawn, view, codes_of(result), False)
    if legend:
        there = [kind for kind in KINDS if (pixels == kind).any()]
        handles = [Patch(facecolor=KINDS[kind][1], label=KINDS[kind][0]) for kind in there]
        drawn.legend(
            handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncol=2, frameon=False,
            fontsize=8,
        )  # fmt: skip
    return drawn


def painted(view: View, proof: Proof) -> Statuses:
    """Return pixels of boxes in the order of the axes shown, a power of two for every cell."""
    partition, axes = view.partition, list(view.axes)
    cells = partition.cells[axes]
    deepest = proof.split[:, axes].max(axis=0, initial=0)
    room = np.maximum(np.log2(PIXELS / cells).astype(np.int64), 0)
    fine = np.minimum(deepest, room).astype(np.int64)
    shape = (cells << fine).tolist()
    pixels = np.full((*shape, 1) if len(axes) == 1 else shape, NOTHING, dtype=np.uint8)
    seen = _cut(view, proof)
    index = np.stack(partition.multi_index(proof.cell[seen]), axis=-1)[:, axes]
    split, place = (array[seen][:, axes].astype(np.int64) for array in (proof.split, proof.place))
    over = split - fine  # bisections that a pixel does not show
    first = (index << fine) + np.where(
        over > 0, place >> np.maximum(over, 0), place << np.maximum(-over, 0)
    )
    size = 1 << np.maximum(-over, 0)
    kind = proof.kind[seen]
    for state in KINDS:
        _fill(pixels, first[kind == state], size[kind == state], state)
    return pixels


def _cut(view: View, proof: Proof) -> Bools:
    """Return which boxes a slice through the middle of its cells meets."""
    met = np.ones(len(proof.cell), dtype=np.bool_)
    index = view.partition.multi_index(proof.cell)
    for k in view.hidden:
        middle = np.where(proof.split[:, k] > 0, (1 << proof.split[:, k].astype(np.int64)) >> 1, 0)
        met &= (index[k] == view.cell[k]) & (proof.place[:, k] == middle)
    return met


def _fill(pixels: Statuses, first: Indices, size: Indices, state: int) -> None:
    """Fill rectangles of pixels; those of the same size at once."""
    for sides in np.unique(size, axis=0):
        corner = first[(size == sides).all(axis=1)]
        across = [np.arange(side) for side in sides]
        if len(sides) == 1:
            pixels[(corner[:, :1] + across[0]).ravel(), 0] = state
            continue
        x = corner[:, 0, None, None] + across[0][None, :, None]
        y = corner[:, 1, None, None] + across[1][None, None, :]
        pixels[x, y] = state

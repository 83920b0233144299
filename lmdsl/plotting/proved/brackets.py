"""Maps of what is proved of the least cost of any control law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lmdsl.common import inputs
from lmdsl.errors import BadInput, shown
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.plotting import layers, regions
from lmdsl.plotting.quantities import codes_of, view_of
from lmdsl.plotting.view import At
from lmdsl.proof.record import Proof
from lmdsl.results.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WORDS = {
    "below": "any control law costs at least",
    "above": "this one costs at most",
    "ratio": "lower by upper bound",
}


@own_arithmetic
def bracket(
    result: Result,
    proof: Proof,
    side: str = "below",
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    legend: bool = False,
) -> Axes:
    """Draw the bracket of the least cost of any control law over the cells.

    Parameters
    ----------
    result
        The result of which ``proof`` is a proof.
    proof
        A proof with a bracket.
    side
        ``below``, the means over what arrives of each cell of the lower bound; ``above``, of
        the upper bound; or ``ratio``, the one by the other.
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
        The proof has no bracket, or is of another result.
    """
    inputs.kind(proof, Proof, "proof", "what Result.prove returns")
    if side not in WORDS:
        raise BadInput(f"{shown(side)} is unknown; known: {', '.join(WORDS)}", "side")
    if proof.maps is None:
        raise BadInput("it has no bracket; prove with bracket=True", "proof")
    view = view_of(result, axes, at)
    if len(proof.maps[0]) != result.partition.size:
        raise BadInput("it is a proof of another result", "proof")
    below, above = proof.maps
    with np.errstate(invalid="ignore", divide="ignore"):
        values = {"below": below, "above": above, "ratio": below / above}[side]
    drawn: Axes = layers.frame(ax, view, WORDS[side] + view.note)
    shown_ = view.values(np.where(np.isfinite(values), values, np.nan))
    if np.isfinite(shown_).any():
        layers.scalar(drawn, view, shown_, "share" if side == "ratio" else "cost", "viridis")
    regions.regions(drawn, view, codes_of(result), legend)
    return drawn

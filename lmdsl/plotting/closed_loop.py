"""Closed-loop runs of the true map, drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import layers, overlays, runs
from lmdsl.plotting.plots import _codes, _view
from lmdsl.plotting.view import At
from lmdsl.results.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@own_arithmetic
def trajectories(
    result: Result,
    ax: Axes | None = None,
    starts: int | ArrayLike = 16,
    seed: int = 0,
    *,
    steps: int = 500,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    legend: bool = False,
) -> Axes:
    """Draw closed-loop runs of the true map, from a ring to the attractor, a dot, or a loss, x.

    Lines for a differential equation, dots joined by thin lines for a map, broken where a
    periodic axis wraps; one dimension is drawn over the step number.

    Parameters
    ----------
    result
        A result; without a controller only the regions are drawn.
    ax
        Axes to draw into; new ones if None.
    starts
        Number of random starts, drawn by m, or states, shape (r, d).
    seed
        Seed of the starts and the noise.
    steps
        Step limit.
    axes, at
        Which axes are shown; regions other than the attractor are shown in up to two dimensions.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    steps, seed = inputs.whole(steps, "steps"), inputs.seed(seed)
    view = _view(result, axes, at)
    drawn: Axes = layers.frame(ax, view, "closed loop")
    status = result.cell_status
    attractor = view.shadow(status == CellStatus.ATTRACTOR)
    code = np.where(attractor, np.uint8(CellStatus.ATTRACTOR), np.uint8(CellStatus.STABILIZED))
    if not view.hidden:
        code = view.slice(_codes(result))
    if (result.control_index < 0).all() or not result.weight.any():
        overlays.remark(drawn, "no controller")
        layers.regions(drawn, view, code, legend)
        return drawn
    x = runs.starts_of(result, starts, seed)
    points, last, pieces = runs.closed_loop(result, x, steps, seed)
    reached = (last >= 0) & (status[last] == CellStatus.ATTRACTOR)
    running = (last >= 0) & (status[last] == CellStatus.STABILIZED)
    drawn.set_title(f"closed loop, {int(reached.sum())} of {len(x)} runs reach A", fontsize=11)
    if len(view.axes) == 1:
        drawn.set_xlabel("step")
        drawn.locator_params(axis="x", integer=True)
        drawn.set_ylabel(view.label(0))
        drawn.set_xlim(-0.4, (len(points) - 1) / pieces + 0.4)
        drawn.set_ylim(*view.ends(0))
    layers.regions(drawn, view, code, legend, upright=False)
    lines = runs.is_ode(result.problem)
    overlays.runs(drawn, view, points, reached, ~reached & ~running, lines, pieces)
    return drawn

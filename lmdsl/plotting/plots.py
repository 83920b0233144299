"""Plots of a problem and its result over the cells.

One and two dimensions are drawn as they are. More are cut: ``axes`` names the one or two axes
shown (default: the first two), ``at`` where the others are held (default: at the attractor's
centre); runs are projected. With ``project`` the axes neither shown nor held are projected away:
each cell shown takes the worst value, or the mean, of all stabilizable cells that lie over it.
Greys are cells that cannot be stabilized, by cause; in a projection, where none over them can.

Every function draws into the matplotlib axes it is given, or makes a figure of its own without
touching matplotlib's global state: ``ax.figure.savefig(...)``. In a notebook it shows itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lmdsl.common import inputs
from lmdsl.explanation.causes import Explanation
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import layers, quantities, regions
from lmdsl.plotting.quantities import view_of
from lmdsl.plotting.view import UNSOLVED, At, Projection, View
from lmdsl.results.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@own_arithmetic
def cost(
    result: Result,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    project: Projection | None = None,
    legend: bool = True,
) -> Axes:
    """Draw the cost-to-go V over the cells, the attractor, and by cause what has no control.

    Colours are logarithmic when V spans more than two decades. Where successors are enclosed, a
    line runs around the cells from which some controller surely arrives.

    Parameters
    ----------
    result
        A result of any status.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where the others are held.
    project
        ``"worst"`` or ``"mean"``: project the axes neither shown nor held; None: hold them all.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    return _drawn(result, "cost", ax, (axes, at, project), legend)


@own_arithmetic
def causes(
    explanation: Explanation,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    project: Projection | None = None,
    legend: bool = True,
) -> Axes:
    """Draw by cause the cells that cannot be stabilized, and outline the listed regions.

    Parameters
    ----------
    explanation
        What :func:`lmdsl.explain` returns.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where the others are held.
    project
        ``"worst"`` or ``"mean"``: project the axes neither shown nor held; None: hold them all.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    inputs.kind(explanation, Explanation, "explanation", "what lmdsl.explain returns")
    status = explanation.cell_status
    view = View.of(explanation.partition, status == CellStatus.ATTRACTOR, axes, at, project)
    drawn: Axes = layers.frame(ax, view, "cells that cannot be stabilized" + view.note)
    code = np.where(status == CellStatus.STABILIZED, np.uint8(UNSOLVED), status)
    regions.regions(drawn, view, code, legend)
    boxes = [region.box for cause in explanation.causes for region in cause.regions]
    regions.frames(drawn, view, boxes)
    return drawn


@own_arithmetic
def control(
    result: Result,
    name: str | None = None,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    project: Projection | None = None,
    legend: bool = False,
) -> Axes:
    """Draw one control of the feedback law over the cells.

    Parameters
    ----------
    result
        A result of any status; without a controller only the regions are drawn.
    name
        The control variable; default: the first.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where the others are held.
    project
        ``"worst"`` or ``"mean"``: project the axes neither shown nor held; None: hold them all.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    BadInput
        There is no such control.
    """
    return _drawn(result, "control", ax, (axes, at, project), legend, name)


@own_arithmetic
def measure(
    result: Result,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    project: Projection | None = None,
    legend: bool = False,
) -> Axes:
    """Draw the Lyapunov measure of the closed loop over the cells.

    Parameters
    ----------
    result
        A result of any status; without a measure only the regions are drawn.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where the others are held.
    project
        ``"worst"`` or ``"mean"``: project the axes neither shown nor held; None: hold them all.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    return _drawn(result, "measure", ax, (axes, at, project), legend)


@own_arithmetic
def coverage(
    result: Result,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    legend: bool = True,
) -> Axes:
    """Draw which share can be stabilized of the cells that lie over each cell shown.

    The axes neither shown nor held are projected away; attractor and avoid do not count.

    Parameters
    ----------
    result
        A result of any status.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where others are held.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    return _drawn(result, "coverage", ax, (axes, at, "mean"), legend)


def _drawn(
    result: Result,
    draw: str,
    ax: Axes | None,
    shown: tuple[Sequence[str] | None, At | None, Projection | None],
    legend: bool,
    name: str | None = None,
) -> Axes:
    """Draw a quantity of a result and the regions."""
    inputs.kind(result, Result, "result", "a Result")
    quantity = quantities.of_result(result, draw, name)
    view = view_of(result, *shown)
    drawn: Axes = layers.frame(ax, view, quantity.title + view.note)
    quantity.draw(drawn, view)
    levels = result.sure_levels if draw == "cost" else None
    sure = None if levels is None else levels > 0
    regions.regions(drawn, view, quantity.codes(result), legend, sure=sure)
    return drawn

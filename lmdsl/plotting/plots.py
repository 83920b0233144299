"""Plots of a problem and its result; :func:`figure` puts all of them on one page.

One and two dimensions are drawn as they are. More are cut: ``axes`` names the one or two axes
shown (default: the first two), ``at`` where the others are held (default: at the attractor's
centre); runs are projected. Greys are cells that cannot be stabilized, by cause.

Every function draws into the matplotlib axes it is given, or makes a figure of its own without
touching matplotlib's global state: ``ax.figure.savefig(...)``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Statuses
from lmdsl.errors import BadInput, shown
from lmdsl.explanation.causes import Explanation
from lmdsl.machine import memory
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.discretization import control_values
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import layers, overlays, runs
from lmdsl.plotting.view import At, View, number, plain
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@own_arithmetic
def portrait(
    problem: Problem | Result,
    control: ArrayLike | Mapping[str, float] | None = None,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    starts: int | None = None,
    steps: int | None = None,
) -> Axes:
    """Draw the phase portrait of the true map at a constant control.

    Initial states, one in each tile of a grid, are followed, coloured by the height of the start:
    dots for a map, lines for a differential equation. In one dimension: the graph of the map, the
    diagonal and a cobweb. Noise is held at its mean; a run ends where it leaves the box.

    Parameters
    ----------
    problem
        A problem or a result.
    control
        The control: a number, a sequence, or values by name. Default: the control of the grid
        nearest to zero.
    ax
        Axes to draw into; new ones if None.
    axes, at
        Which axes are shown and where the others are held.
    starts, steps
        Initial states per axis, and steps of each; None picks what reads well.

    Returns
    -------
    matplotlib.axes.Axes
    """
    inputs.kind(problem, (Problem, Result), "problem", "a Problem or a Result")
    given = problem if isinstance(problem, Problem) else problem.problem
    for name, count in (("starts", starts), ("steps", steps)):
        if count is not None:
            inputs.whole(count, name)
    partition = Partition.of(given)
    attractor = CellSets.of(given, partition).attractor
    view = View.of(partition, attractor, axes, at)
    u = runs.control_vector(given, control)
    lines = runs.is_ode(given)
    held = ", ".join(f"{plain(k, 16)} = {number(v)}" for k, v in u.items())
    title = ("flow" if lines else "map") + (f" at {held}" if held else "") + view.note
    drawn: Axes = layers.frame(ax, view, title)
    layers.region(drawn, view, view.shadow(attractor), CellStatus.ATTRACTOR)
    if len(view.axes) == 1:
        if view.hidden:
            raise BadInput("a phase portrait needs two axes", "axes")
        low, high = view.ends(0)
        x = np.linspace(low, high, 2001)
        next_of = runs.constant_map(given, partition)
        image = next_of(x[:, None], np.tile(list(u.values()), (len(x), 1)))[:, 0]
        first = np.array([[low + 0.1234 * (high - low)]])
        orbit = runs.open_loop(given, partition, first, u, steps or 60, fine=False)[:, 0, 0]
        overlays.graph(drawn, view, x, image, orbit)
        return drawn
    first, place = runs.tiled(partition, view, starts or (8 if lines else 14))
    points = runs.open_loop(given, partition, first, u, steps or (60 if lines else 300), fine=lines)
    overlays.orbits(drawn, view, points, place[:, 1], lines)
    layers.outline(drawn, view, view.shadow(attractor), layers.ATTRACTOR, 1.6)
    return drawn


@own_arithmetic
def cost(
    result: Result,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
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
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    view = _view(result, axes, at)
    solved = result.status != Status.NOT_STABILIZABLE
    optimal = "optimal cost" if result.problem.controls else "cost"
    word = optimal if result.verified else "cost, not verified" if solved else "causes"
    drawn: Axes = layers.frame(ax, view, word + view.note)
    value = view.slice(_on_stabilized(result, result.value))
    if np.isfinite(value).any():
        layers.scalar(drawn, view, value, "cost-to-go V", "viridis")
    levels = result.sure_levels
    sure = None if levels is None else view.slice(levels > 0)
    layers.regions(drawn, view, view.slice(_codes(result)), legend, sure=sure)
    return drawn


@own_arithmetic
def causes(
    explanation: Explanation,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
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
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    inputs.kind(explanation, Explanation, "explanation", "what lmdsl.explain returns")
    status = explanation.cell_status
    view = View.of(explanation.partition, status == CellStatus.ATTRACTOR, axes, at)
    drawn: Axes = layers.frame(ax, view, "cells that cannot be stabilized" + view.note)
    code = np.where(status == CellStatus.STABILIZED, np.uint8(layers.UNSOLVED), status)
    layers.regions(drawn, view, view.slice(code), legend)
    boxes = [region.box for cause in explanation.causes for region in cause.regions]
    layers.frames(drawn, view, boxes)
    return drawn


@own_arithmetic
def control(
    result: Result,
    name: str | None = None,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
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
    inputs.kind(result, Result, "result", "a Result")
    names = result.problem.controls
    if not names:
        raise BadInput("the system is autonomous: it has no control to draw", "control_grid")
    chosen = names[0] if name is None else name
    if chosen not in names:
        raise BadInput(
            f"{shown(chosen)} is no control; the controls are {', '.join(names)}", "name"
        )
    k = names.index(chosen)
    view = _view(result, axes, at)
    drawn: Axes = layers.frame(ax, view, f"control {plain(chosen, 24)}{view.note}")
    index = view.slice(result.control_index)
    if (index >= 0).any():
        values = np.where(index >= 0, result.control_vectors[index, k], np.nan)
        grid = control_values(result.problem)[k]
        layers.levels(drawn, view, values, grid, f"control {plain(chosen, 24)}")
    elif (result.control_index < 0).all():
        overlays.remark(drawn, "no controller")
    layers.regions(drawn, view, view.slice(_codes(result)), legend)
    return drawn


@own_arithmetic
def measure(
    result: Result,
    ax: Axes | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
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
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    view = _view(result, axes, at)
    drawn: Axes = layers.frame(ax, view, "Lyapunov measure" + view.note)
    if result.measure.any():
        values = view.slice(_on_stabilized(result, result.measure))
        layers.scalar(drawn, view, values, "Lyapunov measure", "cividis")
    else:
        overlays.remark(drawn, "no Lyapunov measure")
    layers.regions(drawn, view, view.slice(_codes(result)), legend)
    return drawn


def _view(result: Result, axes: Sequence[str] | None, at: At | None) -> View:
    inputs.kind(result, Result, "result", "a Result")
    view = View.of(result.partition, result.cell_status == CellStatus.ATTRACTOR, axes, at)
    memory.require(_bytes(view, 150), "a plot")
    return view


def _bytes(view: View, each: int) -> float:
    """Return the memory of a plot that takes so many bytes for a cell that is shown."""
    shape = view.partition.shape
    return each * math.prod(shape[k] for k in view.axes) + 40.0 * math.prod(shape)


def _on_stabilized(result: Result, values: Floats) -> Floats:
    known = (result.cell_status == CellStatus.STABILIZED) & np.isfinite(values)
    return np.where(known, values, np.nan)


def _codes(result: Result) -> Statuses:
    """Return the region of every cell: its status, or what a refusal says of it."""
    code = result.cell_status.copy()
    free = code == CellStatus.STABILIZED
    if result.status == Status.NOT_STABILIZABLE:
        code[free] = layers.UNSOLVED
        if result.cause == Cause.GAMMA:
            code[free & (result.refusal_vector > 0)] = layers.INFINITE
    return code

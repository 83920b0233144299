"""Runs of the true map, drawn: at a constant control, and in closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.errors import BadInput
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import layers, overlays, regions, runs
from lmdsl.plotting.quantities import codes_of, view_of
from lmdsl.plotting.view import At, View, number, plain
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result

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
    diagonal and a cobweb. Noise is held at its mean; a run ends where it leaves the box. Where not
    every axis is shown, runs are projected, and so are attractor and avoid.

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
    sets = CellSets.of(given, partition)
    attractor = sets.attractor
    if isinstance(problem, Result):  # of which only what holds may be left
        attractor = problem.cell_status == CellStatus.ATTRACTOR
    view = View.of(partition, attractor, axes, at)
    u = runs.control_vector(given, control)
    lines = runs.is_ode(given)
    held = ", ".join(f"{plain(k, 16)} = {number(v)}" for k, v in u.items())
    title = ("flow" if lines else "map") + (f" at {held}" if held else "") + view.note
    drawn: Axes = layers.frame(ax, view, title)
    regions.obstacles(drawn, view, attractor, sets.avoid, legend=False)
    if len(view.axes) == 1:
        if not view.whole:
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
    regions.outline(drawn, view, view.shadow(attractor), regions.ATTRACTOR, 1.6)
    return drawn


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
        Which axes are shown; runs are projected onto them, and where not all are shown so are
        attractor and avoid, without the other regions.
    legend
        Explain the regions below the axes.

    Returns
    -------
    matplotlib.axes.Axes
    """
    steps, seed = inputs.whole(steps, "steps"), inputs.seed(seed)
    view = view_of(result, axes, at)
    drawn: Axes = layers.frame(ax, view, "closed loop")
    status = result.cell_status
    controlled = bool((result.control_index >= 0).any() and result.weight.any())
    if view.whole:
        regions.regions(drawn, view, codes_of(result), legend, upright=not controlled)
    else:
        attractor, avoid = status == CellStatus.ATTRACTOR, status == CellStatus.AVOID
        regions.obstacles(drawn, view, attractor, avoid, legend, upright=not controlled)
    if not controlled:
        overlays.remark(drawn, "no controller")
        return drawn
    x = runs.starts_of(result, starts, seed)
    points, last, pieces = runs.closed_loop(result, x, steps, seed)
    reached = (last >= 0) & (status[last] == CellStatus.ATTRACTOR)
    running = (last >= 0) & (status[last] == CellStatus.STABILIZED)
    drawn.set_title(f"closed loop, {int(reached.sum())} of {len(x)} runs reach A", fontsize=11)
    if len(view.axes) == 1:
        over_steps(drawn, view, (len(points) - 1) / pieces)
    lines = runs.is_ode(result.problem)
    overlays.runs(drawn, view, points, reached, ~reached & ~running, lines, pieces)
    return drawn


def over_steps(ax: Axes, view: View, steps: float) -> None:
    """Draw over the step number what axes of one dimension show."""
    ax.set_xlabel("step")
    ax.locator_params(axis="x", integer=True)
    ax.set_ylabel(view.label(0))
    ax.set_xlim(-0.4, steps + 0.4)
    ax.set_ylim(*view.ends(0))

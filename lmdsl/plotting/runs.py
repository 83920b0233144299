"""Runs of the true map for plots: at a constant control, and in closed loop."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Indices
from lmdsl.control.integration import Integrator
from lmdsl.control.loop import draw_starts
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.model.discretization import control_values, noise_nodes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.true_map import TrueMap
from lmdsl.plotting.view import View
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result
from lmdsl.systems.base import OdeSystem
from lmdsl.systems.named import NamedOde

PIECES = 8  # drawn lines of a differential equation have so many pieces a step

Map = Callable[[Floats, Floats], Floats]


def is_ode(problem: Problem) -> bool:
    """Return whether states move continuously, so that runs are lines."""
    return isinstance(problem.system, OdeSystem | NamedOde)


def control_vector(
    problem: Problem, control: ArrayLike | Mapping[str, float] | None
) -> dict[str, float]:
    """Return a control by name; None stands for the control of the grid nearest to zero."""
    names = problem.controls
    if control is None:
        grid = control_values(problem)
        return {k: float(v[np.argmin(np.abs(v))]) for k, v in zip(names, grid, strict=True)}
    if isinstance(control, Mapping):
        if set(control) != set(names):
            raise BadInput(f"name every control once: {', '.join(names)}", "control")
        control = [control[k] for k in names]
    values = np.atleast_1d(inputs.real(control, "control"))
    if values.shape != (len(names),) or not np.isfinite(values).all():
        raise BadInput(f"give {len(names)} finite numbers ({', '.join(names)})", "control")
    return dict(zip(names, map(float, values), strict=True))


def constant_map(problem: Problem, partition: Partition, fine: bool = False) -> Map:
    """Return the map (x, u) -> x+ on arrays (r, d) and (r, p), noise held at its mean.

    A differential equation is integrated accurately; with ``fine`` over 1/PIECES of a step.
    """
    noise = noise_nodes(problem).mean()

    def held(x: Floats) -> list[Floats]:
        return [np.full(len(x), mean) for mean in noise]

    if not is_ode(problem):
        true_map = TrueMap(problem, partition)
        return lambda x, u: true_map.images(x, u, held(x))
    system: Any = problem.system
    if fine:
        system = system.model_copy(update={"step": system.step / PIECES})
        problem = problem.model_copy(update={"system": system})
    integrator = Integrator(TrueMap(problem, partition))
    return lambda x, u: integrator.images(x, u, held(x))


def open_loop(
    problem: Problem, p: Partition, x: Floats, u: Mapping[str, float], steps: int, fine: bool
) -> Floats:
    """Return states of runs at a constant control, shape (T, r, d), NaN after leaving the box.

    With ``fine`` a step makes PIECES states.
    """
    image = constant_map(problem, p, fine)
    length = steps * (PIECES if fine else 1) + 1
    memory.require(8 * length * x.size, "runs")
    points = np.full((length, *x.shape), np.nan)
    points[0] = p.states(x)
    active = np.arange(len(x))
    held = np.tile(list(u.values()), (len(x), 1))
    for n in range(len(points) - 1):
        following, cell = p.enter(image(points[n, active], held[active]))
        finite = np.isfinite(following).all(axis=1)
        points[n + 1, active[finite]] = following[finite]
        active = active[cell >= 0]
        if not len(active):
            break
    return points


def tiled(partition: Partition, view: View, side: int) -> tuple[Floats, Floats]:
    """Return a state in each tile of a grid over the two axes shown, and its place there in 0..1.

    Shapes (side^2, d) and (side^2, 2).
    """
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 2), axis=-1).reshape(-1, 2)
    place = (grid + np.random.default_rng(0).random(grid.shape)) / side
    first = np.tile(partition.low + (view.cell + 0.5) * partition.width, (len(place), 1))
    axes = list(view.axes)
    span = (partition.high - partition.low)[axes]
    first[:, axes] = partition.low[axes] + place * span
    return first, place


def starts_of(result: Result, starts: int | ArrayLike, seed: int) -> Floats:
    """Return so many random starts, drawn by m, or the given ones, shape (r, d)."""
    d = result.partition.dimension
    if isinstance(starts, int | np.integer):
        starts = inputs.whole(starts, "starts")
        memory.require(100 * starts * d, "runs")
        cells = np.flatnonzero(result.weight)
        rng = np.random.default_rng(seed)
        return draw_starts(result.partition, cells, result.weight[cells], int(starts), rng)
    x = inputs.states(starts, result.partition.names, "starts")
    if x.ndim != 2 or x.shape[1] != d or not len(x):
        raise BadInput(f"states have shape (r, {d}), not {x.shape}", "starts")
    return x


def closed_loop(result: Result, x: Floats, steps: int, seed: int) -> tuple[Floats, Indices, int]:
    """Run the true map under the controller until A, loss, or the step limit.

    Returns the states, shape (T, r, d), NaN after the end of a run; the last cell of each run, -1
    outside the box; and the number of states a step.
    """
    loop, p = result.closed_loop, result.partition
    rng, pieces = np.random.default_rng(seed), PIECES if is_ode(result.problem) else 1
    x, cell = p.enter(x)
    points = [x]
    for _ in range(steps):
        on = np.flatnonzero((cell >= 0) & (result.cell_status[cell] == CellStatus.STABILIZED))
        if not len(on):
            break
        moved = loop.move(points[-1][on], cell[on], rng, pieces=pieces - 1)
        points += [_scatter(x, on, p.states(piece)) for piece in moved.drawn]
        points.append(_scatter(x, on, moved.state))
        cell[on] = moved.cell
    return np.array(points), cell, pieces


def _scatter(like: Floats, rows: Indices, values: Floats) -> Floats:
    spread = np.full_like(like, np.nan)
    spread[rows] = values
    return spread

"""What becomes of runs after they reached A, under local controller and controller together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.local_control import ConstantControl

if TYPE_CHECKING:
    from lmdsl.control.loop import ClosedLoop


@dataclass(frozen=True)
class Held:
    """What became of the runs that reached A, under local controller and controller together.

    Attributes
    ----------
    steps
        Steps each run went on after its first entry into A; of a partial ``hold`` each that entered
        a cell that holds.
    stayed, returned, away, lost
        Runs that never left A; that left it and are back at the end; that are underway at the
        end; that were lost.
    distance
        Median and largest distance from the orbit at the end, in cell widths, of the runs in A;
        None where there is no orbit, or no run.
    inside
        Mean share of these steps after which a run was in A; None where there is no run.
    left
        ``min``, ``q50``, ``q90``, ``q99``, ``max`` of the steps until A was first left, of the runs
        that left it; None where none did.
    mean_to_leave
        Mean steps until A is first left: all steps made in A before, over the number of runs that
        left, so that those that stayed until the end count. None where none left.
    """

    steps: int
    stayed: int
    returned: int
    away: int
    lost: int
    distance: tuple[float, float] | None
    inside: float | None = None
    left: dict[str, float] | None = None
    mean_to_leave: float | None = None


def quantiles(values: Floats | Indices) -> dict[str, float]:
    """Return ``min``, ``q50``, ``q90``, ``q99`` and ``max`` of values, each one of them."""
    q = np.quantile(values, [0, 0.5, 0.9, 0.99, 1], method="inverted_cdf")
    return dict(zip(("min", "q50", "q90", "q99", "max"), q.tolist(), strict=True))


def goes_on(
    loop: ClosedLoop, x: Floats, steps: int, rng: np.random.Generator, deadline: Deadline
) -> Held:
    """Run on from states of A; see :meth:`lmdsl.control.loop.ClosedLoop.hold`."""
    local, (x, cell) = loop.controller.local, loop.partition.enter(x)
    if local is None:  # of the cells of a partial hold, those that hold
        on = loop.controller.index[cell] >= 0
        x, cell = x[on], cell[on]
    runs, visits = len(x), 0
    left, active = np.full(runs, -1), np.arange(runs)
    for n in range(steps):
        try:
            moved = loop.move(x, cell, rng, deadline, absorb=False)
        except TimeLimitReached:
            steps = n
            break
        x, cell = moved.state, moved.cell
        state = np.where(cell >= 0, loop.status[cell], CellStatus.AVOID)
        inside = state == CellStatus.ATTRACTOR
        visits += int(inside.sum())
        out = active[~inside]
        left[out[left[out] < 0]] = n + 1
        on = state <= CellStatus.STABILIZED
        active, x, cell = active[on], x[on], cell[on]
        if not len(x):
            break
    inside = loop.status[cell] == CellStatus.ATTRACTOR
    gone = left > 0
    return Held(
        steps=steps,
        stayed=int((~gone).sum()),
        returned=int((inside & gone[active]).sum()),
        away=int((~inside).sum()),
        lost=runs - len(x),
        distance=_distance(loop, x, inside),
        inside=visits / (runs * steps) if runs and steps else None,
        left=quantiles(left[gone]) if gone.any() else None,
        mean_to_leave=_mean_to_leave(left, gone, steps),
    )


def _mean_to_leave(left: Indices, gone: Bools, steps: int) -> float | None:
    if not gone.any():
        return None
    return float(np.where(gone, left, steps).sum() / gone.sum())


def _distance(loop: ClosedLoop, x: Floats, inside: Bools) -> tuple[float, float] | None:
    """Return the median and largest distance from the orbit of the runs inside A."""
    local = loop.controller.local
    constant = isinstance(loop.declared.local_controller, ConstantControl)
    if not inside.any() or local is None or constant:
        return None
    away = local.distance(x[inside])
    return float(np.median(away)), float(away.max())

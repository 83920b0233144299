"""Hints on what would help, each given only where trials with the true map support it.

The cells outside C, or evenly chosen ones if they are many, are tried: the true map (not the
finite model) is run from their sample points under every control, held constant, for at most 64
steps, noise held at each of its nodes. A run *arrives* when it enters a cell of C or A; it may
leave the box on the way, but may not enter ``avoid``, lose finiteness, or go further out than one
length of the axis.

finer grid     from every sample point of the cell some held control arrives inside the box: what
               stops the finite model is that one control must serve a whole cell, or that samples
               stay in a cell which the map itself leaves.
larger box     otherwise: some held control arrives from every sample point, having gone over just
               one side of the box, by no more than a quarter of the axis.
more controls  for cells that escape: along one control, with the others held at the values that
               leave least, the overshoot of the box falls strictly towards one end of the grid
               (three values or more), and at most one more length of the range makes the pair
               admissible, as evaluated there.

A hint is given if at least 5 % of the cells tried support it, and carries its numbers.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.common.records import Reported
from lmdsl.common.types import Bools, Floats, Guard, Indices, Statuses
from lmdsl.explanation.trials import MOST_CONTROLS, MapTrial, some
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.paths.judging import PathJudge
from lmdsl.model.discretization import control_values
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.systems.runge_kutta import RungeKutta

# Steps of a run; share of the axis above which a side is left too far; share of cells below which a
# hint has no support; share of them for which its numbers suffice.
STEPS, NEAR, SUPPORT, QUANTILE = 64, 0.25, 0.05, 0.9
# How far beyond the end of a control's range is tried, in lengths of the range.
BEYOND = (0.0, 0.125, 0.25, 0.5, 1.0)


@dataclass(frozen=True)
class Hint(Reported):
    """Something that would help, and the numbers that support it.

    Attributes
    ----------
    kind
        ``larger box``, ``more controls`` or ``finer grid``; of changes that were compiled
        (:mod:`lmdsl.explanation.changes`) ``longer step``, ``periodic axis``, ``box attractor`` or
        ``smaller cells``.
    text
        One sentence.
    numbers
        ``cells`` support it of ``tried``; the others depend on the kind.
    """

    kind: str
    text: str
    numbers: dict[str, Any]


def hints(
    problem: Problem,
    partition: Partition,
    status: Statuses,
    deadline: Deadline | None = None,
) -> tuple[Hint, ...]:
    """Return the hints that trials support, given the status of all cells (N,)."""
    lost = np.isin(status, LOST)
    if not lost.any():
        return ()
    trial = _Trial(problem, partition, deadline, "trying what helps")
    trial.status, trial.way = status, _Way.of(problem, partition)
    escaping = np.flatnonzero(status == CellStatus.ESCAPES)
    with np.errstate(all="ignore"):
        found = _by_runs(trial, some(np.flatnonzero(lost), trial.most_cells))
        if len(escaping):
            found += _more_controls(trial, some(escaping, min(trial.most_cells, 64)))
    return tuple(found)


class _Trial(MapTrial):
    """The true map, and what becomes of its images."""

    status: Statuses  # of all cells
    way: "_Way | None"  # judges paths; None where there are none

    def step(
        self, state: list[Floats], controls: list[Floats], shape: tuple[int, ...]
    ) -> tuple[list[Floats], Floats, Indices]:
        """Return images per axis, overshoot (2 d, *shape) by side, and status (-1 outside)."""
        p = self.partition
        images, over = [], np.zeros((2 * p.dimension, *shape))
        left: Bools | None = None
        found: tuple[Floats, ...]
        if self.way is None:
            found = self.images(state, controls)
        else:
            values = self.true_map.named(state, controls, self.noise)
            found, left = self.way(values, shape, self.guard)
        for k, (axis, image) in enumerate(zip(p.axes, found, strict=True)):
            x = axis.state(np.broadcast_to(image, shape), p.clip)
            if not (axis.periodic or p.clip):
                low, high = float(p.low[k]), float(p.high[k])
                beyond = EDGE * float(p.width[k])
                for side, by in ((2 * k, low - x), (2 * k + 1, x - high)):
                    over[side] = np.where(by > beyond, by, 0.0)
            images.append(x)
        flat = p.locate(images)
        finite = np.logical_and.reduce([np.isfinite(x) for x in images])
        code = np.where(flat >= 0, self.status[flat].astype(np.int64), -1)
        admitted = self.admits(state, controls)
        fine = finite if admitted is None else finite & admitted
        if left is not None:  # and came back: by no side that a larger box would tell
            within = p.locate([np.broadcast_to(x, shape) for x in state]) >= 0
            fine = fine & ~(left & within & (over == 0).all(axis=0))
        return images, over, np.where(fine, code, np.int64(CellStatus.AVOID))

    def side(self, number: int) -> tuple[str, str, float, float]:
        """Return axis, end, its place and the length of the axis, of a side of the box."""
        k, high = divmod(number, 2)
        p = self.partition
        place = float(p.high[k] if high else p.low[k])
        return p.names[k], "high" if high else "low", place, float(self.span[k])


class _Way:
    """The paths of steps, which may leave the box, and where they end."""

    def __init__(self, flow: RungeKutta, partition: Partition, sets: CellSets) -> None:
        self.judge = PathJudge(flow, partition, sets, endpoint=False)
        self.free = PathJudge(flow, partition, sets, endpoint=False)
        self.free.ground = self.free.ground._replace(forbid=False)

    @classmethod
    def of(cls, problem: Problem, partition: Partition) -> "_Way | None":
        """Return what judges the paths of a problem; None where images say all."""
        flow = problem.flow(cost=False) if problem.judged == "path" else None
        return None if flow is None else cls(flow, partition, CellSets.of(problem, partition))

    def __call__(
        self, values: Mapping[str, Floats], shape: tuple[int, ...], guard: Guard
    ) -> tuple[tuple[Floats, ...], Bools]:
        """Return images, or where A or avoid is entered, per axis; whether the box is left."""
        place = self.free(values, shape, guard, places=True).place
        left: Bools = np.isnan(self.judge(values, shape, guard, places=False).cell)
        return tuple(x.reshape(shape) for x in place), left


def _by_runs(trial: _Trial, cells: Indices) -> list[Hint]:
    shape = trial.shape(cells)
    held = trial.vectors()
    state: list[Floats] = [np.broadcast_to(x, shape) for x in trial.start(cells)]
    arrived, live = np.zeros(shape, dtype=np.bool_), np.ones(shape, dtype=np.bool_)
    most = np.zeros((2 * trial.partition.dimension, *shape))
    reach = np.repeat(trial.span, 2).reshape(-1, 1, 1, 1, 1)
    staying = np.zeros(shape[:2])
    for number in range(STEPS):
        images, over, code = trial.step(state, held, shape)
        if number == 0:
            flat = trial.partition.locate(images)
            staying = (flat == cells[:, None, None, None]).mean(axis=(2, 3))
        np.maximum(most, np.where(live, over, 0.0), out=most)
        arrived |= live & ((code == CellStatus.STABILIZED) | (code == CellStatus.ATTRACTOR))
        live &= ~arrived & (code != CellStatus.AVOID) & (over <= reach).all(axis=0)
        if not live.any():
            break
        state = [np.where(live, x, old) for x, old in zip(images, state, strict=True)]
    inside = arrived & (most == 0).all(axis=0)
    finer: Bools = np.asarray(inside.all(axis=3).any(axis=1).all(axis=1))
    return [
        *_finer(trial, cells, finer, staying),
        *_larger(trial, ~finer, np.asarray(arrived.all(axis=(2, 3))), most.max(axis=(3, 4))),
    ]


def _finer(trial: _Trial, cells: Indices, finer: Bools, staying: Floats) -> list[Hint]:
    count, tried = int(finer.sum()), len(cells)
    if count < max(1.0, SUPPORT * tried):
        return []
    own = float(np.median(staying[finer].min(axis=1)))
    of = trial.status[cells[finer]]
    trapped = int((of == CellStatus.TRAPPED).sum())
    text = (
        f"a finer grid (or more sample points): from {count} of {tried} cells tried the true map "
        f"reaches stabilizable cells or the attractor from every sample point under held controls "
        f"without leaving the box; {trapped} of them are trapped; the share of samples that stay "
        f"in their own cell is at least {own:.3g} under every control (median of these cells)"
    )
    numbers = {"cells": count, "tried": tried, "trapped": trapped, "own_cell_share": own}
    return [Hint("finer grid", text, numbers)]


def _larger(trial: _Trial, open_: Bools, arrived: Bools, most: Floats) -> list[Hint]:
    """Hint from which held controls arrive (cells, controls) and how far out (2 d, ...)."""
    length = np.repeat(trial.span, 2).reshape(-1, 1, 1)
    fits = arrived & ((most > 0).sum(axis=0) == 1)
    share = np.where(fits, (most / length).max(axis=0), np.inf)
    best = share.argmin(axis=1)
    every = np.arange(len(best))
    good = open_ & (share[every, best] <= NEAR)
    side = most[:, every, best].argmax(axis=0)
    found = []
    for number in np.unique(side[good]):
        of = good & (side == number)
        count, tried = int(of.sum()), len(of)
        if count < max(1.0, SUPPORT * tried):
            continue
        name, end, place, span = trial.side(int(number))
        far = float(np.quantile(most[number, every, best][of], QUANTILE))
        to = place + far if end == "high" else place - far
        text = (
            f"a larger box: from {count} of {tried} cells tried the true map goes "
            f"{'above' if end == 'high' else 'below'} {name} = {place:.6g} only and comes back "
            f"to stabilizable cells or the attractor under a held control; 90 % of these stay "
            f"within {name} = {to:.6g} ({far:.3g} beyond, {100 * far / span:.3g} % of the axis)"
        )
        numbers = {
            "cells": count, "tried": tried, "axis": name, "end": end,
            "overshoot": far, "overshoot_of_axis": far / span, "extend_to": to,
        }  # fmt: skip
        found.append(Hint("larger box", text, numbers))
    return found


def _worst(trial: _Trial, cells: Indices, controls: list[Floats]) -> Floats:
    """Return the largest overshoot of the samples, in lengths of the axis, (cells, controls).

    Infinite where a sample enters ``avoid`` or is not finite.
    """
    width = max((u.shape[1] for u in controls), default=1)
    shape = (len(cells), width, len(trial.points), len(trial.nodes))
    _, over, code = trial.step(trial.start(cells), controls, shape)
    worst: Floats = (over / np.repeat(trial.span, 2).reshape(-1, 1, 1, 1, 1)).max(axis=0)
    np.copyto(worst, np.inf, where=code == CellStatus.AVOID)
    return np.asarray(worst.max(axis=(2, 3)))


def _more_controls(trial: _Trial, cells: Indices) -> list[Hint]:
    vectors = trial.controls[_worst(trial, cells, trial.vectors()).argmin(axis=1)]
    found = []
    for k, values in enumerate(control_values(trial.problem)):
        grid = some(np.sort(values), MOST_CONTROLS)
        if len(grid) < 3:
            continue
        length = float(grid[-1] - grid[0])
        controls = [np.ascontiguousarray(u)[:, None, None, None] for u in vectors.T]
        for end, sign in (("low", -1.0), ("high", 1.0)):
            towards = grid[:: int(sign)]
            worst = _worst(trial, cells, _with(controls, k, towards))
            falling = np.isfinite(worst).all(axis=1) & (np.diff(worst, axis=1) < 0).all(axis=1)
            beyond = towards[-1] + sign * length * np.array(BEYOND[1:])
            admissible = _worst(trial, cells, _with(controls, k, beyond)) == 0
            good = falling & (worst[:, -1] > 0) & admissible.any(axis=1)
            count, tried = int(good.sum()), len(cells)
            if count < max(1.0, SUPPORT * tried):
                continue
            needed = np.array(BEYOND[1:])[admissible[good].argmax(axis=1)]
            far = float(np.quantile(needed, QUANTILE, method="higher"))
            to = float(towards[-1]) + sign * far * length
            name = trial.problem.controls[k]
            left = float(np.median(worst[good, -1]))
            text = (
                f"more controls: in {count} of {tried} escaping cells tried the overshoot falls "
                f"all the way to the end of the grid, {name} = {float(towards[-1]):.6g}, where "
                f"{100 * left:.3g} % of the axis is left (median); with {name} = {to:.6g} "
                "90 % of these have an admissible control"
            )
            numbers = {
                "cells": count, "tried": tried, "control": name, "end": end,
                "overshoot_of_axis": left, "extend_to": to,
            }  # fmt: skip
            found.append(Hint("more controls", text, numbers))
    return found


def _with(controls: list[Floats], k: int, values: Floats) -> list[Floats]:
    return [*controls[:k], np.ascontiguousarray(values)[None, :, None, None], *controls[k + 1 :]]

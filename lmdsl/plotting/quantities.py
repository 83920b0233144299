"""What is drawn over the cells: cost, controls, measure, coverage, each with its colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.types import Floats, Statuses
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.model.discretization import control_values
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import layers, overlays, regions
from lmdsl.plotting.view import UNSOLVED, At, Projection, View, plain
from lmdsl.results.result import Result
from lmdsl.results.status import Cause, Status

# Draws values over a view; colours span ``among``, those of several panels, or these themselves.
Paint = Callable[[Any, View, Floats, Floats | None], Any]


@dataclass(frozen=True, eq=False)
class Quantity:
    """One number for each cell, NaN where there is none, and how it is drawn."""

    title: str
    values: Floats  # (N,)
    paint: Paint
    signed: bool = False  # of both signs: the worst is the largest in magnitude
    missing: str = ""  # what is said where no cell has one
    lost: bool = True  # cells that cannot be stabilized are drawn as regions, by cause

    def codes(self, result: Result) -> Statuses:
        """Return the region of every cell, as it is drawn around the values."""
        code = codes_of(result)
        if not self.lost:
            code[~np.isin(code, (CellStatus.ATTRACTOR, CellStatus.AVOID))] = CellStatus.STABILIZED
        return code

    def over(self, view: View) -> Floats:
        """Return the values that a view shows."""
        return view.values(self.values, self.signed)

    def draw(self, ax: Any, view: View, among: Floats | None = None) -> Any:
        """Draw what a view shows; return the picture, None where nothing is or in one dimension."""
        shown_ = self.over(view)
        if np.isfinite(shown_).any():
            return self.paint(ax, view, shown_, among)
        if self.missing and np.isnan(self.values).all():
            overlays.remark(ax, self.missing)
        return None


def of_result(result: Result, draw: str, name: str | None = None) -> Quantity:
    """Return a quantity of a result: ``cost``, ``control`` (of that name), ``measure``, ...

    BadInput: there is none of that name.
    """
    if not isinstance(draw, str) or draw not in QUANTITIES:
        known = ", ".join(QUANTITIES)
        raise BadInput(f"{shown(draw)} is unknown; known: {known}", "draw")
    return QUANTITIES[draw](result, name)


def _cost(result: Result, name: str | None) -> Quantity:
    solved = result.status != Status.NOT_STABILIZABLE
    optimal = "optimal cost" if result.problem.controls else "cost"
    word = optimal if result.verified else "cost, not verified" if solved else "causes"
    return Quantity(word, on_stabilized(result, result.value), _scalar("cost-to-go V", "viridis"))


def _measure(result: Result, name: str | None) -> Quantity:
    word, none = "Lyapunov measure", np.full(len(result.measure), np.nan)
    values = on_stabilized(result, result.measure) if result.measure.any() else none
    return Quantity(word, values, _scalar(word, "cividis"), missing=f"no {word}")


def _coverage(result: Result, name: str | None) -> Quantity:
    status = result.cell_status
    free = ~np.isin(status, (CellStatus.ATTRACTOR, CellStatus.AVOID))
    values = np.where(free, (status == CellStatus.STABILIZED).astype(float), np.nan)
    ends = np.array([0.0, 1.0])

    def paint(ax: Any, view: View, shown_: Floats, among: Floats | None) -> Any:
        word = "share that is stabilizable"
        return layers.scalar(ax, view, shown_, word, "Greens", ends, barred=among is None)

    return Quantity("coverage", values, paint, lost=False)


def _control(result: Result, name: str | None) -> Quantity:
    names = result.problem.controls
    if not names:
        raise BadInput("the system is autonomous: it has no control to draw", "control_grid")
    chosen = names[0] if name is None else name
    if chosen not in names:
        raise BadInput(
            f"{shown(chosen)} is no control; the controls are {', '.join(names)}", "name"
        )
    k, index = names.index(chosen), result.control_index
    values = np.where(index >= 0, result.control_vectors[index, k], np.nan)
    grid, label = control_values(result.problem)[k], f"control {plain(chosen, 24)}"

    def paint(ax: Any, view: View, shown_: Floats, among: Floats | None) -> Any:
        return layers.levels(ax, view, shown_, grid, label, among is None)

    return Quantity(label, values, paint, signed=True, missing="no controller")


QUANTITIES: dict[str, Callable[[Result, str | None], Quantity]] = {
    "cost": _cost,
    "control": _control,
    "measure": _measure,
    "coverage": _coverage,
}


def _scalar(label: str, colours: str) -> Paint:
    def paint(ax: Any, view: View, shown_: Floats, among: Floats | None) -> Any:
        return layers.scalar(ax, view, shown_, label, colours, among, among is None)

    return paint


def view_of(
    result: Result,
    axes: Sequence[str] | None,
    at: At | None,
    project: Projection | None = None,
) -> View:
    """Return what a plot of a result shows; BadInput where there is no memory for it."""
    inputs.kind(result, Result, "result", "a Result")
    view = View.of(result.partition, result.cell_status == CellStatus.ATTRACTOR, axes, at, project)
    memory.require(bytes_of(view, 150), "a plot")
    return view


def bytes_of(view: View, each: int) -> float:
    """Return the memory of a plot that takes so many bytes for a cell that is shown."""
    shape, whole = view.partition.shape, 64.0 if view.away else 40.0
    return each * math.prod(shape[k] for k in view.axes) + whole * math.prod(shape)


def on_stabilized(result: Result, values: Floats) -> Floats:
    """Return values, NaN where they are not known or no control is needed."""
    known = (result.cell_status == CellStatus.STABILIZED) & np.isfinite(values)
    return np.where(known, values, np.nan)


def codes_of(result: Result) -> Statuses:
    """Return the region of every cell: its status, or what a refusal says of it."""
    code = result.cell_status.copy()
    free = code == CellStatus.STABILIZED
    if result.status == Status.NOT_STABILIZABLE:
        code[free] = UNSOLVED
        if result.cause == Cause.GAMMA:
            code[free & (result.refusal_vector > 0)] = regions.INFINITE
    return code

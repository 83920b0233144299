"""Pictures of a study: what cost, coverage, runs and time become as a knob is turned."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from lmdsl.advice.studies.orders import held_of, width
from lmdsl.advice.studies.record import Study, StudyRow
from lmdsl.common import inputs
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.plotting import layers
from lmdsl.plotting.pages import writing
from lmdsl.plotting.view import number, plain

if TYPE_CHECKING:
    import os

    from matplotlib.figure import Figure


def _seconds(row: StudyRow) -> float | None:
    return (row.compile_seconds or 0.0) + (row.solve_seconds or 0.0) or None


# What each row of panels shows: title, value of a row, whether the axis is logarithmic.
PANELS: tuple[tuple[str, Any, bool], ...] = (
    ("cost", lambda row: row.cost, False),
    ("coverage", lambda row: row.coverage, False),
    ("share that arrives", lambda row: row.arrives, False),
    ("seconds", _seconds, True),
)
LABELS = {
    "cells": "cells an axis, in the mean",
    "samples": "sample points",
    "step": "step",
    "gamma": "gamma",
    "backend": "backend",
}
MOST_LINES, MOST_TICKS = 10, 8  # lines of a panel that are told apart, marks on an axis


@own_arithmetic
def study(found: Study, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw a study: a column for each knob that was turned, a line for each value of the others.

    Parameters
    ----------
    found
        What :func:`lmdsl.study` returned.
    path
        File to write, ending in .png, .pdf or .svg; it appears whole or not at all.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    BadInput
        The ending is unknown, or the file cannot be written.
    """
    inputs.kind(found, Study, "found", "a Study")
    target = writing.target(path)
    turned = [name for name in LABELS if len({str(getattr(r, name)) for r in found.rows}) > 1]
    knobs = turned or ["cells"]
    figure: Figure = layers.blank(0.95 * len(knobs) + 0.15, 0.6 * len(PANELS))
    axes = figure.subplots(len(PANELS), len(knobs), squeeze=False, sharex="col")
    for k, knob in enumerate(knobs):
        for ax, (title, read, log) in zip(axes[:, k], PANELS, strict=True):
            _panel(ax, found, knob, read, log)
            ax.set_ylabel(title if k == 0 else "")
        axes[-1, k].set_xlabel(LABELS[knob])
        if 1 < len(axes[0, k].get_lines()) <= MOST_LINES:
            axes[0, k].legend(fontsize="x-small", framealpha=0.5)
    figure.suptitle(plain(found.name, 100))
    writing.write(figure, target)
    return figure


def _panel(ax: Any, found: Study, knob: str, read: Any, log: bool) -> None:
    """Draw a quantity over a knob, a line for each value of the others."""
    for i, (label, rows) in enumerate(_groups(found, knob)):
        known = [(_place(row, knob), read(row)) for row in rows]
        known = [(x, y) for x, y in known if y is not None and math.isfinite(y)]
        if knob != "backend":
            known.sort()
        if known:
            ax.plot(*zip(*known, strict=True), f"C{i % 10}", marker="o", label=plain(label))
    if knob in ("cells", "samples", "step"):
        ax.set_xscale("log", base=2)
    if knob != "backend":
        ticks = sorted({_place(row, knob) for row in found.rows})[:MOST_TICKS]
        ax.set_xticks(ticks, [number(tick, 4) for tick in ticks])
        ax.minorticks_off()
    if log and ax.get_lines():
        ax.set_yscale("log")
    ax.grid(alpha=0.3)


def _groups(found: Study, knob: str) -> Iterator[tuple[str, list[StudyRow]]]:
    """Yield the rows that differ in a knob only, and what else tells them from the others."""
    groups: dict[str, list[StudyRow]] = {}
    for row in found.rows:
        groups.setdefault(str(held_of(row, knob)), []).append(row)
    for rows in groups.values():
        told = [
            f"{name} {'x'.join(map(str, value.values())) if name == 'cells' else value}"
            for name, value in held_of(rows[0], knob).items()
            if any(getattr(row, name) != value for row in found.rows)
        ]
        yield ", ".join(told), rows


def _place(row: StudyRow, knob: str) -> Any:
    """Return where a row is drawn on the axis of a knob."""
    if knob in ("cells", "samples"):
        return 1 / width(row, knob)
    return getattr(row, knob)

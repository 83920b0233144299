"""One page with all pictures of a result, and its key numbers."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lmdsl.common import inputs
from lmdsl.errors import BadInput
from lmdsl.machine import memory
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.plotting import layers, overlays
from lmdsl.plotting.motion import portrait, trajectories
from lmdsl.plotting.pages import writing
from lmdsl.plotting.plots import control, cost, measure
from lmdsl.plotting.proved import proofs
from lmdsl.plotting.quantities import bytes_of, view_of
from lmdsl.plotting.view import At, Projection, number, plain
from lmdsl.proof.record import Proof
from lmdsl.results.result import Result

if TYPE_CHECKING:
    import os

    from matplotlib.figure import Figure


@own_arithmetic
def figure(
    result: Result,
    path: str | os.PathLike[str] | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    project: Projection | None = None,
    seed: int = 0,
    proof: Proof | None = None,
) -> Figure:
    """Draw one page with everything: portrait, cost, controls, measure, runs and the numbers.

    Parameters
    ----------
    result
        A result of any status.
    path
        File to write, ending in .png, .pdf or .svg; it appears whole or not at all.
    axes, at
        Which axes are shown and where the others are held.
    project
        ``"worst"`` or ``"mean"``: project the axes neither shown nor held; None: hold them all.
    seed
        Seed of the closed-loop runs.
    proof
        What :meth:`Result.prove` returned: then it is drawn, too.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    BadInput
        The ending is unknown, or the file cannot be written.
    """
    seed = inputs.seed(seed)
    target = writing.target(path)
    view = view_of(result, axes, at, project)
    cut: Any = {"axes": axes, "at": at, "project": project}
    draw: list[Any] = []
    if len(view.axes) == 2 or view.whole:
        draw.append(lambda ax: portrait(result, ax=ax, axes=axes, at=at))
    draw.append(lambda ax: cost(result, ax, **cut))
    if (result.control_index >= 0).any():
        for name in result.problem.controls[:4]:
            draw.append(lambda ax, name=name: control(result, name, ax, **cut))
        draw.append(lambda ax: measure(result, ax, **cut))
        draw.append(lambda ax: trajectories(result, ax, seed=seed, axes=axes, at=at))
    if proof is not None:
        draw.append(lambda ax: proofs.proof(result, proof, ax, axes=axes, at=at))
    draw.append(lambda ax: _numbers(ax, result))
    memory.require(bytes_of(view, 300 + 60 * len(draw)) + writing.PAGE, "plots")
    columns = min(len(draw), 3)
    rows = -(-len(draw) // columns)
    page: Figure = layers.blank(columns, rows)
    for k, panel in enumerate(draw):
        ax = page.add_subplot(rows, columns, k + 1)
        try:
            panel(ax)
        except BadInput as error:  # such as a Python function that a directory does not hold
            overlays.remark(ax, textwrap.fill(plain(error.message, 200), 36))
    page.suptitle(plain(result.problem.name, 100), fontsize=13)
    writing.write(page, target)
    return page


def _numbers(ax: Any, result: Result) -> None:
    """Write the status and the key numbers."""

    def known(value: float | None, digits: int = 6) -> str:
        return "unknown" if value is None else number(value, digits)

    covered, cells = result.coverage, str(result.cells)
    if covered is not None:
        cells = f"{covered.stabilizable} of {covered.free} free stabilizable"
    rows = [
        ("status", result.status.replace("_", " ")),
        ("backend", plain(result.backend or "none", 30)),
        ("gamma", known(result.gamma)),
        ("cost", known(result.cost)),
        ("lower bound", known(result.lower_bound)),
        ("gap", known(result.gap, 2)),
        ("contraction", known(result.contraction)),
        ("cells", cells),
        ("attractor", f"{result.attractor_cells} cell{'s' if result.attractor_cells != 1 else ''}"),
        ("controls", known(result.controls)),
    ]
    ax.set_axis_off()
    for k, (name, value) in enumerate(rows):
        y = 0.97 - 0.075 * k
        ax.text(0.02, y, name, transform=ax.transAxes, va="top", color="#666666")
        ax.text(0.38, y, value, transform=ax.transAxes, va="top", color=layers.INK)
    message = textwrap.fill(plain(result.message, 300), 46)
    y = 0.97 - 0.075 * (len(rows) + 0.5)
    ax.text(0.02, y, message, transform=ax.transAxes, va="top", fontsize=9, color=layers.INK)

"""One quantity in many panels: slices along one or two axes, projections onto all pairs of axes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.plotting import layers, quantities, regions
from lmdsl.plotting.pages import writing
from lmdsl.plotting.quantities import Quantity, bytes_of, view_of
from lmdsl.plotting.view import At, Projection, View, plain
from lmdsl.results.result import Result

if TYPE_CHECKING:
    import os

    from matplotlib.figure import Figure

MOST = 64  # panels of a page
SLICES = (6, 4)  # slices along an axis, where one is cut through, and where two are

Cuts = Mapping[str, float | Sequence[float]]


@own_arithmetic
def slices(
    result: Result,
    draw: str = "cost",
    name: str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    axes: Sequence[str] | None = None,
    at: Cuts | None = None,
    panels: int | None = None,
) -> Figure:
    """Draw one quantity on slices along one or two axes, all in the same colours.

    One of the slices passes through the attractor, where their places are not given.

    Parameters
    ----------
    result
        A result of any status, of three axes or more.
    draw
        ``"cost"``, ``"control"``, ``"measure"`` or ``"coverage"``.
    name
        The control variable; default: the first.
    path
        File to write, ending in .png, .pdf or .svg; it appears whole or not at all.
    axes
        The one or two axes shown; default: the first two.
    at
        Of other axes the one place where they are held, or a list: the slices. Default: slices
        along the first two of the other axes, which are not held.
    panels
        Number of slices along an axis; default: 6, or 4 along each of two.

    Returns
    -------
    matplotlib.figure.Figure
    """
    target = writing.target(path)
    inputs.kind(result, Result, "result", "a Result")
    inputs.kind({} if at is None else at, Mapping, "at", "a mapping; write {axis: value}")
    quantity = quantities.of_result(result, draw, name)
    fixed: dict[str, Any] = {k: v for k, v in (at or {}).items() if not _several(v)}
    view = view_of(result, axes, fixed)
    grid = _levels(view, dict(at or {}), panels)
    rows, columns = [len(level) for _, level in grid] if len(grid) == 2 else _table(len(grid[0][1]))
    views = [view.moved(dict(pairs)) for pairs in itertools.product(*map(_indexed, grid))]
    names = view.partition.names
    along = " and ".join(plain(names[k], 16) for k, _ in grid)
    return _page(
        result, quantity, views, (rows, columns), [each.held for each in views],
        f"{quantity.title}, slices along {along}", target,
    )  # fmt: skip


@own_arithmetic
def projections(
    result: Result,
    draw: str = "cost",
    name: str | None = None,
    path: str | os.PathLike[str] | None = None,
    *,
    at: At | None = None,
    project: Projection = "worst",
) -> Figure:
    """Draw one quantity projected onto every pair of axes, all in the same colours.

    Parameters
    ----------
    result
        A result of any status, of two axes or more.
    draw, name, path
        As for :func:`slices`; of ``"coverage"`` the share is drawn.
    at
        Axes that are held instead, and where.
    project
        ``"worst"`` or ``"mean"``, of the stabilizable cells that lie over each cell shown.

    Returns
    -------
    matplotlib.figure.Figure
    """
    target = writing.target(path)
    inputs.kind(result, Result, "result", "a Result")
    quantity = quantities.of_result(result, draw, name)
    how: Projection = "mean" if draw == "coverage" else project
    inputs.kind({} if at is None else at, Mapping, "at", "a mapping; write {axis: value}")
    free = [axis for axis in result.partition.names if axis not in (at or {})]
    pairs: list[tuple[str, ...]] = list(itertools.combinations(free, 2)) or [tuple(free)]
    views = [view_of(result, pair, at, how) for pair in pairs[:MOST]]
    word = "share" if draw == "coverage" else how
    title = quantity.title + f", {word} over the axes not shown" * (not views[0].whole)
    title += f" ({views[0].held})" * bool(views[0].hidden)
    return _page(result, quantity, views, _table(len(views)), [], title, target)


def _page(
    result: Result,
    quantity: Quantity,
    views: list[View],
    table: tuple[int, int],
    titles: list[str],
    title: str,
    target: writing.Target,
) -> Figure:
    """Draw a panel for each view, a colour bar and a legend for all."""
    memory.require(sum(bytes_of(view, 150) for view in views) + writing.PAGE, "plots")
    rows, columns = table
    page: Figure = layers.blank(0.66 * columns + 0.35, 0.75 * rows + 0.25)
    among = np.concatenate([quantity.over(view).ravel() for view in views])
    code, picture = quantity.codes(result), None
    handles: dict[str, Any] = {}
    panels: list[Any] = []
    for k, view in enumerate(views):
        ax = page.add_subplot(rows, columns, k + 1)
        layers.frame(ax, view, titles[k] if titles else "")
        ax.title.set_fontsize(9)
        picture = quantity.draw(ax, view, among) or picture
        for handle in regions.regions(ax, view, code, legend=False):
            handles.setdefault(handle.get_label(), handle)
        panels.append(ax)
    if len(views[0].axes) == 1:
        _same_height(panels)
    if titles:  # all show the same axes
        for ax in panels:
            ax.label_outer()
    if picture is not None:
        layers.shared_bar(panels, picture)
    if handles:
        page.legend(
            handles=list(handles.values()),
            loc="outside lower center",
            ncols=2 * columns,
            frameon=False,
        )
    page.suptitle(f"{plain(result.problem.name, 80)}\n{title}".strip(), fontsize=12)
    writing.write(page, target)
    return page


def _same_height(panels: list[Any]) -> None:
    """Give panels of curves the same ordinate."""
    drawn = [ax for ax in panels if ax.patches and ax.get_ylabel()] or panels
    scale = "log" if any(ax.get_yscale() == "log" for ax in drawn) else "linear"
    low = min(ax.get_ylim()[0] for ax in drawn)
    high = max(ax.get_ylim()[1] for ax in drawn)
    for ax in panels:
        ax.set_yscale(scale)
        ax.set_ylim(low, high)


def _several(value: Any) -> bool:
    return isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes)


def _levels(view: View, at: dict[str, Any], panels: int | None) -> list[tuple[int, list[int]]]:
    """Return the axes along which slices are cut, and the cells of these."""
    p = view.partition
    along = [p.names.index(name) for name in at if _several(at[name]) and name in p.names]
    unknown = [name for name in at if name not in p.names]
    if unknown:
        raise BadInput(
            f"{shown(unknown[0])} is not an axis; the axes are {', '.join(p.names)}", "at"
        )
    if not along:
        along = [k for k in view.hidden if p.names[k] not in at][:2]
    if not along:
        raise BadInput("every axis is shown or held: there is none to cut along", "axes")
    if len(along) > 2 or set(along) & set(view.axes):
        raise BadInput("cut along one or two axes that are not shown", "at")
    count = SLICES[len(along) - 1] if panels is None else int(inputs.whole(panels, "panels"))
    found = [(k, _cells(view, k, at.get(p.names[k]), count)) for k in along]
    if (total := int(np.prod([len(cells) for _, cells in found]))) > MOST:
        raise BadInput(f"{total} panels do not fit on a page; {MOST} do", "panels")
    return found


def _cells(view: View, k: int, places: Any, count: int) -> list[int]:
    """Return cells of an axis: those of places, or some evenly spread and the one held."""
    p = view.partition
    if places is not None:
        name = p.names[k]
        x = inputs.states({name: list(places)}, [name], "at")[..., 0].ravel()
        point: list[Any] = [np.full(len(x), value) for value in p.low + (view.cell + 0.5) * p.width]
        point[k] = x
        found = p.locate(point, clip=False)
        if not len(x) or (found < 0).any():
            raise BadInput(f"{shown({name: list(places)})} lies outside the state box", "at")
        return [int(i) for i in p.multi_index(found)[k]]
    n, own = int(p.cells[k]), int(view.cell[k])
    cells = np.unique(((np.arange(min(count, n)) + 0.5) * n / min(count, n)).astype(int))
    cells[np.abs(cells - own).argmin()] = own
    return [int(i) for i in np.unique(cells)]


def _indexed(level: tuple[int, list[int]]) -> list[tuple[int, int]]:
    return [(level[0], cell) for cell in level[1]]


def _table(count: int) -> tuple[int, int]:
    columns = min(count, 3)
    return -(-count // columns), columns

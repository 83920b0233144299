"""Ink on top of the cells: orbits, runs, the graph of a map, remarks."""

from typing import Any

import numpy as np

from lmdsl.common.types import Bools, Floats
from lmdsl.plotting.layers import CYCLE, FAINT, INK
from lmdsl.plotting.view import View, segments


def remark(ax: Any, text: str) -> None:
    """Write a remark into the middle of axes."""
    ax.text(
        0.5,
        0.5,
        text,
        transform=ax.transAxes,
        ha="center",
        va="center",
        color=INK,
        zorder=5,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85},
    )


def orbits(ax: Any, view: View, points: Floats, height: Floats, lines: bool) -> None:
    """Draw runs, shape (T, r, d), coloured by height in [0, 1]: as lines or as dots."""
    import matplotlib
    from matplotlib.collections import LineCollection

    colours = matplotlib.colormaps["viridis"](0.95 * height)
    if lines:
        pieces: Any
        pieces, run = segments(points, view)
        ax.add_collection(
            LineCollection(pieces, colors=colours[run], linewidths=0.8, rasterized=True)
        )
        return
    order = np.random.default_rng(0).permutation(points[..., 0].size)
    x, y = (points[..., k].ravel()[order] for k in view.axes)
    colour = np.tile(colours, (len(points), 1))[order]
    ax.scatter(x, y, c=colour, s=1.4, linewidths=0, rasterized=True)


def runs(
    ax: Any, view: View, points: Floats, reached: Bools, lost: Bools, lines: bool, pieces: int
) -> None:
    """Draw closed-loop runs with their starts and ends; one axis is drawn over the step."""
    from matplotlib.collections import LineCollection

    count = points.shape[1]
    colours = np.array(CYCLE)[np.arange(count) % len(CYCLE)]
    where = points[..., list(view.axes)]
    joined: Any
    if len(view.axes) == 1:
        step = np.arange(len(points))[:, None, None] / pieces
        where = np.concatenate([np.broadcast_to(step, where.shape), where], axis=-1)
        joined = np.stack([where[:-1], where[1:]], axis=-2).reshape(-1, 2, 2)
        run = np.tile(np.arange(count), len(points) - 1)
        wrapped = np.abs(np.diff(joined[..., 1], axis=1)[:, 0]) > np.ptp(view.ends(0)) / 2
        keep = ~(wrapped & view.partition.periodic[view.axes[0]])
        joined, run = joined[keep], run[keep]
    else:
        joined, run = segments(points, view)
    width, alpha = (1.1, 0.9) if lines else (0.6, 0.45)
    ax.add_collection(
        LineCollection(joined, colors=colours[run], linewidths=width, alpha=alpha, zorder=2)
    )
    if not lines:
        x, y = where.reshape(-1, 2).T
        ax.scatter(x, y, c=np.tile(colours, len(points)), s=9, linewidths=0, zorder=2.2)
    last = np.isfinite(points).all(axis=-1).cumsum(axis=0).argmax(axis=0)
    end = where[last, np.arange(count)]
    x, y = where[0].T
    ax.scatter(x, y, s=22, facecolors="white", edgecolors=colours, zorder=2.5)
    ax.scatter(end[reached, 0], end[reached, 1], s=14, c=INK, linewidths=0, zorder=4)
    ax.scatter(end[lost, 0], end[lost, 1], s=34, c=INK, marker="x", linewidths=1.4, zorder=4)


def graph(ax: Any, view: View, x: Floats, image: Floats, orbit: Floats) -> None:
    """Draw the graph of a map of one axis, the diagonal, and the cobweb of an orbit."""
    low, high = view.ends(0)
    ax.set_ylim(low, high)
    ax.set_ylabel(f"next {view.label(0)}")
    if view.partition.periodic[0]:
        image = view.partition.axes[0].state(image, clip=False)
        image[1:][np.abs(np.diff(image)) > (high - low) / 2] = np.nan
    ax.plot([low, high], [low, high], color=FAINT, linewidth=0.8)
    ax.plot(x, image, color=CYCLE[0], linewidth=1.8)
    web = np.repeat(orbit[np.isfinite(orbit)], 2)
    ax.plot(web[:-2], web[1:-1], color=CYCLE[1], linewidth=0.6, alpha=0.8)

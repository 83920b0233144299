"""What every plot is made of: slices of the cells, coloured regions, colour bars, safe text.

Figures use matplotlib's objects on an Agg canvas; its global state (pyplot) is never touched, so
plots need no display and leave nothing behind. matplotlib is imported only when something is drawn.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput, MissingDependency, shown
from lmdsl.graph import CellStatus
from lmdsl.partition import Partition

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DECADES, DEEPEST = 2, 8
"""Colours are logarithmic from so many decades on, and span no more than so many."""

INK = "#222222"
ATTRACTOR = "#ff2fa0"
CYCLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555")
UNSOLVED, INFINITE = 6, 7
REGIONS: dict[int, tuple[str, str, str]] = {
    UNSOLVED: ("stabilizable", "#dcebf7", ""),
    INFINITE: ("no finite cost", "#fde6cf", "---"),
    CellStatus.ESCAPES: ("escapes", "#dadada", "////"),
    CellStatus.TRAPPED: ("trapped", "#bdbdbd", "...."),
    CellStatus.LEADS_TO_THESE: ("leads to these", "#f1f1f1", "\\\\\\\\"),
    CellStatus.AVOID: ("avoid", "#4d4d4d", ""),
    CellStatus.ATTRACTOR: ("attractor", ATTRACTOR, ""),
}
"""Region: name, colour, hatch; greys are cells that cannot be stabilized, by cause."""

MOST_HATCHED = 20_000


def plain(text: str, limit: int = 60) -> str:
    """Return user text that is safe to draw: one line, no control characters, no mathtext."""
    spaced = "".join(" " if c.isspace() else c for c in text)
    kept = "".join(c for c in spaced if unicodedata.category(c)[0] != "C")
    line = " ".join(kept.split())
    line = line if len(line) <= limit else line[: limit - 1] + "…"
    return line.replace("$", r"\$")


@dataclass(frozen=True)
class View:
    """One or two axes of the partition, the others held at one cell.

    Attributes
    ----------
    partition
        All cells.
    axes
        Positions of the axes shown.
    cell
        Multi-index of a cell in the slice, shape (d,).
    """

    partition: Partition
    axes: tuple[int, ...]
    cell: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        partition: Partition,
        attractor: Bools,
        axes: Sequence[str] | None = None,
        at: Mapping[str, float] | None = None,
    ) -> View:
        """Resolve a choice of axes; the default slice passes through the attractor's centre."""
        names, at = partition.names, at or {}
        chosen = tuple(names[:2] if axes is None else axes)
        for name in (*chosen, *at):
            if name not in names:
                raise BadInput(
                    f"{shown(name)} is not an axis; the axes are {', '.join(names)}", "axes"
                )
        if len(chosen) not in (1, 2) or len(set(chosen)) < len(chosen):
            raise BadInput(f"{shown(list(chosen))}: choose one or two different axes", "axes")
        if set(at) & set(chosen):
            raise BadInput(f"{shown(list(at))}: only axes that are not shown are held", "at")
        cells = np.flatnonzero(attractor)
        centres = partition.centres(cells)
        distance = np.abs((centres - centres.mean(axis=0)) / partition.width).sum(axis=1)
        point = centres[np.argmin(distance)].copy()
        for name, value in at.items():
            point[names.index(name)] = value
        inside = partition.locate([np.array([x]) for x in point], clip=False)
        if inside[0] < 0:
            raise BadInput(f"{shown(dict(at))} lies outside the state box", "at")
        cell = np.array(partition.multi_index(inside))[:, 0]
        return cls(partition, tuple(names.index(name) for name in chosen), cell)

    @property
    def hidden(self) -> tuple[int, ...]:
        """Positions of the axes not shown."""
        return tuple(k for k in range(self.partition.dimension) if k not in self.axes)

    @property
    def note(self) -> str:
        """Where the slice is, such as " (z ≈ 25.5)"; empty when every axis is shown."""
        p = self.partition
        at = p.low + (self.cell + 0.5) * p.width
        held = [f"{plain(p.names[k], 16)} ≈ {at[k]:.3g}" for k in self.hidden]
        return f" ({', '.join(held[:4])}{', …' if len(held) > 4 else ''})" if held else ""

    def label(self, k: int) -> str:
        """Return the label of the k-th axis shown."""
        return plain(self.partition.names[self.axes[k]], 32)

    def edges(self, k: int) -> Floats:
        """Return the edges of the cells on the k-th axis shown."""
        p, i = self.partition, self.axes[k]
        edges: Floats = p.low[i] + np.arange(p.cells[i] + 1) * p.width[i]
        return edges

    def ends(self, k: int) -> tuple[float, float]:
        """Return the ends of the k-th axis shown."""
        p, i = self.partition, self.axes[k]
        return float(p.low[i]), float(p.high[i])

    def slice(self, flat: NDArray[Any]) -> NDArray[Any]:
        """Return values over the cells shown, indexed in the order of the axes shown."""
        grid = flat.reshape(self.partition.shape).transpose(self.axes + self.hidden)
        return grid[(..., *self.cell[list(self.hidden)])]

    def shadow(self, mask: Bools) -> Bools:
        """Return where any cell over the axes not shown is marked."""
        grid = mask.reshape(self.partition.shape).transpose(self.axes + self.hidden)
        return grid.any(axis=tuple(range(len(self.axes), grid.ndim)))


def blank(columns: float = 1, rows: float = 1) -> Figure:
    """Return an empty figure on an Agg canvas.

    Raises
    ------
    MissingDependency
        matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingDependency('plots need matplotlib: pip install "lmdsl[plot]"') from None
    figure = Figure(figsize=(4.5 * columns + 0.3, 3.9 * rows + 0.3), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def frame(ax: Axes | None, view: View, title: str) -> Axes:
    """Return axes with the names and ends of a view, new ones if there are none."""
    ax = blank().add_subplot() if ax is None else ax
    ax.set_title(title, fontsize=11)
    ax.set_box_aspect(1)
    ax.set_xlabel(view.label(0))
    ax.set_xlim(*view.ends(0))
    if len(view.axes) == 2:
        ax.set_ylabel(view.label(1))
        ax.set_ylim(*view.ends(1))
    return ax


def rectangles(mask: Bools, x: Floats, y: Floats) -> Floats:
    """Return closed rectangles that cover the cells of a mask, runs along x merged, (R, 5, 2)."""
    edge = np.diff(np.pad(mask.astype(np.int8), ((1, 1), (0, 0))), axis=0).T
    row, first = np.nonzero(edge == 1)
    _, last = np.nonzero(edge == -1)
    x0, x1, y0, y1 = x[first], x[last], y[row], y[row + 1]
    return np.stack(
        [np.stack(c, axis=-1) for c in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))], axis=1
    )


def region(ax: Axes, view: View, mask: Bools, code: int, above: bool = False) -> Any:
    """Fill the cells of a mask (in the view's shape) as a region; return its legend handle."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    name, colour, hatch = REGIONS[code]
    flat = len(view.axes) == 1
    boxes = rectangles(
        mask[:, None] if flat else mask,
        view.edges(0),
        np.array([0.0, 1]) if flat else view.edges(1),
    )
    codes = np.tile([Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY], len(boxes))
    patch = PathPatch(
        Path(boxes.reshape(-1, 2), codes),
        facecolor=colour,
        edgecolor="#8c8c8c",
        hatch=(hatch or None) if len(boxes) <= MOST_HATCHED else None,
        linewidth=0,
        label=name,
        zorder=3 if above else 0.5,
        rasterized=len(boxes) > MOST_HATCHED,
        transform=ax.get_xaxis_transform() if flat else ax.transData,
    )
    ax.add_patch(patch)
    if code == CellStatus.ATTRACTOR and not flat:
        _ring(ax, view, mask)
    return patch


def _ring(ax: Axes, view: View, mask: Bools) -> None:
    """Outline the attractor, and ring its parts that are too small to see."""
    from matplotlib.collections import LineCollection
    from scipy.ndimage import find_objects, label

    x, y = view.edges(0), view.edges(1)
    padded = np.pad(mask, 1)
    i, j = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])
    vertical = np.stack([np.stack([x[i], y[j]], -1), np.stack([x[i], y[j + 1]], -1)], 1)
    i, j = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])
    level = np.stack([np.stack([x[i], y[j]], -1), np.stack([x[i + 1], y[j]], -1)], 1)
    lines = np.concatenate([vertical, level])
    ax.add_collection(LineCollection(lines, colors="white", linewidths=0.8, zorder=3.1))
    parts = find_objects(label(mask)[0])[:100]
    small = [p for p in parts if all((q.stop - q.start) / n < 0.03 for q, n in zip(p, mask.shape))]
    centres = [[(e[q.start] + e[q.stop]) / 2 for e, q in zip((x, y), p)] for p in small]
    if centres:
        style = {"marker": "o", "s": 75, "facecolors": "none", "zorder": 3.2}
        ax.scatter(*np.array(centres).T, edgecolors="white", linewidths=2.4, **style)
        ax.scatter(*np.array(centres).T, edgecolors=ATTRACTOR, linewidths=1.3, **style)


def regions(ax: Axes, view: View, code: NDArray[np.integer], legend: bool = True) -> None:
    """Fill every region of a slice: the attractor, and by cause what is not stabilized."""
    handles = [
        region(ax, view, code == k, k, above=k == CellStatus.ATTRACTOR)
        for k in REGIONS
        if (code == k).any()
    ]
    if not legend or not handles:
        return
    from matplotlib.transforms import ScaledTranslation

    below = ax.transAxes + ScaledTranslation(0, -36 / 72, ax.get_figure().dpi_scale_trans)
    ax.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        bbox_transform=below,
        ncols=min(len(handles), 3),
        frameon=False,
        fontsize=9,
        handlelength=1.6,
        columnspacing=1.2,
        borderpad=0,
        borderaxespad=0,
    )


def scalar(ax: Axes, view: View, values: Floats, label: str, colours: str) -> None:
    """Draw a positive quantity over the cells of a slice; NaN is left out.

    Colours (in one dimension the ordinate) are logarithmic when it spans more than two decades,
    and then zero takes the lowest colour.
    """
    from matplotlib.colors import LogNorm, Normalize

    known = values[np.isfinite(values)]
    positive = known[known > 0]
    low, high = (positive.min(), positive.max()) if len(positive) else (0.0, 1.0)
    logarithmic = low > 0 and high > 10.0**DECADES * low
    bottom = max(low, high * 10.0**-DEEPEST) if logarithmic else min(known.min(initial=0), 0)
    if len(view.axes) == 1:
        ax.stairs(values, view.edges(0), baseline=None, color=CYCLE[0], linewidth=1.6)
        ax.set_ylabel(label)
        if logarithmic:
            ax.set_yscale("log")
            ax.set_ylim(bottom / 1.5, high * 1.5)
        return
    if logarithmic:
        values = np.where(values <= 0, bottom / 2, values)
        norm = LogNorm(bottom, high)
    else:
        norm = Normalize(low if low > 0 and len(positive) == len(known) else 0.0, high)
    picture = image(ax, view, values, colours, norm)
    below = bool(logarithmic and (known < bottom).any())
    bar(ax, picture, label, extend="min" if below else "neither")


def levels(ax: Axes, view: View, values: Floats, grid: Floats, label: str) -> None:
    """Draw a quantity that takes the values of a grid, centred at 0 when it has both signs."""
    if len(view.axes) == 1:
        ax.stairs(values, view.edges(0), baseline=None, color=CYCLE[0], linewidth=1.6)
        ax.set_ylabel(label)
        room = 0.06 * (grid.max() - grid.min()) or 0.5
        ax.set_ylim(grid.min() - room, grid.max() + room)
        ax.axhline(0, color="#999999", linewidth=0.7, zorder=0.6)
        return
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    level = np.unique(grid)
    n = len(level)
    gaps = np.diff(level)
    even = n < 3 or bool(np.ptp(gaps) <= 1e-6 * gaps.max())
    zero = np.interp(0, level, np.arange(n))
    place = level if even else np.arange(n) - zero
    if level[0] < 0 < level[-1]:
        base, share = matplotlib.colormaps["RdBu_r"], 0.5 + 0.5 * place / np.abs(place).max()
    else:
        span = np.ptp(place) or 1.0
        base, share = matplotlib.colormaps["viridis"], (place - place[0]) / span
    half = gaps / 2 if n > 1 else np.array([0.5])
    edges = np.concatenate([[level[0] - half[0]], level[:-1] + gaps / 2, [level[-1] + half[-1]]])
    picture = image(ax, view, values, ListedColormap(base(share)), BoundaryNorm(edges, n))
    step = -(-n // 9)
    shown_levels = level[(np.arange(n) - round(float(zero))) % step == 0]
    colour_bar = bar(ax, picture, label, ticks=shown_levels, spacing="uniform")
    colour_bar.ax.set_yticklabels([f"{v:.3g}" for v in shown_levels])
    colour_bar.ax.minorticks_off()


def image(ax: Axes, view: View, values: Floats, colours: Any, norm: Any) -> Any:
    """Draw values (in the view's shape) as an image in the coordinates of the states."""
    return ax.imshow(
        np.ma.masked_invalid(values).T,
        origin="lower",
        extent=(*view.ends(0), *view.ends(1)),
        aspect="auto",
        interpolation="nearest",
        cmap=colours,
        norm=norm,
        zorder=1,
    )


def bar(ax: Axes, picture: Any, label: str, **options: Any) -> Any:
    """Add a colour bar exactly as high as the axes."""
    made = ax.get_figure().colorbar(picture, cax=ax.inset_axes((1.04, 0, 0.05, 1)), **options)
    made.set_label(label)
    return made


def remark(ax: Axes, text: str) -> None:
    """Write a remark into the middle of axes."""
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85}
    ax.text(
        0.5,
        0.5,
        text,
        transform=ax.transAxes,
        ha="center",
        va="center",
        bbox=box,
        zorder=5,
        color=INK,
    )


def segments(points: Floats, view: View) -> tuple[Floats, NDArray[np.int64]]:
    """Join successive states of runs by lines that break where a periodic axis wraps.

    Parameters
    ----------
    points
        Shape (T, r, d): r runs, NaN from where a run has ended.
    view
        The axes to draw.

    Returns
    -------
    segments, run
        Shape (S, 2, 2) and (S,). A line across a seam leaves on one side and, as a second
        segment, enters on the other; it takes the shorter way round.
    """
    p, axes = view.partition, list(view.axes)
    span = np.where(p.periodic, p.high - p.low, np.inf)[axes]
    a, b = points[:-1][..., axes], points[1:][..., axes]
    step = b - a
    turns = np.where(np.isfinite(span), np.round(step / span), 0.0)
    step = step - np.where(turns != 0, turns * np.where(np.isfinite(span), span, 0.0), 0.0)
    run = np.broadcast_to(np.arange(points.shape[1]), a.shape[:2])
    there = np.isfinite(step).all(axis=-1)
    seam = there & (turns != 0).any(axis=-1)
    leave = np.stack([a, a + step], axis=-2)
    enter = np.stack([b - step, b], axis=-2)
    return np.concatenate([leave[there], enter[seam]]), np.concatenate([run[there], run[seam]])

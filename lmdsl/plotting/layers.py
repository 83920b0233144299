"""Layers of ink: frames, regions of cells, images with colour bars, runs.

Figures use matplotlib's objects on an Agg canvas; its global state (pyplot) is never touched, so
plots need no display and leave nothing behind. matplotlib is imported only when something is
drawn. A layer takes any matplotlib axes.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput, MissingDependency, shown
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting.view import View, number, rectangles

# Colours are logarithmic from so many decades on, and span no more than so many.
DECADES, DEEPEST = 2, 8

INK, FAINT, HATCH = "#222222", "#999999", "#8c8c8c"
ATTRACTOR, SURE = "#ff2fa0", "#ff8c00"
CYCLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555")
UNSOLVED, INFINITE = 7, int(CellStatus.BEYOND_GAMMA)
# Region: name, colour, hatch; greys are cells that cannot be stabilized, by cause.
REGIONS: dict[int, tuple[str, str, str | None]] = {
    UNSOLVED: ("stabilizable", "#dcebf7", None),
    INFINITE: ("no finite cost", "#fde0c2", None),
    CellStatus.ESCAPES: ("escapes", "#dadada", "////"),
    CellStatus.TRAPPED: ("trapped", "#bdbdbd", "...."),
    CellStatus.LEADS_TO_THESE: ("leads to these", "#f1f1f1", "\\\\\\\\"),
    CellStatus.AVOID: ("avoid", "#4d4d4d", None),
    CellStatus.ATTRACTOR: ("attractor", ATTRACTOR, None),
}

# Number of runs of cells above which a region is drawn as an image, without hatch.
MOST_RUNS = 5_000
MOST_LEVELS = 11  # that a colour bar names


def blank(columns: float = 1, rows: float = 1) -> Any:
    """Return an empty figure on an Agg canvas.

    MissingDependency without matplotlib; BadInput where the environment names a backend it does not
    know.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError:
        raise MissingDependency('plots need matplotlib: pip install "lmdsl[plot]"') from None
    except ValueError:
        backend = shown(os.environ.get("MPLBACKEND"))
        raise BadInput(
            f"{backend} is no backend of matplotlib here; unset it", "MPLBACKEND"
        ) from None
    figure = Figure(
        figsize=(4.4 * columns + 0.3, 3.9 * rows + 0.3),
        dpi=110,
        layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1),
    )
    FigureCanvasAgg(figure)
    return figure


def frame(ax: Any, view: View, title: str) -> Any:
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


def region(ax: Any, view: View, mask: Bools, code: int, upright: bool = True) -> Any:
    """Fill the cells of a mask (in the view's shape) as a region; return its legend handle.

    One axis makes bands across the other direction, vertical ones if ``upright``.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch, PathPatch
    from matplotlib.path import Path

    name, colour, hatch = REGIONS[code]
    flat = len(view.axes) == 1
    across = np.array([0.0, 1.0])
    boxes = rectangles(
        mask.reshape(len(mask), -1), view.edges(0), across if flat else view.edges(1)
    )
    if len(boxes) > MOST_RUNS and not flat:
        image(ax, view, np.where(mask, 1.0, np.nan), ListedColormap([colour])).set_zorder(0.5)
        return Patch(facecolor=colour, label=name)
    place = ax.transData
    if flat:
        place = ax.get_xaxis_transform() if upright else ax.get_yaxis_transform()
        boxes = boxes if upright else boxes[..., ::-1]
    codes = np.tile([Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY], len(boxes))
    patch = PathPatch(
        Path(boxes.reshape(-1, 2), codes),
        facecolor=colour,
        edgecolor=HATCH,
        hatch=hatch,
        linewidth=0,
        label=name,
        zorder=0.5,
        transform=place,
    )
    ax.add_patch(patch)
    return patch


def outline(
    ax: Any, view: View, mask: Bools, colour: str, width: float = 0.9, rings: bool = True
) -> None:
    """Outline the attractor, and ring its parts that are too small to see."""
    from matplotlib.collections import LineCollection
    from scipy.ndimage import find_objects, label

    x, y = view.edges(0), view.edges(1)
    padded = np.pad(mask, 1)
    i, j = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])
    upright = np.stack([np.stack([x[i], y[j]], -1), np.stack([x[i], y[j + 1]], -1)], 1)
    i, j = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])
    level = np.stack([np.stack([x[i], y[j]], -1), np.stack([x[i + 1], y[j]], -1)], 1)
    lines: Any = np.concatenate([upright, level])
    ax.add_collection(LineCollection(lines, colors=colour, linewidths=width, zorder=3.1))
    for part in find_objects(label(mask)[0])[:100] if rings else ():
        if all((q.stop - q.start) < 0.03 * n for q, n in zip(part, mask.shape, strict=True)):
            centre = [(e[q.start] + e[q.stop]) / 2 for e, q in zip((x, y), part, strict=True)]
            for ink, size in (("white", 2.4), (ATTRACTOR, 1.3)):
                ring = {"facecolors": "none", "edgecolors": ink, "linewidths": size}
                ax.scatter(*centre, s=75, zorder=3.2, **ring)


def frames(ax: Any, view: View, boxes: Sequence[Mapping[str, tuple[float, float]]]) -> None:
    """Outline the boxes (ends by axis name) that meet the slice; split at a seam."""
    from matplotlib.patches import Rectangle

    p = view.partition
    centre = p.low + (view.cell + 0.5) * p.width
    for box in boxes:
        held = [box[p.names[k]] for k in view.hidden]
        turns = (p.high - p.low)[list(view.hidden)]
        if not all(
            low <= x <= high or low <= x + turn <= high
            for (low, high), x, turn in zip(held, centre[list(view.hidden)], turns, strict=True)
        ):
            continue
        parts = []
        for k in view.axes:
            (low, high), end = box[p.names[k]], float(p.high[k])
            seam = high > end + 1e-9 * float(p.width[k])
            whole = [(low, high)]
            parts.append([(low, end), (float(p.low[k]), high - end + p.low[k])] if seam else whole)
        for x in parts[0]:
            for y in parts[1] if len(parts) == 2 else [(0.0, 1.0)]:
                place = ax.transData if len(parts) == 2 else ax.get_xaxis_transform()
                ax.add_patch(
                    Rectangle(
                        (x[0], y[0]), x[1] - x[0], y[1] - y[0],
                        fill=False, edgecolor=INK, linewidth=1.0, zorder=3, transform=place,
                    )
                )  # fmt: skip


def regions(
    ax: Any,
    view: View,
    code: NDArray[np.integer],
    legend: bool,
    upright: bool = True,
    sure: Bools | None = None,
) -> None:
    """Fill every region of a slice: the attractor, and by cause what is not stabilized.

    ``sure`` are the cells around which a line runs: from them some controller surely arrives.
    """
    handles = [region(ax, view, code == k, k, upright) for k in REGIONS if (code == k).any()]
    if sure is not None and sure.any():
        handles.append(_around(ax, view, sure))
    if len(view.axes) == 2:
        outline(ax, view, code == CellStatus.ATTRACTOR, "white")
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


def _around(ax: Any, view: View, mask: Bools) -> Any:
    """Draw a line around cells, in one dimension below them; return its legend handle."""
    from matplotlib.lines import Line2D

    line: dict[str, Any] = {"color": SURE, "linewidth": 2.2}
    if len(view.axes) == 2:
        outline(ax, view, mask, SURE, 1.6, rings=False)
    else:
        for box in rectangles(mask[:, None], view.edges(0), np.array([0.0, 1.0])):
            ax.plot(
                box[:2, 0], [0.012, 0.012], transform=ax.get_xaxis_transform(), zorder=3, **line
            )
    return Line2D([], [], label="surely arrives", **line)


def scalar(ax: Any, view: View, values: Floats, label: str, colours: str) -> None:
    """Draw a quantity >= 0 over the cells of a slice; NaN is left out.

    Colours (in one dimension the ordinate) are logarithmic when it spans more than two decades;
    zero then takes the lowest colour.
    """
    from matplotlib.colors import LogNorm, Normalize

    known = values[np.isfinite(values)]
    positive = known[known > 0]
    low, high = (positive.min(), positive.max()) if len(positive) else (0.0, 1.0)
    logarithmic = bool(low > 0 and high > 10.0**DECADES * low)
    bottom = max(low, high * 10.0**-DEEPEST)
    if len(view.axes) == 1:
        _steps(ax, view, values, label)
        if logarithmic:
            ax.set_yscale("log")
            ax.set_ylim(bottom / 1.5, high * 1.5)
        return
    if logarithmic:
        picture = image(ax, view, np.where(values <= 0, bottom / 2, values), colours)
        picture.set_norm(LogNorm(bottom, high))
    else:
        picture = image(ax, view, values, colours)
        first = known.min(initial=high)
        picture.set_norm(Normalize(first if first < high else 0.0, high))
    bar(ax, picture, label, extend="min" if logarithmic and (known < bottom).any() else "neither")


def levels(ax: Any, view: View, values: Floats, grid: Floats, label: str) -> None:
    """Draw a quantity that takes the values of a grid, centred at 0 when it has both signs."""
    if len(view.axes) == 1:
        _steps(ax, view, values, label)
        margin = 0.06 * float(np.ptp(grid)) or 0.5
        ax.set_ylim(grid.min() - margin, grid.max() + margin)
        ax.axhline(0, color=FAINT, linewidth=0.7, zorder=0.6)
        return
    import matplotlib
    from matplotlib.colors import BoundaryNorm, ListedColormap

    level = np.unique(grid)
    n, gaps = len(level), np.diff(level)
    even = n < 3 or bool(np.ptp(gaps) <= 1e-6 * gaps.max())
    zero = np.interp(0, level, np.arange(n))
    place = level if even else np.arange(n) - zero
    if level[0] < 0 < level[-1]:
        colours = matplotlib.colormaps["RdBu_r"](0.5 + 0.5 * place / np.abs(place).max())
    else:
        colours = matplotlib.colormaps["viridis"]((place - place[0]) / (np.ptp(place) or 1.0))
    half = gaps / 2 if n > 1 else np.array([0.5])
    edges = np.concatenate([[level[0] - half[0]], level[1:] - gaps / 2, [level[-1] + half[-1]]])
    picture = image(ax, view, values, ListedColormap(colours))
    picture.set_norm(BoundaryNorm(edges, n))
    kept = _thinned(n, round(float(zero)))
    middle = (edges[:-1] + edges[1:]) / 2
    colour_bar = bar(ax, picture, label, ticks=middle[kept], spacing="uniform")
    colour_bar.ax.minorticks_off()
    colour_bar.set_ticklabels([number(v) for v in level[kept]])


def _thinned(n: int, zero: int) -> Indices:
    """Return MOST_LEVELS of n at most, evenly spaced through ``zero``, with both ends if so."""
    step = -(-n // MOST_LEVELS)
    both = [s for s in range(step, 2 * step) if zero % s == 0 and (n - 1 - zero) % s == 0]
    step = both[0] if both else step
    return np.arange(zero % step, n, step)


def _steps(ax: Any, view: View, values: Floats, label: str) -> None:
    ax.stairs(values, view.edges(0), baseline=None, color=CYCLE[0], linewidth=1.6)
    ax.set_ylabel(label)


def image(ax: Any, view: View, values: Floats, colours: Any) -> Any:
    """Draw values (in the view's shape) as an image in the coordinates of the states.

    Those over one axis have a second one of any length, and fill the height from 0 to 1.
    """
    upwards = view.ends(1) if len(view.axes) == 2 else (0.0, 1.0)
    return ax.imshow(
        np.ma.masked_invalid(values).T,
        origin="lower",
        extent=(*view.ends(0), *upwards),
        aspect="auto",
        interpolation="nearest",
        cmap=colours,
        zorder=1,
    )


def bar(ax: Any, picture: Any, label: str, **options: Any) -> Any:
    """Add a colour bar exactly as high as the axes."""
    made = ax.get_figure().colorbar(picture, cax=ax.inset_axes((1.04, 0, 0.05, 1)), **options)
    made.set_label(label)
    return made

"""Regions of cells: the attractor, what is to be avoided, and by cause what is not stabilized."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting.layers import INK, image
from lmdsl.plotting.view import UNSOLVED, View, rectangles

HATCH = "#8c8c8c"
ATTRACTOR, SURE = "#ff2fa0", "#ff8c00"
INFINITE = int(CellStatus.BEYOND_GAMMA)
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
    ax: Any, view: View, mask: Bools, colour: str, width: float = 0.9, rings: bool = True,
    dashed: bool = False,
) -> None:  # fmt: skip
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
    style: Any = (0, (4, 2.5)) if dashed else "solid"
    ax.add_collection(
        LineCollection(lines, colors=colour, linewidths=width, zorder=3.1, linestyles=style)
    )
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
    status: NDArray[np.integer],
    legend: bool,
    upright: bool = True,
    sure: Bools | None = None,
) -> list[Any]:
    """Fill every region of a view: the attractor, and by cause what is not stabilized.

    Parameters
    ----------
    ax, view
        Axes, and what they show.
    status
        Codes of all cells, shape (N,).
    legend
        Explain the regions below the axes.
    upright
        In one dimension, bands are vertical.
    sure
        The cells around which a line runs: from them some controller surely arrives, shape (N,).

    Returns
    -------
    handles
        Of the legend.
    """
    code = view.codes(status)
    partly = view.some(status == CellStatus.AVOID) & (code != CellStatus.AVOID)
    handles = _filled(ax, view, code, partly, upright)
    if sure is not None and (around := view.some(sure)).any():
        handles.append(_around(ax, view, around))
    if len(view.axes) == 2:
        attractor = view.some(status == CellStatus.ATTRACTOR)
        outline(ax, view, attractor, "white" if not view.away else ATTRACTOR)
        if (attractor & (code != CellStatus.ATTRACTOR)).any():
            handles.append(_line(label="attractor", color=ATTRACTOR, linewidth=1.2))
    if legend:
        explain(ax, handles)
    return handles


def obstacles(
    ax: Any, view: View, attractor: Bools, avoid: Bools, legend: bool, upright: bool = True
) -> None:
    """Fill where attractor and avoid cells lie, over all axes that are not shown.

    The masks have shape (N,).
    """
    code = np.full(view.shadow(attractor).shape, CellStatus.STABILIZED, dtype=np.uint8)
    code[view.core(avoid)] = CellStatus.AVOID
    partly = view.shadow(avoid) & (code != CellStatus.AVOID)
    code[view.shadow(attractor)] = CellStatus.ATTRACTOR
    handles = _filled(ax, view, code, partly, upright)
    if legend:
        explain(ax, handles)


def _filled(
    ax: Any, view: View, code: NDArray[np.integer], partly: Bools, upright: bool
) -> list[Any]:
    """Fill the regions of cells shown; outline where some of what lies over them is avoided."""
    handles = [region(ax, view, code == k, k, upright) for k in REGIONS if (code == k).any()]
    if partly.any() and len(view.axes) == 2:
        outline(ax, view, partly, "white", 2.6, rings=False)
        outline(ax, view, partly, INK, 1.2, rings=False, dashed=True)
        handles.append(_line(label="avoid, in part", color=INK, linewidth=1.2, linestyle="--"))
    return handles


def explain(ax: Any, handles: list[Any]) -> None:
    """Name regions below axes."""
    if not handles:
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
    line: dict[str, Any] = {"color": SURE, "linewidth": 2.2}
    if len(view.axes) == 2:
        outline(ax, view, mask, SURE, 1.6, rings=False)
    else:
        for box in rectangles(mask[:, None], view.edges(0), np.array([0.0, 1.0])):
            ax.plot(
                box[:2, 0], [0.012, 0.012], transform=ax.get_xaxis_transform(), zorder=3, **line
            )
    return _line(label="surely arrives", **line)


def _line(**look: Any) -> Any:
    """Return a line for a legend."""
    from matplotlib.lines import Line2D

    return Line2D([], [], **look)

"""Layers of ink: frames, images with colour bars.

Figures use matplotlib's objects on an Agg canvas; its global state (pyplot) is never touched, so
plots need no display and leave nothing behind. matplotlib is imported only when something is
drawn. A layer takes any matplotlib axes.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from lmdsl.common.optional import installed
from lmdsl.common.types import Floats, Indices
from lmdsl.errors import BadInput, MissingDependency, shown
from lmdsl.plotting.view import View, number

# Colours are logarithmic from so many decades on, and span no more than so many.
DECADES, DEEPEST = 2, 8

INK, FAINT = "#222222", "#999999"
CYCLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#555555")
MOST_LEVELS = 11  # that a colour bar names

_apart: ContextVar[bool] = ContextVar("apart", default=False)


def blank(columns: float = 1, rows: float = 1) -> Any:
    """Return an empty figure on an Agg canvas.

    MissingDependency without matplotlib; BadInput where the environment names a backend it does not
    know.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        from lmdsl.plotting.shown import Picture, offer
    except ImportError:
        raise MissingDependency(f"plots need matplotlib: {installed('plot')}") from None
    except ValueError:
        backend = shown(os.environ.get("MPLBACKEND"))
        raise BadInput(
            f"{backend} is no backend of matplotlib here; unset it", "MPLBACKEND"
        ) from None
    figure = Picture(
        figsize=(4.4 * columns + 0.3, 3.9 * rows + 0.3),
        dpi=110,
        layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1),
    )
    FigureCanvasAgg(figure)
    if not _apart.get():
        offer(figure)
    return figure


@contextmanager
def apart() -> Iterator[None]:
    """Make figures that no notebook shows by themselves: parts of something else."""
    token = _apart.set(True)
    try:
        yield
    finally:
        _apart.reset(token)


def frame(ax: Any, view: View, title: str) -> Any:
    """Return axes with the names and ends of a view, new ones if there are none."""
    if ax is None:
        figure = blank()
        from lmdsl.plotting.shown import Panel

        ax = figure.add_subplot(axes_class=Panel)
    ax.set_title(title, fontsize=11)
    ax.set_box_aspect(1)
    ax.set_xlabel(view.label(0))
    ax.set_xlim(*view.ends(0))
    if len(view.axes) == 2:
        ax.set_ylabel(view.label(1))
        ax.set_ylim(*view.ends(1))
    return ax


def scalar(
    ax: Any, view: View, values: Floats, label: str, colours: str, among: Floats | None = None,
    barred: bool = True,
) -> Any:  # fmt: skip
    """Draw a quantity >= 0 over the cells of a slice; NaN is left out.

    Colours (in one dimension the ordinate) are logarithmic when it spans more than two decades;
    zero then takes the lowest colour. They span what is drawn, or ``among``. Returns the picture;
    where it is not ``barred``, it holds what a bar needs that several panels share.
    """
    from matplotlib.colors import LogNorm, Normalize

    known = values if among is None else among
    known = known[np.isfinite(known)]
    positive = known[known > 0]
    low, high = (positive.min(), positive.max()) if len(positive) else (0.0, 1.0)
    logarithmic = bool(low > 0 and high > 10.0**DECADES * low)
    bottom = max(low, high * 10.0**-DEEPEST)
    if len(view.axes) == 1:
        _steps(ax, view, values, label)
        if logarithmic:
            ax.set_yscale("log")
            ax.set_ylim(bottom / 1.5, high * 1.5)
        return None
    if logarithmic:
        picture = image(ax, view, np.where(values <= 0, bottom / 2, values), colours)
        picture.set_norm(LogNorm(bottom, high))
    else:
        picture = image(ax, view, values, colours)
        first = known.min(initial=high)
        picture.set_norm(Normalize(first if first < high else 0.0, high))
    options = {"extend": "min" if logarithmic and (known < bottom).any() else "neither"}
    return _with_bar(ax, picture, label, barred, options)


def levels(
    ax: Any, view: View, values: Floats, grid: Floats, label: str, barred: bool = True
) -> Any:
    """Draw a quantity that takes the values of a grid, centred at 0 when it has both signs.

    What lies between two of them takes the colour of the nearer one. See :func:`scalar`.
    """
    if len(view.axes) == 1:
        _steps(ax, view, values, label)
        margin = 0.06 * float(np.ptp(grid)) or 0.5
        ax.set_ylim(grid.min() - margin, grid.max() + margin)
        ax.axhline(0, color=FAINT, linewidth=0.7, zorder=0.6)
        return None
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
    names = [number(v) for v in level[kept]]
    options = {"ticks": middle[kept], "spacing": "uniform", "names": names}
    return _with_bar(ax, picture, label, barred, options)


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


def _with_bar(ax: Any, picture: Any, label: str, own: bool, options: dict[str, Any]) -> Any:
    """Add a colour bar, or keep what one for several panels needs."""
    picture.bar = {"label": label, **options}
    if own:
        names = options.pop("names", None)
        _name(bar(ax, picture, label, **options), names)
    return picture


def bar(ax: Any, picture: Any, label: str, **options: Any) -> Any:
    """Add a colour bar exactly as high as the axes."""
    made = ax.get_figure().colorbar(picture, cax=ax.inset_axes((1.04, 0, 0.05, 1)), **options)
    made.set_label(label)
    return made


def shared_bar(panels: list[Any], picture: Any) -> None:
    """Add a colour bar for several panels, as one of their pictures says."""
    options = dict(picture.bar)
    label, names = options.pop("label"), options.pop("names", None)
    figure = panels[0].get_figure()
    made = figure.colorbar(picture, ax=panels, shrink=0.7, aspect=30, **options)
    made.set_label(label)
    _name(made, names)


def _name(made: Any, names: list[str] | None) -> None:
    """Name the levels of a colour bar."""
    if names is not None:
        made.ax.minorticks_off()
        made.set_ticklabels(names)

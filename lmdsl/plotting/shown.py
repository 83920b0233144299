"""Figures that show themselves in notebooks: as the value of a cell, or else at its end.

Nothing has to be switched on, and matplotlib's global state plays no part. Outside notebooks these
are figures and axes of matplotlib like any other.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from io import BytesIO
from typing import Protocol

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lmdsl.machine.progress import notebook


class Picture(Figure):
    """A figure that knows whether it was shown."""

    seen = False

    def _repr_png_(self) -> bytes:
        self.seen = True
        content = BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            self.savefig(content, format="png")
        return content.getvalue()


class Panel(Axes):
    """The axes of a figure that has no others: they show the figure."""

    def _repr_png_(self) -> bytes | None:
        picture = self.get_figure()
        return picture._repr_png_() if isinstance(picture, Picture) else None


class Showable(Protocol):
    """What a notebook shows, and whether it has."""

    seen: bool


_waiting: list[Showable] = []
_shells: set[int] = set()


def offer(picture: Showable) -> None:
    """Show a figure at the end of the cell of a notebook that is running, unless it is shown."""
    shell = notebook()
    if shell is None:
        return
    if id(shell) not in _shells:
        _shells.add(id(shell))
        # By its own class: what %matplotlib registers for all figures would not note that it was.
        shell.display_formatter.formatters["image/png"].for_type(Picture, Picture._repr_png_)
        shell.events.register("post_execute", _show)
    _waiting.append(picture)


def _show() -> None:
    """Show what the cell made and nobody showed."""
    display = import_module("IPython.display").display
    pictures = _waiting.copy()
    _waiting.clear()
    for picture in pictures:
        if not picture.seen:
            display(picture)

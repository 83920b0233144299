"""Pages become files, whole or not at all."""

from __future__ import annotations

import os
import warnings
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.errors import BadInput, shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = 2e8  # bytes for a page as pixels, and for matplotlib

FORMATS = ("png", "pdf", "svg")

Target = Path | None


def kind(path: Path) -> str:
    """Return how a file ends."""
    return path.suffix[1:].lower()


def target(path: str | os.PathLike[str] | None) -> Target:
    """Return where a page is to be written, if anywhere; BadInput for another ending."""
    found = None if path is None else inputs.path(path)
    if found is not None and kind(found) not in FORMATS:
        raise BadInput(f"{shown(str(found), 200)}: a plot ends in .png, .pdf or .svg")
    return found


def write(page: Figure, path: Target) -> None:
    """Write a page; it appears whole or not at all."""
    if path is None:
        return
    content = BytesIO()
    stamp = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind(path))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        page.savefig(content, format=kind(path), dpi=200, metadata=stamp)
    write_whole(path, content.getvalue())

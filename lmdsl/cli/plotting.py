"""``plot``: the figures of a saved result."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lmdsl.cli.output import AS_STORED, Arguments
from lmdsl.cli.streams import say
from lmdsl.errors import BadInput, printable, shown

PAGES = ("page", "slices", "projections")
FILMS = (".gif", ".mp4")
QUANTITIES = ("cost", "control", "measure", "coverage")


def add(plot: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    plot.add_argument(
        "--out", metavar="FILE", help="PNG, PDF or SVG (default DIR/figures.png); GIF, MP4: a film"
    )
    plot.add_argument("--axes", metavar="X,Y", help="the one or two axes shown")
    plot.add_argument("--at", metavar="Z=1,V=0", help="where other axes are held; of slices, where "
                      "they are: Z=1,2,3")  # fmt: skip
    plot.add_argument("--project", choices=("worst", "mean"),
                      help="project the axes neither shown nor held")  # fmt: skip
    plot.add_argument("--draw", choices=PAGES, default="page",
                      help="all on one page (default), or one quantity in many panels")  # fmt: skip
    plot.add_argument("--quantity", choices=QUANTITIES, default="cost",
                      help="of slices and projections (default cost)")  # fmt: skip
    plot.add_argument("--control", metavar="U", help="which control (default: the first)")


def run(parsed: Arguments) -> int:
    """Draw, and write the file."""
    from lmdsl.results.directory import archive

    axes = None if parsed.axes is None else parsed.axes.split(",")
    at = None if parsed.at is None else places(parsed.at)
    stored = archive.read(parsed.dir)
    path = Path(parsed.out) if parsed.out is not None else Path(parsed.dir) / "figures.png"
    _draw(parsed, stored, path, axes, at)
    say(f"written to {printable(str(path))} ({AS_STORED})")
    return 0


def _draw(parsed: Arguments, stored: Any, path: Path, axes: list[str] | None, at: Any) -> None:
    from lmdsl import plotting

    result, what = stored.result, (parsed.quantity, parsed.control)
    if parsed.draw == "slices":
        plotting.slices(result, *what, path, axes=axes, at=at)
    elif parsed.draw == "projections":
        if axes is not None:
            raise BadInput("projections are onto all pairs of axes; leave it out", "--axes")
        plotting.projections(result, *what, path, at=at, project=parsed.project or "worst")
    elif path.suffix.lower() in FILMS:
        plotting.animate(result, path, axes=axes, at=at, project=parsed.project)
    else:
        cut: Any = {"axes": axes, "at": at, "project": parsed.project}
        plotting.figure(result, path, proof=result.proof, **cut)


def places(text: str) -> dict[str, float | list[float]]:
    """Return places by axis: of ``z=1,2,v=0`` two of z and one of v."""
    found: dict[str, list[float]] = {}
    name = None
    for part in text.split(","):
        before, equals, value = part.rpartition("=")
        name = before.strip() if equals else name
        try:
            number = float(value)
        except ValueError:
            number = float("nan")
        if not name or number != number or (equals and name in found):
            raise BadInput(f"{shown(text)}: write axis=number, such as z=1,v=0.5", "--at")
        found.setdefault(name, []).append(number)
    return {axis: many[0] if len(many) == 1 else many for axis, many in found.items()}

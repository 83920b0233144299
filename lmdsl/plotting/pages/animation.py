"""The closed loop, moving: runs of the true map over the cost, as a GIF or an MP4."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lmdsl.common import inputs
from lmdsl.common.files import write_whole
from lmdsl.common.types import Bools, Floats
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.plotting import layers, motion, quantities, regions, runs
from lmdsl.plotting.pages import films, writing
from lmdsl.plotting.pages.films import Pixels
from lmdsl.plotting.quantities import codes_of, view_of
from lmdsl.plotting.view import At, Projection, View, plain, segments
from lmdsl.results.result import Result

KINDS = ("gif", "mp4")
MOST = 300  # frames; of longer runs states are left out
TAIL = 3  # steps for which a run leaves a trace
FAST, SLOW = 20, 3  # frames a second: pieces of a step of an equation, steps of a map


class Film:
    """A moving picture; a notebook shows it.

    Attributes
    ----------
    content
        The file.
    kind
        ``gif`` or ``mp4``.
    frames
        Number of frames.
    """

    def __init__(self, content: bytes, kind: str, frames: int) -> None:
        self.content, self.kind, self.frames, self.seen = content, kind, frames, False

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file; it appears whole or not at all."""
        target = inputs.path(path)
        if writing.kind(target) != self.kind:
            raise BadInput(f"{shown(str(target), 200)}: this film ends in .{self.kind}")
        write_whole(target, self.content)

    def _repr_html_(self) -> str:
        self.seen = True
        data = b64encode(self.content).decode()
        if self.kind == "mp4":
            play = "controls loop autoplay muted"
            return f'<video {play} src="data:video/mp4;base64,{data}"></video>'
        return f'<img src="data:image/gif;base64,{data}" alt="the closed loop, moving"/>'

    def __repr__(self) -> str:
        return f"Film({self.frames} frames, {self.kind}, {len(self.content):,} bytes)"


@own_arithmetic
def animate(
    result: Result,
    path: str | os.PathLike[str] | None = None,
    starts: int | ArrayLike = 16,
    seed: int = 0,
    *,
    steps: int = 200,
    axes: Sequence[str] | None = None,
    at: At | None = None,
    project: Projection | None = None,
    fps: int | None = None,
) -> Film:
    """Let closed-loop runs of the true map move: dots with traces, dark in A, a cross where lost.

    Behind them is the cost, where all axes are shown or others are projected; else attractor and
    avoid. One dimension is drawn over the step number.

    Parameters
    ----------
    result
        A result with a controller.
    path
        File to write, ending in .gif, or in .mp4 where ffmpeg is installed; it appears whole or not
        at all.
    starts, seed, steps
        As for :func:`trajectories`.
    axes, at, project
        Which axes are shown, where others are held, whether the rest is projected; runs always are.
    fps
        Frames a second, 8 of which are a step of a differential equation; default: 20, of a map 3.

    Returns
    -------
    Film
        ``save(path)`` writes it; as the value of a notebook's cell it plays.

    Raises
    ------
    BadInput
        There is no controller, or the file cannot be written.
    """
    target = None if path is None else inputs.path(path)
    kind = "gif" if target is None else writing.kind(target)
    if kind not in KINDS:
        raise BadInput(f"{shown(str(target), 200)}: a film ends in .gif or .mp4")
    steps, seed = inputs.whole(steps, "steps"), inputs.seed(seed)
    usual = FAST if runs.is_ode(result.problem) else SLOW
    rate = usual if fps is None else int(inputs.whole(fps, "fps", most=100))
    writer = films.ffmpeg() if kind == "mp4" else ""
    view = view_of(result, axes, at, project)
    if (result.control_index < 0).all() or not result.weight.any():
        raise BadInput("there is no controller to follow: " + result.message)
    x = runs.starts_of(result, starts, seed)
    points, last, pieces = runs.closed_loop(result, x, steps, seed)
    reached = (last >= 0) & (result.cell_status[last] == CellStatus.ATTRACTOR)
    running = (last >= 0) & (result.cell_status[last] == CellStatus.STABILIZED)
    with layers.apart():
        scene = _Scene.of(result, view, points, reached, ~reached & ~running, pieces)
    frames = list(scene.frames())
    made = films.gif(frames, rate) if kind == "gif" else films.mp4(frames, rate, writer)
    film = Film(made, kind, len(frames))
    if target is not None:
        write_whole(target, made)
    _offered(film)
    return film


@dataclass(frozen=True, eq=False)
class _Scene:
    """Axes with what stands still, and runs that move over it."""

    ax: Any
    view: View
    points: Floats  # (T, r, d), after its end a run stays where it ended
    ended: NDArray[np.int64]  # the state at which each run ended, (r,)
    reached: Bools
    lost: Bools
    pieces: int  # states a step
    aimed: bool  # there is an attractor to reach

    @classmethod
    def of(
        cls, result: Result, view: View, points: Floats, reached: Bools, lost: Bools, pieces: int
    ) -> _Scene:
        """Draw what stands still."""
        there = np.isfinite(points).all(axis=-1)
        ended = np.where(there, np.arange(len(points))[:, None], 0).max(axis=0)
        kept = np.minimum(np.arange(len(points))[:, None], ended)
        points = np.take_along_axis(points, kept[..., None], axis=0)
        ax = layers.frame(None, view, "")
        if len(view.axes) == 1:
            motion.over_steps(ax, view, (len(points) - 1) / pieces)
        status = result.cell_status
        if view.whole or view.away:
            if len(view.axes) == 2:
                quantities.of_result(result, "cost").draw(ax, view)
            regions.regions(ax, view, codes_of(result), legend=True, upright=False)
        else:
            masks = (status == CellStatus.ATTRACTOR, status == CellStatus.AVOID)
            regions.obstacles(ax, view, *masks, legend=True, upright=False)
        ax.get_figure().suptitle(plain(result.problem.name, 60), fontsize=11)
        aimed = bool((status == CellStatus.ATTRACTOR).any())
        return cls(ax, view, points, ended, reached, lost, pieces, aimed)

    def frames(self) -> Iterator[Pixels]:
        """Yield the frames."""
        figure = self.ax.get_figure()
        figure.canvas.draw()
        shown_ = np.arange(0, len(self.points), -(-len(self.points) // MOST))
        shown_ = np.unique(np.append(shown_, len(self.points) - 1))
        width, height = figure.canvas.get_width_height()
        memory.require(8.0 * len(shown_) * width * height, "the frames of a film")
        behind = figure.canvas.copy_from_bbox(figure.bbox)
        for k in shown_:
            figure.canvas.restore_region(behind)
            for artist in self._moving(int(k)):
                self.ax.draw_artist(artist)
                artist.remove()
            yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()

    def _moving(self, k: int) -> Iterator[Any]:
        """Yield what is drawn at a state of the runs."""
        from matplotlib.collections import LineCollection

        view, flat = self.view, len(self.view.axes) == 1
        colours = np.array(layers.CYCLE)[np.arange(self.points.shape[1]) % len(layers.CYCLE)]
        where = self.points[k][:, list(view.axes)]
        if flat:
            past = self.points[: k + 1][..., view.axes[0]]
            step = np.broadcast_to(np.arange(k + 1)[:, None] / self.pieces, past.shape)
            step = np.minimum(step, self.ended / self.pieces)
            where = np.column_stack([step[-1], where])
            yield self.ax.scatter(
                step.ravel(), past.ravel(), c=np.tile(colours, k + 1), s=4, linewidths=0, zorder=2
            )
        else:
            pieces, run = segments(self.points[max(k - TAIL * self.pieces, 0) : k + 1], view)
            lines: Any = pieces
            for ink, width in (("white", 2.2), (colours[run], 1.2)):
                yield self.ax.add_collection(
                    LineCollection(lines, colors=ink, linewidths=width, zorder=2)
                )
        over = k >= self.ended
        arrived, lost = over & self.reached, over & self.lost
        on, dots = ~(arrived | lost), {"edgecolors": "white", "linewidths": 0.8, "zorder": 4}
        yield self.ax.scatter(*where[on].T, s=38, c=list(colours[on]), **dots)
        yield self.ax.scatter(*where[arrived].T, s=22, c=layers.INK, **dots)
        for ink, width in (("white", 3.2), (layers.INK, 1.6)):
            yield self.ax.scatter(
                *where[lost].T, s=40, c=ink, marker="x", linewidths=width, zorder=4.5
            )
        parts = [f"{int(arrived.sum())} of {len(on)} in A"] * self.aimed
        parts += [f"{int(lost.sum())} lost"] * bool(lost.any())
        text = f"step {k // self.pieces}" + ": " * bool(parts) + ", ".join(parts)
        yield self.ax.text(0, 1.02, text, transform=self.ax.transAxes, fontsize=10)


def _offered(film: Film) -> None:
    from lmdsl.plotting.shown import offer

    offer(film)

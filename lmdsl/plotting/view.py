"""What a plot shows of the cells: one or two axes, the others cut or projected away."""

import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput, shown
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus

At = Mapping[str, float]
UNSOLVED = 7  # code of a cell that is stabilizable, without a controller

# Of what lies over a cell that is shown: the value that is worst, or the mean.
Projection = Literal["worst", "mean"]


def plain(text: str, limit: int = 60) -> str:
    """Return user text that is safe to draw: one line, no control characters, no mathtext."""
    spaced = "".join(" " if c.isspace() else c for c in text)
    kept = "".join(c for c in spaced if unicodedata.category(c)[0] != "C")
    line = " ".join(kept.split())
    line = line if len(line) <= limit else line[: limit - 1] + "…"
    return line.replace("$", r"\$")


def number(value: float, digits: int = 3) -> str:
    """Return a number as text, with a true minus sign."""
    return f"{value + 0.0:.{digits}g}".replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True, eq=False)
class View:
    """One or two axes of the partition, the others held at one cell or projected away."""

    partition: Partition  # all cells
    axes: tuple[int, ...]  # positions of the axes shown
    cell: Indices  # multi-index of a cell in the slice, shape (d,)
    away: tuple[int, ...] = ()  # positions of the axes projected away
    project: Projection = "worst"  # and how

    @classmethod
    def of(
        cls,
        partition: Partition,
        attractor: Bools,
        axes: Sequence[str] | None = None,
        at: Mapping[str, float] | None = None,
        project: Projection | None = None,
    ) -> Self:
        """Resolve a choice of axes; the default slice passes through the attractor's centre.

        Without an attractor it passes through the middle of the box. With ``project`` the axes
        neither shown nor held are projected away.
        """
        names, at = partition.names, {} if at is None else at
        inputs.kind(at, Mapping, "at", "a mapping; write {axis: value}")
        if axes is not None:
            inputs.kind(axes, list | tuple, "axes", "a list of axes")
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
        if project is not None and project not in get_args(Projection):
            raise BadInput(f"{shown(project)}: write worst or mean", "project")
        point = _centre(partition, attractor)
        for name, value in at.items():
            place = inputs.states({name: value}, [name], "at")[..., 0]
            if place.shape:
                raise BadInput(f"{shown(value)}: {name} is held at one place", "at")
            point[names.index(name)] = place
        inside = partition.locate([np.array([x]) for x in point], clip=False)
        if inside[0] < 0:
            raise BadInput(f"{shown(dict(at))} lies outside the state box", "at")
        cell = np.array(partition.multi_index(inside))[:, 0]
        away = [k for k, name in enumerate(names) if name not in (*chosen, *at)]
        return cls(
            partition,
            tuple(names.index(name) for name in chosen),
            cell,
            tuple(away) if project else (),
            project or "worst",
        )

    def moved(self, at: Mapping[int, int]) -> Self:
        """Return the slice through other cells of some axes: their index by position."""
        cell = self.cell.copy()
        for k, index in at.items():
            cell[k] = index
        return replace(self, cell=cell)

    @property
    def hidden(self) -> tuple[int, ...]:
        """Positions of the axes that are held."""
        seen = self.axes + self.away
        return tuple(k for k in range(self.partition.dimension) if k not in seen)

    @property
    def whole(self) -> bool:
        """Whether every axis is shown."""
        return len(self.axes) == self.partition.dimension

    @property
    def held(self) -> str:
        """Where the slice is, such as "z ≈ 25.5"; empty where no axis is held."""
        p = self.partition
        at = p.low + (self.cell + 0.5) * p.width
        held = [f"{plain(p.names[k], 16)} ≈ {number(at[k])}" for k in self.hidden]
        return ", ".join(held[:4]) + ", …" * (len(held) > 4)

    @property
    def note(self) -> str:
        """Where the slice is, and what is projected away, in brackets; or empty."""
        p, parts = self.partition, [self.held] * bool(self.hidden)
        if self.away:
            names = [plain(p.names[k], 16) for k in self.away]
            parts.append(f"{self.project} over {', '.join(names[:4])}{', …' * (len(names) > 4)}")
        return f" ({'; '.join(parts)})" if parts else ""

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

    def over(self, flat: NDArray[Any]) -> NDArray[Any]:
        """Return values over the cells shown, and last all that lie over each: (..., R).

        Of a slice R is 1.
        """
        grid = flat.reshape(self.partition.shape).transpose(self.axes + self.away + self.hidden)
        cut = grid[(..., *self.cell[list(self.hidden)])]
        return cut.reshape(*cut.shape[: len(self.axes)], -1)

    def values(self, flat: Floats, signed: bool = False) -> Floats:
        """Return one value a cell shown, of those that are no NaN; NaN where there is none.

        The worst is the largest, of ``signed`` ones the largest in magnitude.
        """
        each = self.over(flat)
        if not self.away:
            return np.asarray(each[..., 0])
        known = ~np.isnan(each)
        count = known.sum(axis=-1)
        if self.project == "mean":
            total = np.where(known, each, 0.0).sum(axis=-1)
            return np.asarray(total / np.where(count > 0, count, np.nan))
        size = np.where(known, np.abs(each) if signed else each, -np.inf)
        worst = np.take_along_axis(each, size.argmax(axis=-1)[..., None], axis=-1)[..., 0]
        return np.where(count > 0, worst, np.nan)

    def codes(self, flat: NDArray[np.integer]) -> NDArray[np.integer]:
        """Return the region of every cell shown.

        Of several cells STABILIZED where one is, AVOID where all are; else the commonest of others.
        """
        each = self.over(flat)
        if not self.away:
            return np.asarray(each[..., 0])
        found = np.full(each.shape[:-1], CellStatus.AVOID, dtype=each.dtype)
        most = np.zeros(each.shape[:-1], dtype=np.int64)
        for code in np.setdiff1d(each, [CellStatus.AVOID]):
            count = (each == code).sum(axis=-1)
            if code in (CellStatus.STABILIZED, UNSOLVED):
                count[count > 0] = each.shape[-1]
            found[count > most] = code
            most = np.maximum(most, count)
        return found

    def some(self, mask: Bools) -> Bools:
        """Return where any cell that lies over the one shown is marked; of a slice, where it is."""
        covered: Bools = np.asarray(self.over(mask).any(axis=-1))
        return covered

    def shadow(self, mask: Bools) -> Bools:
        """Return where any cell over the axes not shown is marked, held or not."""
        return self._all().some(mask)

    def core(self, mask: Bools) -> Bools:
        """Return where every cell over the axes not shown is marked."""
        return ~self._all().some(~mask)

    def _all(self) -> Self:
        """Return the view with all axes that are not shown projected away."""
        away = tuple(k for k in range(self.partition.dimension) if k not in self.axes)
        return replace(self, away=away)


def _centre(partition: Partition, attractor: Bools) -> Floats:
    """Return the centre of the attractor cell that is nearest to the middle of all of them."""
    cells = np.flatnonzero(attractor)
    if not len(cells):
        cells = np.ravel_multi_index([[k // 2] for k in partition.shape], partition.shape)
    centres = partition.centres(cells)
    distance = np.abs((centres - centres.mean(axis=0)) / partition.width).sum(axis=1)
    point: Floats = centres[np.argmin(distance)].copy()
    return point


def rectangles(mask: Bools, x: Floats, y: Floats) -> Floats:
    """Return closed rectangles that cover the cells of a mask, runs along x merged, (R, 5, 2)."""
    edge = np.diff(np.pad(mask.astype(np.int8), ((1, 1), (0, 0))), axis=0).T
    row, first = np.nonzero(edge == 1)
    _, last = np.nonzero(edge == -1)
    x0, x1, y0, y1 = x[first], x[last], y[row], y[row + 1]
    return np.stack(
        [np.stack(c, axis=-1) for c in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))], axis=1
    )


def segments(points: Floats, view: View) -> tuple[Floats, Indices]:
    """Join successive states of runs, (T, r, d), NaN from where a run has ended, by lines.

    Returns them, shape (S, 2, 2), and their runs, (S,). A line takes the shorter way round a
    periodic axis; across the seam it leaves on one side and, as a second segment, enters on the
    other.
    """
    p, axes = view.partition, list(view.axes)
    span = (p.high - p.low)[axes]
    a, b = points[:-1][..., axes], points[1:][..., axes]
    turns = np.where(p.periodic[axes], np.round((b - a) / span), 0.0)
    step = b - a - turns * span
    there = np.isfinite(step).all(axis=-1)
    seam = there & (turns != 0).any(axis=-1)
    run = np.broadcast_to(np.arange(points.shape[1]), there.shape)
    leave = np.stack([a, a + step], axis=-2)[there]
    enter = np.stack([b - step, b], axis=-2)[seam]
    return np.concatenate([leave, enter]), np.concatenate([run[there], run[seam]])

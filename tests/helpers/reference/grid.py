"""The axes of the state box, and the cells of places and boxes."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

EDGE = 1e-9
TURNS = 2.0**20  # in cell widths: how close to an edge counts as on it


@dataclass(frozen=True)
class Axis:
    """One state and its cells."""

    name: str
    low: float
    high: float
    cells: int
    periodic: bool

    @property
    def width(self) -> float:
        return (self.high - self.low) / self.cells

    def scaled(self, value: float) -> float:
        """Position counted in cell widths from `low`."""
        return (value - self.low) / self.width

    def wrapped(self, value: float) -> float | None:
        """The place on a circle of a number, None if it is not finite or too many turns away."""
        span = self.high - self.low
        away = value - self.low
        if not abs(away / span) <= TURNS + 1:
            return None
        turns = math.floor(away / span)
        if self.low <= value <= self.high:
            return value
        place = self.low + min(max(away - turns * span, 0.0), span)
        return min(place, self.high) if abs(turns) <= TURNS else None

    def cell_of(self, value: float) -> int | None:
        """Cell of an image, None if it is outside."""
        if self.periodic:
            place = self.wrapped(value)
            return None if place is None else math.floor(self.scaled(place) + EDGE) % self.cells
        t = self.scaled(value)
        if not math.isfinite(t):
            return None
        k = math.floor(t + EDGE)
        if abs(t - self.cells) <= EDGE or (k == self.cells and value <= self.high):
            return self.cells - 1
        return k if 0 <= k < self.cells else None

    def touched_by(self, value: float) -> list[int]:
        """Every closed cell within EDGE widths of a point."""
        t = self.scaled(value)
        images = [t]
        if self.periodic:
            place = self.wrapped(value)
            t = math.nan if place is None else self.scaled(place)
            images = [t - self.cells, t, t + self.cells]
        return [i for i in range(self.cells) if any(i - EDGE <= s <= i + 1 + EDGE for s in images)]

    def inside(self, a: float, b: float) -> list[int]:
        """The cells inside [a, b], up to EDGE widths."""
        ta, tb = self.scaled(a), self.scaled(b)
        return [i for i in range(self.cells) if ta - EDGE <= i and i + 1 <= tb + EDGE]

    def overlapped(self, a: float, b: float) -> list[int]:
        """The cells whose interior overlaps [a, b] by more than EDGE widths."""
        ta, tb = self.scaled(a), self.scaled(b)
        return [i for i in range(self.cells) if min(i + 1, tb) - max(i, ta) > EDGE]


def read_axes(problem: dict[str, Any]) -> list[Axis]:
    return [
        Axis(name, float(a["low"]), float(a["high"]), int(a["cells"]), a.get("periodic", False))
        for name, a in problem["state_box"].items()
    ]


def number_of_cells(axes: list[Axis]) -> int:
    return math.prod(axis.cells for axis in axes)


def flat(axes: list[Axis], index: Iterable[int]) -> int:
    """Multi-index -> cell number (C order, last axis fastest)."""
    number = 0
    for axis, i in zip(axes, index, strict=True):
        number = number * axis.cells + i
    return number


def unflat(axes: list[Axis], number: int) -> tuple[int, ...]:
    """Cell number -> multi-index."""
    index: list[int] = []
    for axis in reversed(axes):
        number, i = divmod(number, axis.cells)
        index.append(i)
    return tuple(reversed(index))


def cell_of_image(axes: list[Axis], image: list[float], clip: bool) -> int | None:
    """Cell of an image, None if it leaves the box (before `avoid` is looked at)."""
    if not all(math.isfinite(v) for v in image):
        return None
    index = []
    for axis, v in zip(axes, image, strict=True):
        if clip and not axis.periodic:
            v = min(max(v, axis.low), axis.high)
        i = axis.cell_of(v)
        if i is None:
            return None
        index.append(i)
    return flat(axes, index)


def product_cells(axes: list[Axis], per_axis: list[list[int]]) -> set[int]:
    return {flat(axes, index) for index in itertools.product(*per_axis)}


def cells_inside(axes: list[Axis], box: dict[str, list[float]]) -> set[int]:
    """Cells inside a box; an axis that the box leaves out is unrestricted."""
    return product_cells(
        axes, [a.inside(*box[a.name]) if a.name in box else list(range(a.cells)) for a in axes]
    )


def cells_overlapped(axes: list[Axis], box: dict[str, list[float]]) -> set[int]:
    """Cells whose interior a box overlaps."""
    return product_cells(
        axes, [a.overlapped(*box[a.name]) if a.name in box else list(range(a.cells)) for a in axes]
    )

"""Geometry of the cells: index, centre, sample points, and the cells of a point or a box.

The state box is a product of equal cells; a cell's index is the C order of its multi-index (last
axis fastest). An image x lies in cell floor(t + 1e-9), t = (x - low) / width, on every axis. One
compiled function, :meth:`Partition.locate`, decides this for compilation, controller and
simulation alike, so that they can never disagree about an edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput
from lmdsl.frozen import Frozen
from lmdsl.kernels import fixed, kernel
from lmdsl.problem import Problem

EDGE = 1e-9
"""Width of an edge in cells: points this close to an edge count as lying on it."""

MAX_CELLS = 2**31 - 2

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Partition(Frozen):
    """A product grid of cells over the state box.

    Attributes
    ----------
    names
        Axis names.
    low, high, width
        Arrays of shape (d,).
    cells
        Number of cells per axis, shape (d,).
    periodic
        Which axes are circles, shape (d,).
    clip
        True when finite images are saturated into the box on non-periodic axes.
    """

    names: tuple[str, ...]
    low: Floats
    high: Floats
    width: Floats
    cells: Indices
    periodic: Bools
    clip: bool = False

    @classmethod
    def of(cls, problem: Problem) -> Partition:
        """Return the partition that a problem declares.

        Raises
        ------
        BadInput
            There are more cells than 32-bit indices.
        """
        axes = problem.state_box.values()
        size = math.prod(axis.cells for axis in axes)
        if size > MAX_CELLS:
            raise BadInput(
                f"{size:.3g} cells do not fit in memory (limit {MAX_CELLS:.3g}); use fewer cells",
                "state_box",
            )
        low = np.array([axis.low for axis in axes])
        high = np.array([axis.high for axis in axes])
        cells = np.array([axis.cells for axis in axes], dtype=np.int64)
        return cls(
            names=problem.states,
            low=low,
            high=high,
            width=(high - low) / cells,
            cells=cells,
            periodic=np.array([axis.periodic for axis in axes]),
            clip=problem.on_exit == "clip",
        )

    @property
    def size(self) -> int:
        """Number of cells N."""
        return int(np.prod(self.cells))

    @property
    def dimension(self) -> int:
        """Number of axes d."""
        return len(self.names)

    @property
    def shape(self) -> tuple[int, ...]:
        """Cells per axis, as a shape for reshaping (N,) arrays."""
        return tuple(int(k) for k in self.cells)

    def locate(self, images: Sequence[Floats], clip: bool | None = None) -> Indices:
        """Return the cell of every image, -1 outside the box or where not finite.

        Parameters
        ----------
        images
            One array per axis; they broadcast against each other.
        clip
            Saturate finite images into the box; default: as the problem's ``on_exit`` says.
        """
        index = self.index(images, clip)
        return np.where(index >= 0, index, -1.0).astype(np.int64)

    def index(self, images: Sequence[Floats], clip: bool | None = None) -> Floats:
        """Return the cell of every image as a double, NaN outside the box or where not finite.

        An image is located in its own shape, before it is broadcast: what does not depend on the
        control is located once for all controls. Parameters as for :meth:`locate`.
        """
        saturate = self.clip if clip is None else clip
        total: Floats | None = None
        for axis, image in zip(self.axes, images, strict=True):
            x = np.asarray(image, dtype=np.float64)
            if total is None or x.shape == total.shape:
                total = axis.add_index(x, saturate, total)
            else:  # NaN on one axis makes the sum NaN
                total = total + axis.add_index(x, saturate, None)
        return np.zeros(()) if total is None else total

    @cached_property
    def axes(self) -> tuple[Axis, ...]:
        """The axes in plain numbers."""
        return tuple(
            Axis(
                float(self.low[k]),
                float(self.high[k]),
                float(self.width[k]),
                float(self.cells[k]),
                float(math.prod(self.shape[k + 1 :])),
                bool(self.periodic[k]),
            )
            for k in range(self.dimension)
        )

    def multi_index(self, cell: NDArray[np.integer]) -> tuple[Indices, ...]:
        """Return the index of each cell on every axis."""
        return np.unravel_index(cell, self.shape)

    def centres(self, cell: NDArray[np.integer]) -> Floats:
        """Return the centres of cells, shape (len(cell), d)."""
        index = np.stack(self.multi_index(cell), axis=-1)
        return self.low + (index + 0.5) * self.width

    def samples(self, cell: NDArray[np.integer], offsets: Floats) -> list[Floats]:
        """Return the sample points of cells: per axis an array of shape (len(cell), points)."""
        return [
            self.low[k] + (index[:, None] + offsets[None, :, k]) * self.width[k]
            for k, index in enumerate(self.multi_index(cell))
        ]

    def mask(self, blocks: Iterable[tuple[Indices, ...]]) -> Bools:
        """Return which cells lie in a union of blocks (one index array per axis each)."""
        inside = np.zeros(self.shape, dtype=np.bool_)
        for block in blocks:
            inside[np.ix_(*block)] = True
        return inside.ravel()

    def around_point(self, point: Sequence[float], where: str) -> tuple[Indices, ...]:
        """Return the block of closed cells within 1e-9 widths of a point."""
        block = []
        for k, x in enumerate(point):
            t = _units(x, self.low[k], self.width[k])
            n = int(self.cells[k])
            if self.periodic[k]:
                if not abs(t) < 2**52:
                    raise BadInput(f"{x!r} is too many turns away from the axis", where)
                first, last = math.ceil(t - 1 - EDGE), math.floor(t + EDGE)
                block.append(np.unique(np.arange(first, last + 1) % n))
                continue
            if not -EDGE <= t <= n + EDGE:
                raise BadInput(
                    f"{x!r} is outside the axis {self.names[k]} = "
                    f"[{float(self.low[k])!r}, {float(self.high[k])!r}]",
                    f"{where}.{self.names[k]}",
                )
            first, last = math.ceil(t - 1 - EDGE), math.floor(t + EDGE)
            block.append(np.arange(max(first, 0), min(last, n - 1) + 1))
        return tuple(block)

    def inside_box(self, box: Mapping[str, tuple[float, float]], where: str) -> tuple[Indices, ...]:
        """Return the block of cells inside a box, up to 1e-9 widths."""

        def cells(ta: float, tb: float) -> tuple[float, float]:
            return math.ceil(ta - EDGE), math.floor(tb + EDGE) - 1

        return self._block(box, where, cells)

    def overlapping_box(
        self, box: Mapping[str, tuple[float, float]], where: str
    ) -> tuple[Indices, ...]:
        """Return the block of cells whose interior overlaps a box by more than 1e-9 widths."""

        def cells(ta: float, tb: float) -> tuple[float, float]:
            if not tb - ta > EDGE:
                return 0, -1
            return math.floor(ta - 1 + EDGE) + 1, math.ceil(tb - EDGE) - 1

        return self._block(box, where, cells)

    def _block(
        self,
        box: Mapping[str, tuple[float, float]],
        where: str,
        cells: Callable[[float, float], tuple[float, float]],
    ) -> tuple[Indices, ...]:
        block = []
        for k, name in enumerate(self.names):
            n = int(self.cells[k])
            if name not in box:
                block.append(np.arange(n))
                continue
            a, b = box[name]
            ta, tb = (_units(end, self.low[k], self.width[k]) for end in (a, b))
            if self.periodic[k] and not (ta >= -EDGE and tb <= n + EDGE):
                raise BadInput(
                    f"[{a!r}, {b!r}] leaves the periodic axis [{float(self.low[k])!r}, "
                    f"{float(self.high[k])!r}]; use two boxes across the seam",
                    f"{where}.{name}",
                )
            first, last = cells(*(min(max(float(t), -2.0), n + 2.0) for t in (ta, tb)))
            block.append(np.arange(max(int(first), 0), min(int(last), n - 1) + 1))
        return tuple(block)


def _units(x: float, low: float, width: float) -> float:
    """Return (x - low) / width; infinite where it overflows."""
    with np.errstate(over="ignore"):
        return float((x - low) / width)


class Axis(NamedTuple):
    """One axis in plain numbers; ``stride`` cells of the box lie between neighbours on it."""

    low: float
    high: float
    width: float
    cells: float
    stride: float
    periodic: bool

    def add_index(self, image: Floats, clip: bool, total: Floats | None) -> Floats:
        """Add the index on this axis, times the stride, to the indices on others; NaN outside.

        Without a total it is a new array in the shape of the image.
        """
        found = np.zeros(image.shape) if total is None else total
        flat, line = fixed(np.ascontiguousarray(image).reshape(-1)), found.reshape(-1)
        if self.periodic:
            circle(flat, self.low, self.width, self.cells, self.stride, line)
        else:
            interval(flat, self.low, self.high, self.width, self.cells, self.stride, clip, line)
        return found


# The two kernels have no branch in the loop, so that they run on vectors of doubles.
@kernel(error_model="numpy")  # division by zero cannot occur, and its test would be a branch
def circle(image, low, width, cells, stride, index):  # type: ignore[no-untyped-def]
    """Add stride (k mod cells), k = floor((x - low)/width + EDGE); NaN where k is not finite.

    For |k| < 2^51 the quotient floor(k/cells) is off by at most one, its multiple of cells and the
    rest are exact, and one addition brings the rest into 0..cells-1.
    """
    inverse = 1.0 / cells
    far = False
    for i in range(len(image)):
        k = np.floor((image[i] - low) / width + EDGE)
        rest = k - cells * np.floor(k * inverse)
        rest = rest + cells if rest < 0.0 else rest
        rest = rest - cells if rest >= cells else rest
        near = abs(k) < 2.0**51
        far |= not near
        index[i] += stride * rest if near else 0.0
    if far:
        for i in range(len(image)):
            k = np.floor((image[i] - low) / width + EDGE)
            if not abs(k) < 2.0**51:
                index[i] += stride * (k % cells) if np.isfinite(k) else np.nan


@kernel(error_model="numpy")
def interval(image, low, high, width, cells, stride, clip, index):  # type: ignore[no-untyped-def]
    """Add stride k, k = floor((x - low)/width + EDGE), for 0 <= k < cells; NaN elsewhere.

    An image up to EDGE above the last cell belongs to it. With ``clip`` a finite image is moved
    into the interval first.
    """
    for i in range(len(image)):
        x = image[i]
        finite = abs(x) < np.inf
        if clip:
            x = low if x < low else x
            x = high if x > high else x
        t = (x - low) / width
        k = np.floor(t + EDGE)
        last = (k >= cells) & ((t - cells <= EDGE) | (clip & (x == high)))
        k = cells - 1.0 if last else k
        index[i] += stride * k if finite & (k >= 0.0) & (k < cells) else np.nan

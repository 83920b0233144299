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

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from lmdsl.errors import BadInput
from lmdsl.problem import Problem

EDGE = 1e-9
"""Width of an edge in cells: points this close to an edge count as lying on it."""

MAX_CELLS = 2**31 - 2

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Partition:
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
        shape = np.broadcast_shapes(*(np.shape(image) for image in images))
        padded = (1,) * (4 - len(shape)) + shape if len(shape) <= 4 else (1, 1, 1, math.prod(shape))
        flat = np.zeros(padded, dtype=np.int64)
        self.locate_into(flat, [np.broadcast_to(i, shape).reshape(padded) for i in images], clip)
        return flat.reshape(shape)

    def locate_into(
        self, flat: Indices, images: Sequence[Floats], clip: bool | None = None
    ) -> None:
        """Fill ``flat`` (4-D, zeros on entry) with the cells of 4-D broadcastable images."""
        saturate = self.clip if clip is None else clip
        for k, image in enumerate(images):
            _locate(
                flat,
                np.broadcast_to(np.asarray(image, dtype=np.float64), flat.shape),
                float(self.low[k]),
                float(self.high[k]),
                float(self.width[k]),
                int(self.cells[k]),
                bool(self.periodic[k]),
                saturate and not bool(self.periodic[k]),
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


_IMAGE = types.Array(types.float64, 4, "A", readonly=True)


@njit(
    types.void(
        types.int64[:, :, :, ::1],
        _IMAGE,
        types.float64,
        types.float64,
        types.float64,
        types.int64,
        types.boolean,
        types.boolean,
    ),
    cache=True,
    nogil=True,
)
def _locate(flat, image, low, high, width, cells, periodic, clip):  # type: ignore[no-untyped-def]
    """Advance C-order cell indices by one axis; -1 sticks once an image has left."""
    n = float(cells)
    for c in range(flat.shape[0]):
        for a in range(flat.shape[1]):
            for p in range(flat.shape[2]):
                for q in range(flat.shape[3]):
                    f = flat[c, a, p, q]
                    if f < 0:
                        continue
                    x = image[c, a, p, q]
                    if not np.isfinite(x):
                        flat[c, a, p, q] = -1
                        continue
                    if clip:
                        x = min(max(x, low), high)
                    t = (x - low) / width
                    k = np.floor(t + EDGE)
                    if periodic:
                        if k < 0.0 or k >= n:
                            if not np.isfinite(k):
                                flat[c, a, p, q] = -1
                                continue
                            k = k % n
                    elif k >= n and (t - n <= EDGE or (clip and x == high)):
                        k = n - 1.0
                    elif not (0.0 <= k < n):
                        flat[c, a, p, q] = -1
                        continue
                    flat[c, a, p, q] = f * cells + np.int64(k)

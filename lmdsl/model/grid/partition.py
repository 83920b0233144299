"""Geometry of the cells: index, centre, sample points, and the cells of a point or a box.

The state box is a product of equal cells; a cell's index is the C order of its multi-index (last
axis fastest). An image is a state first, wrapped or clipped into the box, and then lies in a cell.
One rule (axis.py) decides this for compilation, controller, simulation and proofs alike, so that
they can never disagree about an edge.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput, shown
from lmdsl.machine.forking import cached_property
from lmdsl.model.grid.axis import EDGE, AxisCells
from lmdsl.problem.consistency import endings
from lmdsl.problem.problem import Problem

MAX_CELLS = 2**31 - 2  # number of cells above which indices of 32 bits do not suffice


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
    numbered
        True for a finite model: its cells are called by number.
    """

    names: tuple[str, ...]
    low: Floats
    high: Floats
    width: Floats
    cells: Indices
    periodic: Bools
    clip: bool = False
    numbered: bool = False

    @classmethod
    def of(cls, problem: Problem) -> Self:
        """Return the partition that a problem declares; BadInput beyond 32-bit indices."""
        axes = problem.state_box.values()
        size = math.prod(axis.cells for axis in axes)
        if size > MAX_CELLS:
            fault = f"{size:.3g} cells do not fit in memory (limit {MAX_CELLS:.3g})"
            raise BadInput(f"{fault}; use fewer cells", "state_box")
        low, high = np.array([axis.low for axis in axes]), np.array([axis.high for axis in axes])
        cells = np.array([axis.cells for axis in axes], dtype=np.int64)
        return cls(
            names=problem.states,
            low=low,
            high=high,
            width=(high - low) / cells,
            cells=cells,
            periodic=np.array([axis.periodic for axis in axes]),
            clip=problem.on_exit == "clip",
            numbered=endings.numbered(problem),
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
            One array per axis; they broadcast against each other. Or one array of points, shape
            (..., d), where that can mean nothing else.
        clip
            Saturate finite images into the box; default: as the problem's ``on_exit`` says.
        """
        images = [
            x if type(x) is np.ndarray and x.dtype == np.float64 else inputs.real(x, "images")
            for x in self._by_axis(images)
        ]
        clip = None if clip is None else inputs.flag(clip, "clip")
        try:
            index = self.index(images, clip)
        except ValueError:
            shapes = ", ".join(str(x.shape) for x in images)
            raise BadInput(f"the axes have different shapes: {shapes}", "images") from None
        return np.where(index >= 0, index, -1.0).astype(np.int64)

    def _by_axis(self, images: Sequence[Floats]) -> Sequence[Floats]:
        d = self.dimension
        if isinstance(images, np.ndarray) and images.ndim > 1 and images.shape[-1] == d:
            if len(images) == d > 1:
                raise BadInput(
                    f"an array of shape {images.shape} may hold {d} points or {d} axes; pass "
                    "list(X.T) for points in rows, list(X) for axes in rows",
                    "images",
                )
            return list(np.moveaxis(images, -1, 0))
        if not hasattr(images, "__len__") or len(images) != d:
            raise BadInput(
                f"{shown(images)} is not one array for each of {d} axes; pass list(X.T) for points "
                "in rows",
                "images",
            )
        return images

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

    def states(self, images: Floats, clip: bool | None = None) -> Floats:
        """Return images as states, shape (r, d): wrapped and, under ``clip``, moved into the box.

        NaN on a circle of which an image is too many turns away. Parameters as for :meth:`locate`.
        """
        images = inputs.states(images, self.names, "images")
        if images.ndim != 2:
            raise BadInput(f"states have shape (r, {self.dimension}), not {images.shape}", "images")
        saturate = self.clip if clip is None else inputs.flag(clip, "clip")
        columns = [axis.state(images[:, k], saturate) for k, axis in enumerate(self.axes)]
        return np.stack(columns, axis=-1)

    def enter(self, images: Floats) -> tuple[Floats, Indices]:
        """Return the states that images or starts become, shape (r, d), and their cells."""
        states = self.states(images)
        return states, self.locate(list(states.T))

    def deviation(self, x: Floats, point: Floats) -> Floats:
        """Return x - point, on periodic axes the shortest way round."""
        away, span = x - point, self.high - self.low
        turns = np.where(self.periodic, np.round(away / span), 0.0)
        return np.asarray(away - turns * span)

    def domain(self, cell: NDArray[np.integer]) -> tuple[Floats, Floats, Indices]:
        """Return boxes that hold all states, sample points and corners of cells.

        A first cell on a circle has states at both ends of the axis, near ``high`` up to ``high``
        itself; it has a box at each.

        Returns
        -------
        low, high : shape (boxes, d)
            The ends.
        owner : shape (boxes,)
            Position in ``cell`` of the cell of each box; the first boxes are those of the cells in
            order.
        """
        index = np.stack(self.multi_index(cell), axis=-1).astype(np.float64)
        margin = np.array([axis.margin for axis in self.axes])
        first, last, owner = index - margin, index + 1 + margin, np.arange(len(index))
        for k in np.flatnonzero(self.periodic):
            seam = np.flatnonzero(first[:, k] < 0)
            first, last, owner = (
                np.concatenate([ends, ends[seam]]) for ends in (first, last, owner)
            )
            beyond = slice(len(first) - len(seam), None)
            first[beyond, k], last[beyond, k] = self.cells[k] - margin[k], self.cells[k] + margin[k]
        return self.low + first * self.width, self.low + last * self.width, owner

    @cached_property
    def axes(self) -> tuple[AxisCells, ...]:
        """The axes in plain numbers."""
        stride = [float(math.prod(self.shape[k + 1 :])) for k in range(self.dimension)]
        columns = (x.tolist() for x in (self.low, self.high, self.width, self.cells.astype(float)))
        axes = zip(*columns, stride, self.periodic.tolist(), strict=True)
        return tuple(AxisCells(*axis) for axis in axes)

    def multi_index(self, cell: NDArray[np.integer]) -> tuple[Indices, ...]:
        """Return the index of each cell on every axis."""
        return np.unravel_index(inputs.indices(cell, self.size, "cell"), self.shape)

    def centres(self, cell: NDArray[np.integer]) -> Floats:
        """Return the centres of cells, shape (len(cell), d)."""
        index = np.stack(self.multi_index(cell), axis=-1)
        return self.low + (index + 0.5) * self.width

    def samples(self, cell: NDArray[np.integer], offsets: Floats) -> list[Floats]:
        """Return the sample points of cells: per axis an array of shape (len(cell), points)."""
        return [
            self.place(k, index[:, None], offsets[None, :, k])
            for k, index in enumerate(self.multi_index(cell))
        ]

    def place(self, k: int, index: Indices, offset: Floats) -> Floats:
        """Return low + (index + offset) width on an axis; ``high`` where that is its end."""
        x = self.low[k] + (index + offset) * self.width[k]
        last = (offset == 1) & (index == self.cells[k] - 1)
        return np.asarray(np.where(last, self.high[k], x))

    def mask(
        self,
        blocks: Iterable[tuple[Indices | range, ...]],
        guard: Callable[[], object] = lambda: None,
    ) -> Bools:
        """Return which cells lie in a union of blocks (on each axis a range, or an index array).

        ``guard`` is called before every block; it may raise.
        """
        inside = np.zeros(self.shape, dtype=np.bool_)
        for block in blocks:
            guard()
            spans = [slice(a.start, a.stop) for a in block if isinstance(a, range)]
            inside[tuple(spans) if len(spans) == len(block) else np.ix_(*block)] = True
        return inside.ravel()

    def around_point(self, point: Sequence[float], where: str) -> tuple[Indices, ...]:
        """Return the block of closed cells within 1e-9 widths of a point."""
        block = []
        for axis, name, x in zip(self.axes, self.names, point, strict=True):
            state = float(axis.state(np.asarray(x, dtype=np.float64), clip=False))
            t, n = _units(state, axis.low, axis.width), int(axis.cells)
            if math.isnan(t):
                raise BadInput(f"{x!r} is too many turns away from the axis", f"{where}.{name}")
            if not (-EDGE <= t <= n + EDGE or axis.low <= state <= axis.high):
                raise BadInput(
                    f"{x!r} is outside the axis, [{axis.low!r}, {axis.high!r}]; move it inside, "
                    f"or widen {name} in state_box{_as_degrees(x, axis)}",
                    f"{where}.{name}",
                )
            touched = np.arange(math.ceil(t - 1 - EDGE), math.floor(t + EDGE) + 1)
            block.append(np.unique(touched % n if axis.periodic else np.clip(touched, 0, n - 1)))
        return tuple(block)

    def inside_box(self, box: Mapping[str, tuple[float, float]], where: str) -> tuple[range, ...]:
        """Return the block of cells inside a box, up to 1e-9 widths."""

        def cells(ta: float, tb: float) -> tuple[float, float]:
            return math.ceil(ta - EDGE), math.floor(tb + EDGE) - 1

        return self._block(box, where, cells)

    def overlapping_box(
        self, box: Mapping[str, tuple[float, float]], where: str
    ) -> tuple[range, ...]:
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
    ) -> tuple[range, ...]:
        block = []
        for k, name in enumerate(self.names):
            n = int(self.cells[k])
            if name not in box:
                block.append(range(n))
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
            begin, end = max(int(first), 0), min(int(last), n - 1) + 1
            block.append(range(begin, max(begin, end)))
        return tuple(block)


def _as_degrees(x: float, axis: AxisCells) -> str:
    """Return what a number means in degrees, where the axis is about a turn; else nothing."""
    turn = 0.9 <= (axis.high - axis.low) / math.tau <= 1.1 and abs(x) > math.tau
    return f" ({x:.6g} degrees are {math.radians(x)!r})" if turn else ""


def _units(x: float, low: float, width: float) -> float:
    """Return (x - low) / width; infinite where it overflows."""
    with np.errstate(over="ignore"):
        return float((x - low) / width)

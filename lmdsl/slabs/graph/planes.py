"""Where paths lead, over ranks: the room of whole planes of the first axis, made once they are met.

An array over the box is addresses here: only pages that are written to take memory.
"""

import mmap
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Indices
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.room import FAR, free_room


class Planes:
    """The room of cells, of whole planes of the first axis; several threads may ask at once.

    Parameters
    ----------
    partition, number, free
        The cells, what is known of their numbers, and how many of all are free.
    meet
        Makes known what cells are, from one to before another.

    Attributes
    ----------
    room
        See :func:`~lmdsl.model.grid.room.free_room`; shape (N,), of the planes that are known.
    """

    def __init__(
        self, partition: Partition, number: NDArray[np.int32], free: int,
        meet: Callable[[int, int], None],
    ) -> None:  # fmt: skip
        self.partition, self.shape = partition, partition.shape
        self._number, self._free, self._meet = number, free, meet
        self.room = untouched(partition.size, np.uint8)
        self._known = np.zeros(self.shape[0], dtype=np.bool_)
        self._lock = threading.Lock()

    def meet(self, state: Floats, slope: Floats) -> None:
        """Make known where paths lead: see :meth:`CellSets.meet_paths`.

        An arc lies in the hull of its ends and of the two points (Bezier's) that are a third of a
        slope away from them.
        """
        if self._known.all():
            return
        axis, n = self.partition.axes[0], self.shape[0]
        low, high = np.inf, -np.inf
        for points in (state, state[:-1] + slope[:-1] / 3, state[1:] - slope[1:] / 3):
            places = points[np.isfinite(points)]  # no other place is in the box
            low, high = min(low, places.min(initial=low)), max(high, places.max(initial=high))
        if low > high:
            return
        first, last = (low - axis.low) / axis.width - 1, (high - axis.low) / axis.width + 1
        if not axis.periodic:
            planes = np.arange(*np.floor(np.clip([first, last + 1], 0, n)).astype(np.int64))
            ends = [0] * bool(first < 0) + [n - 1] * bool(last >= n)  # where images may be moved
            self.make(np.union1d(planes, np.array(ends, dtype=np.int64)))
        elif last - first < n and abs(first) < 2.0**31:
            self.make(np.arange(int(np.floor(first)), int(np.floor(last)) + 1) % n)
        else:
            self.make(np.arange(n))

    def make(self, planes: Indices) -> None:
        """Make some planes known, one run of neighbours after the other."""
        with self._lock:
            wanted = np.zeros(len(self._known), dtype=np.bool_)
            wanted[planes] = True
            wanted &= ~self._known
            ends = np.flatnonzero(np.diff(wanted, prepend=False, append=False)).tolist()
            for first, last in zip(ends[::2], ends[1::2], strict=True):
                self._fill(first, last)
            self._known |= wanted

    def _fill(self, first: int, last: int) -> None:
        """Work out the planes first..last-1, from what is up to FAR planes away."""
        circles = self.partition.periodic.copy()
        n, plane = self.shape[0], self.partition.size // self.shape[0]
        around = np.arange(first - FAR, last + FAR)
        if not circles[0]:
            around = around[(around >= 0) & (around < n)]
        for k in np.unique(around % n).tolist():
            self._meet(k * plane, (k + 1) * plane)
        number = self._number.reshape(self.shape)[around % n]
        circles[0] = False  # what is beyond these planes is too far away to matter
        room = free_room((number >= 0) & (number < self._free), circles).reshape(number.shape)
        at = int(np.searchsorted(around, first))
        self.room.reshape(self.shape)[first:last] = room[at : at + last - first]


SMALL = 2**26  # bytes; an array of so many is taken as a whole, for its pages may be large


def untouched(size: int, kind: Any) -> NDArray[Any]:
    """Return an array, zeros at first, of which only the parts that are written to take memory."""
    length = max(1, size * np.dtype(kind).itemsize)
    if length <= SMALL or not hasattr(mmap, "MAP_ANONYMOUS"):
        return np.zeros(size, dtype=kind)
    pages = mmap.mmap(-1, length, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):  # a page of 2 MB would hold half a million numbers
        pages.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(pages, dtype=kind, count=size)

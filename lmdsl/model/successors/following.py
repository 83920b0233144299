"""What becomes of steps as ranges decide it, stretch after stretch: by tables of box or window.

A rank knows no more of the box than a window: the planes that the ranges of its own steps can meet.
"""

from collections.abc import Callable
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Guard, Indices
from lmdsl.model.grid.partition import Partition
from lmdsl.model.grid.windows import Window, joined
from lmdsl.model.sets import CellSets
from lmdsl.model.successors import counting
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem

SLACK = 8  # part of a window that is added on either side when it is enlarged


class PathTables(NamedTuple):
    """The tables of what decides a path, and where one may be put that is in the attractor."""

    avoid: counting.Table
    attractor: counting.Table
    absorbed: Indices  # multi-index of a cell of A, shape (d,)

    @classmethod
    def of(
        cls, problem: Problem, sets: CellSets, partition: Partition, guard: Guard | None = None
    ) -> "PathTables":
        """Return the tables of the sets of a problem."""
        some = int(np.argmax(sets.attractor))
        cell = np.array([int(k[0]) for k in partition.multi_index(np.array([some]))])
        sums = cls.within(problem, Window.whole(partition), sets.avoid, sets.attractor, guard)
        return sums._replace(absorbed=cell)

    @classmethod
    def within(
        cls, problem: Problem, window: Window, avoid: Bools, attractor: Bools,
        guard: Guard | None = None,
    ) -> "PathTables":  # fmt: skip
        """Return the tables of a window, of whose cells these are marks; ``absorbed`` is no cell.

        See :class:`Following`.
        """
        absorbs = problem.judged == "path" and absorbed_on_way(problem.local_controller)
        lost = counting.table(avoid, window, guard)
        return cls(
            lost,
            counting.table(attractor, window, guard) if absorbs else lost,  # which none stays in
            np.zeros(window.partition.dimension, dtype=np.int64),
        )


class WindowSets(NamedTuple):
    """What the cells of a window are."""

    avoid: Bools
    attractor: Bools


class WindowTables(NamedTuple):
    """A window, and the tables of its cells."""

    window: Window
    tables: PathTables


class Following:
    """Lets ranges decide what becomes of steps, stretch after stretch, by tables of windows.

    Parameters
    ----------
    known
        Returns a window that holds runs of planes, from first to last of each, with its tables.
    """

    def __init__(self, known: Callable[[NDArray[Any], NDArray[Any]], WindowTables]) -> None:
        self.known = known
        self.place: NDArray[Any] | None = None

    def judge(
        self, first: NDArray[Any], last: NDArray[Any], out: Bools, way: Bools,
        state: NDArray[np.uint8],
    ) -> None:  # fmt: skip
        """Do as :func:`counting.judge`.

        The range of a step that was absorbed becomes the first cell of the one by which it was: no
        cell is told that own ranges do not meet.
        """
        going = (state == counting.GOING) & ~out
        before = state == counting.ABSORBED
        window, tables = self.known(first[..., 0][going], last[..., 0][going])
        entered = first.copy(), last.copy()
        window.enter(*entered)
        counting.judge(tables, *entered, out, way, state)
        absorbed = state == counting.ABSORBED
        if absorbed.any():
            place = first.copy()
            if self.place is not None:
                place[before] = self.place[before]
            first[absorbed] = last[absorbed] = place[absorbed]
            self.place = place


class GrowingWindow:
    """Tables of a window that is enlarged when ranges leave it, for several threads.

    Parameters
    ----------
    problem, partition, sets, guard
        As for :meth:`PathTables.of`; of the sets no cell outside the window is read.
    planes
        Number of planes of the cells that steps begin in.
    """

    def __init__(
        self, problem: Problem, partition: Partition, sets: CellSets, planes: int,
        guard: Guard | None = None,
    ) -> None:  # fmt: skip
        self.problem, self.partition, self.sets, self.guard = problem, partition, sets, guard
        self.planes = planes
        self._runs = np.empty((0, 2), dtype=np.int64)
        self._known: WindowTables | None = None
        self._lock = Lock()

    def __call__(self, first: NDArray[Any], last: NDArray[Any]) -> WindowTables:
        """Return a window that holds runs of planes, with its tables."""
        known = self._known
        if known is not None and known.window.holds(first, last).all():
            return known
        with self._lock:
            known = self._known
            if known is None or not known.window.holds(first, last).all():
                ends = (np.append(a, b) for a, b in zip(self._runs.T, (first, last), strict=True))
                self._runs = joined(*ends)
                known = self._known = None  # before others take its place
                known = self._known = self._made()
            return known

    def _made(self) -> WindowTables:
        exact = Window.around(self.partition, self._runs)
        slack = max(exact.planes, self.planes) // SLACK
        window = Window.around(self.partition, self._runs, slack)
        avoid, attractor = window.of(self.sets.avoid), window.of(self.sets.attractor)
        return WindowTables(
            window, PathTables.within(self.problem, window, avoid, attractor, self.guard)
        )


def judging(
    problem: Problem, partition: Partition, sets: CellSets, cell: Indices, guard: Guard,
    windowed: bool,
) -> Callable[[], Callable[..., None]]:  # fmt: skip
    """Return what begins to judge the steps of some pairs, by tables of the box or of a window."""
    if not windowed:
        judge = partial(counting.judge, PathTables.of(problem, sets, partition, guard))
        return lambda: judge
    plane = partition.size // partition.shape[0]
    planes = int(cell[-1] - cell[0]) // plane + 1 if len(cell) else 1
    known = GrowingWindow(problem, partition, sets, planes, guard)
    return lambda: Following(known).judge

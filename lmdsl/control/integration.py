"""Steps of the true differential equation, and what it meets on the way, to any fineness.

The path of a run is followed by an accurate integrator. It is looked at wherever something else
than a free cell may be near, at least LOOKS times a cell, and the time of an event is found by
bisection. So what a simulation says of paths rests on no step that the model was compiled with.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from lmdsl.common.types import Bools, Floats, Guard, Statuses
from lmdsl.control.steps import Moved
from lmdsl.machine.kernels import fixed, kernel
from lmdsl.model.grid.axis import number_on
from lmdsl.model.grid.room import free_room
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.true_map import TrueMap
from lmdsl.systems.accurate import ATTEMPTS, AccurateFlow, Arc, place, places

LOOKS = 32  # places of a path for each cell width that it covers, where an event may be near
LEAST_PART = 1e-5  # of an arc between two places
HALVINGS = 40  # of the time between the last place without an event and the first with one
SAFETY = 1.5  # speed on an arc at most, in parts of the largest at its stages


class Integrator:
    """Steps of the equation that a problem declares, a sampling time each.

    Parameters
    ----------
    true_map
        That of a problem with a differential equation.
    status
        What every cell is, shape (N,); None where nothing on the way is an event.
    attempts
        Steps of a run above which it is given up.
    """

    def __init__(
        self, true_map: TrueMap, status: Statuses | None = None, attempts: int = ATTEMPTS
    ) -> None:
        problem, partition = true_map.problem, true_map.partition
        flow = problem.flow()
        assert flow is not None
        self.flow, self.partition = AccurateFlow(flow, partition.width, attempts), partition
        self._true_map = true_map
        self.status, self._room = status, np.zeros(0, dtype=np.uint8)
        self.judged = status is not None and problem.judged == "path"
        if status is not None and self.judged:
            free = ~np.isin(status, (CellStatus.ATTRACTOR, CellStatus.AVOID))
            self._room = free_room(free.reshape(partition.shape), partition.periodic)
        self._axes = np.array(partition.axes, dtype=np.float64)

    @property
    def method(self) -> str:
        """How the equation is integrated, in words."""
        return self.flow.method

    def images(
        self, x: Floats, u: Floats, w: Sequence[Floats], guard: Guard | None = None
    ) -> Floats:
        """Return where runs are after the step, whatever they meet, not wrapped, shape (r, d)."""
        end = self.flow(self._true_map.named(list(x.T), list(u.T), w), guard)
        return np.ascontiguousarray(end[: self.partition.dimension].T)

    def move(self, values: Mapping[str, Floats], guard: Guard, absorb: bool, pieces: int) -> Moved:
        """See :meth:`lmdsl.control.steps.Steps.move`."""
        count, d = len(values[self.partition.names[0]]), self.partition.dimension
        watch = _Watch(self, count, absorb, pieces)
        needed = self.judged or pieces
        end = self.flow(values, guard, watch if needed else None)
        stopped = watch.cell >= -1
        final = np.ascontiguousarray(end[:d].T)
        state, cell = self.partition.enter(final)
        if stopped.any():
            on_way = np.ascontiguousarray(watch.where[:d, stopped].T)
            state[stopped] = self.partition.states(on_way, clip=False)
            cell[stopped] = watch.cell[stopped]
            end[:, stopped] = watch.where[:, stopped]
        part = np.where(stopped, watch.when / self.flow.step, 1.0)
        integral = end[d] if len(end) > d else np.zeros(count)
        for piece in watch.drawn:
            open_ = np.isnan(piece).any(axis=1)
            piece[open_] = end[:d, open_].T
        return Moved(state, cell, integral, watch.drawn, part)


class _Watch:
    """Looks at arcs: finds the first event of every run, and states to be drawn."""

    def __init__(self, integrator: Integrator, count: int, absorb: bool, pieces: int) -> None:
        self.integrator, self.absorb = integrator, absorb
        self.outputs = integrator.flow.outputs
        self.cell = np.full(count, -2)  # of the event; -2 where there was none
        self.when = np.zeros(count)  # time of the event since the start
        self.where = np.full((self.outputs, count if integrator.judged else 0), np.nan)
        self.drawn = np.full((pieces, count, integrator.partition.dimension), np.nan)

    def __call__(self, arc: Arc) -> Bools:
        """Return which rows of an arc end on it."""
        ended = np.zeros(len(arc.rows), dtype=np.bool_)
        time = np.full(len(arc.rows), np.inf)
        if self.integrator.judged:
            near = self._near(arc)
            if near.any():
                time[near] = self._events(arc, near)
                ended = np.isfinite(time)
        if len(self.drawn):
            self._draw(arc, time)
        return ended

    def _near(self, arc: Arc) -> Bools:
        """Return which rows may meet something else than free cells on an arc."""
        p = self.integrator.partition
        cell = p.index(list(arc.start[: p.dimension]), clip=False)
        inside = cell >= 0
        room = np.zeros(len(cell))
        room[inside] = self.integrator._room[cell[inside].astype(np.int64)] - 1.0001
        fast = SAFETY * (arc.steep[: p.dimension] / p.width[:, None]).max(axis=0)
        near: Bools = ~(room >= fast)
        return near

    def _events(self, arc: Arc, near: Bools) -> Floats:
        """Return when rows near an event meet it, 0 to 1, and note where; infinite if never."""
        own, p = self.integrator, self.integrator.partition
        start, bends = np.ascontiguousarray(arc.start[:, near]), arc.bends(near)
        fast = SAFETY * (arc.steep[: p.dimension, near] / p.width[:, None]).max(axis=0)
        time, cell = np.full(len(fast), np.inf), np.full(len(fast), -2)
        assert own.status is not None
        events = np.zeros(256, dtype=np.bool_)
        events[CellStatus.AVOID], events[CellStatus.ATTRACTOR] = True, self.absorb
        _first(start, bends, own._axes, fixed(own.status), own._room, events,
               not p.clip, fast, time, cell)  # fmt: skip
        met = np.isfinite(time)
        rows = arc.rows[near][met]
        found = np.empty((self.outputs, int(met.sum())))
        places(start[:, met], bends[:, :, met], time[met], found)
        self.where[:, rows], self.cell[rows] = found, cell[met]
        self.when[rows] = arc.time[near][met] + arc.length[near][met] * time[met]
        return time

    def _draw(self, arc: Arc, until: Floats) -> None:
        pieces, step = len(self.drawn), self.integrator.flow.step
        d = self.integrator.partition.dimension
        for k in range(pieces):
            t = ((k + 1) / (pieces + 1) * step - arc.time) / arc.length
            on = (t > 0) & (t <= np.minimum(1 + 1e-9, until))
            if on.any():
                found = np.empty((self.outputs, int(on.sum())))
                places(arc.start[:, on], arc.bends(on), np.minimum(t[on], 1.0), found)
                self.drawn[k, arc.rows[on]] = found[:d].T


@kernel
def _cell(start, bends, i, t, axes):  # type: ignore[no-untyped-def]
    """Return the cell of run i at time t of its arc, NaN outside."""
    index = 0.0
    for k in range(len(axes)):
        index += number_on(axes, k, place(start, bends, k, i, t))
    return index


@kernel
def _event(cell, status, events, forbid):  # type: ignore[no-untyped-def]
    """Return whether being in a cell, NaN outside, ends a run."""
    return events[status[np.int64(cell)]] if cell >= 0.0 else forbid


@kernel
def _first(  # type: ignore[no-untyped-def]
    start, bends, axes, status, room, events, forbid, fast, time, found
):
    """Fill in when runs first meet an event on an arc, and its cell, -1 outside.

    Parameters
    ----------
    start, bends
        See :func:`lmdsl.systems.accurate.place`.
    axes, status, room, events, forbid
        The numbers of the axes; what every cell is; how far other than free cells are; which
        statuses are events; whether leaving the box is one.
    fast
        Largest speed on the arc, in cells of an axis.
    """
    for i in range(len(time)):
        fine = min(max(1.0 / (LOOKS * fast[i]), LEAST_PART), 1.0)
        before, t, met = 0.0, 0.0, False
        cell = _cell(start, bends, i, t, axes)
        while t < 1.0 and not met:
            free = room[np.int64(cell)] - 1.0001 if cell >= 0.0 else 0.0
            before, t = t, min(t + max(fine, free / fast[i]), 1.0)
            cell = _cell(start, bends, i, t, axes)
            met = _event(cell, status, events, forbid)
        if met:
            for _ in range(HALVINGS):
                middle = 0.5 * (before + t)
                here = _cell(start, bends, i, middle, axes)
                if _event(here, status, events, forbid):
                    t, cell = middle, here
                else:
                    before = middle
            time[i], found[i] = t, np.int64(cell) if cell >= 0.0 else -1

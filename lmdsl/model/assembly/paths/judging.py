"""The way of a sample through the box: where it first enters the attractor, avoid or the outside.

The path of a Runge-Kutta step is a cubic Hermite arc for each substep. It is judged at its parts
in order, from the first after the start to the image, and the earliest event decides: entering the
attractor absorbs the sample there; leaving the box or entering avoid is an escape.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.model.assembly.paths import arcs
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.systems.runge_kutta import RungeKutta

NOWHERE = -2  # number of no set of cells: one that no path enters


SHORT = 32  # number of doubles of a path up to which all its knots are evaluated before any is kept
KEPT = 2**23  # number of doubles of paths above which fewer samples are judged at a time


class Endings(NamedTuple):
    """What became of samples.

    Attributes
    ----------
    cell
        Index of the cell that decides: of the first event, or of the image; NaN outside. It has
        the shape of the samples.
    place
        Where that is, not wrapped, shape (d, samples), or (0, samples) where nobody asks.
    integral
        Integral of the cost rate until then, NaN where the rate was negative or not a number on
        the way; shape (samples,), or (0,) without a rate.
    time
        When that is, in Runge-Kutta steps from the start, shape (samples,); (0,) of a map.
    """

    cell: Floats
    place: Floats
    integral: Floats
    time: Floats


def path_doubles(flow: RungeKutta) -> int:
    """Return how many doubles the path of a sample takes."""
    outputs = len(flow.field.formulas)
    return 2 * (flow.substeps + 1) * outputs + 4 * flow.substeps * flow.integrals + outputs


class PathJudge:
    """Judges the paths of samples; it may be called from several threads at once.

    Parameters
    ----------
    flow
        Integrates the equation, and the cost rate where there is one.
    partition, sets
        The box and its sets.
    endpoint
        Whether only the image is judged.
    absorb
        Whether entering the attractor is an event.
    """

    def __init__(
        self,
        flow: RungeKutta,
        partition: Partition,
        sets: CellSets,
        endpoint: bool,
        absorb: bool = True,
    ) -> None:
        self.flow, self.partition, self.endpoint = flow, partition, endpoint
        self.most = KEPT // path_doubles(flow)
        self.sets = sets
        self.ground = arcs.Ground(
            np.array(partition.axes, dtype=np.float64),
            sets.number,
            len(sets.free) if absorb else NOWHERE,
            sets.room(partition),
            not partition.clip,
        )

    def __call__(
        self, values: Mapping[str, Floats], shape: tuple[int, ...], guard: Guard, places: bool
    ) -> Endings:
        """Judge samples given as named arrays that broadcast to ``shape``; see :class:`Endings`.

        Where there are many samples, some at a time.
        """
        if math.prod(shape) <= max(1, self.most):
            return self._judged(values, shape, guard, places)
        k = int(np.argmax(shape))
        last, halves = len(shape) - 1 - k, []  # axes of arrays count from the last one
        for part in (slice(None, shape[k] // 2), slice(shape[k] // 2, None)):
            at = (Ellipsis, part, *[slice(None)] * last)
            some = {
                name: x[at] if x.ndim > last and x.shape[-1 - last] > 1 else x
                for name, x in values.items()
            }
            size = len(range(shape[k])[part])
            halves.append(self(some, (*shape[:k], size, *shape[k + 1 :]), guard, places))
        cell = np.concatenate([half.cell for half in halves], axis=k)
        count = cell.size

        def joined(parts: list[Floats], rows: int) -> Floats:
            each = [x.reshape(rows, *h.cell.shape) for x, h in zip(parts, halves, strict=True)]
            return np.concatenate(each, axis=k + 1).reshape(rows, count)

        place = joined([half.place for half in halves], len(halves[0].place))
        integral = joined([half.integral for half in halves], self.flow.integrals).ravel()
        return Endings(cell, place, integral, joined([half.time for half in halves], 1).ravel())

    def until(self, values: Mapping[str, Floats], time: Floats, guard: Guard) -> Floats:
        """Return the integral of samples, given by (r,) arrays, until a time of each, shape (r,).

        Times are above 0, in Runge-Kutta steps.
        """
        integral, most = np.empty(len(time)), max(1, self.most)
        arc = np.clip(np.ceil(time).astype(np.int64) - 1, 0, self.flow.substeps - 1)
        for first in range(0, len(time), most):
            some = slice(first, first + most)
            held = {name: x[some] for name, x in values.items()}
            knots = self._knots(held, time[some].shape, guard)
            begun = arc[some]
            arcs.integrals(*knots, self.partition.dimension, begun, time[some] - begun,
                           integral[some])  # fmt: skip
        return integral

    def _judged(
        self, values: Mapping[str, Floats], shape: tuple[int, ...], guard: Guard, places: bool
    ) -> Endings:
        flow, d, integrals = self.flow, self.partition.dimension, self.flow.integrals
        count, steps = math.prod(shape), flow.substeps
        state, slope, rate = self._knots(values, shape, guard)
        knots = self._cells(state, count)
        cell, arc, time = np.empty(count), np.full(count, steps - 1), np.ones(count)
        if self.endpoint:
            cell = knots[-1]
        else:
            speed, parts = np.zeros((steps, count)), np.zeros(count)
            self.sets.meet_paths(state[:, 0], slope[:, 0])
            arcs.speeds(state, slope, self.ground.axes, speed, parts)
            arcs.judge(arcs.Arcs(state, slope, knots, speed, parts), self.ground, cell, arc, time)
        place, integral = np.empty((d if places else 0, count)), np.empty(count * integrals)
        arcs.places(state, slope, arc, time, place)
        if integrals:
            arcs.integrals(state, slope, rate, d, arc, time, integral)
        return Endings(cell.reshape(shape), place, integral, arc + time)

    def _knots(
        self, values: Mapping[str, Floats], shape: tuple[int, ...], guard: Guard
    ) -> tuple[Floats, Floats, Floats]:
        """Return the knots' states and slopes and the integrand at the stages; see _judge."""
        flow = self.flow
        outputs, integrals, steps = len(flow.field.formulas), flow.integrals, flow.substeps
        state, slope = (np.empty((steps + 1, outputs, *shape)) for _ in range(2))
        rate = np.empty((steps, 4 * integrals, *shape))
        found = self._found(values, guard)
        for s in range(steps + 1):
            for lines in (state[s], slope[s]):
                for k in range(outputs):
                    lines[k] = next(found)
            for i in range(4 * (s < steps)):
                for k in range(integrals):
                    rate[s, 4 * k + i] = next(found)
        state, slope, rate = (
            x.reshape(*x.shape[:2], math.prod(shape)) for x in (state, slope, rate)
        )
        return state, slope, rate

    def _found(self, values: Mapping[str, Floats], guard: Guard) -> Iterator[Floats]:
        """Yield the state, the slope and the stages of one knot after the other."""
        if path_doubles(self.flow) > SHORT or self.flow.written is None:
            for knot in self.flow.knots(values, guard):
                yield from (*knot.state, *knot.slope, *sum(knot.stages, ()))
            return
        arrays = list(self.flow.written(values, guard))[::-1]
        while arrays:  # none is kept when the next one is taken
            yield arrays.pop()

    def _cells(self, state: Floats, count: int) -> Floats:
        """Return the cells of the knots, NaN outside; under ``clip`` the image is moved first."""
        cells = np.empty((len(state), count))
        for s, knot in enumerate(state):
            last = s == len(state) - 1
            cells[s] = self.partition.index(
                list(knot[: self.partition.dimension]), self.partition.clip and last
            )
        return cells

"""Compiled loops over the arcs of paths, and over the ground that they cross."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.axis import number_on

MOST_PARTS = 1_000  # most parts of an arc; else twice as many as its steepest end is cells long


class Arcs(NamedTuple):
    """The paths of samples.

    Attributes
    ----------
    state, slope
        Knots of all samples, shape (substeps + 1, d and integrals, samples).
    cell
        Cells of the knots, shape (substeps + 1, samples), NaN outside.
    speed
        Greatest speed along each arc, in cells of an axis, shape (substeps, samples).
    parts
        Number of parts of each arc of a sample, shape (samples,).
    """

    state: Floats
    slope: Floats
    cell: Floats
    speed: Floats
    parts: Floats


class Ground(NamedTuple):
    """What the box is where a path leads.

    Attributes
    ----------
    axes
        The numbers of the axes, shape (d, 6).
    number, attractor
        Target of every cell, shape (N,): negative in avoid, ``attractor`` in the attractor.
    room
        See :func:`lmdsl.model.grid.room.free_room`.
    forbid
        Whether leaving the box on the way is an escape.
    """

    axes: Floats
    number: NDArray[np.int32]
    attractor: int
    room: NDArray[np.uint8]
    forbid: bool


@kernel
def speeds(state, slope, axes, speed, parts):  # type: ignore[no-untyped-def]
    """Fill in ``speed`` and ``parts`` of :class:`Arcs`, zeros on entry."""
    count = np.uint64(len(parts))
    for k in range(len(axes)):
        scale = 1.0 / axes[k, 2]
        for s in range(len(slope)):
            m = slope[s, k]
            for i in range(count):
                steep = abs(m[i]) * scale
                parts[i] = steep if steep > parts[i] else parts[i]
        for s in range(len(speed)):
            a, b, m, n, line = state[s, k], state[s + 1, k], slope[s, k], slope[s + 1, k], speed[s]
            for i in range(count):
                bend = abs(3.0 * (b[i] - a[i]) - m[i] - n[i])  # Bernstein coefficients
                most = max(max(abs(m[i]), abs(n[i])), bend) * scale
                most = most if most >= 0.0 else np.inf  # not a number
                line[i] = most if most > line[i] else line[i]
    for i in range(count):
        whole = np.ceil(2.0 * parts[i])
        whole = whole if whole > 1.0 else 1.0
        parts[i] = whole if whole < MOST_PARTS else MOST_PARTS


@kernel
def _cell(state, slope, s, t, i, axes):  # type: ignore[no-untyped-def]
    """Return the cell of sample i at time t of arc s, NaN outside."""
    index = 0.0
    for k in range(len(axes)):
        index += number_on(axes, k, _hermite(state, slope, s, t, k, i))
    return index


@kernel
def _hermite(state, slope, s, t, k, i):  # type: ignore[no-untyped-def]
    """Return component k of sample i at time t of arc s."""
    a, b = state[s, k, i], state[s + 1, k, i]
    r = 1.0 - t
    bend = r * (slope[s, k, i] - (b - a)) - t * (slope[s + 1, k, i] - (b - a))
    return r * a + t * b + t * r * bend


@kernel
def judge(arcs, ground, cell, arc, time):  # type: ignore[no-untyped-def]
    """Fill in which cell decides, on which arc and when on it; see :class:`Endings`."""
    state, slope, knots, speed, parts = arcs
    axes, number, attractor, room, forbid = ground
    for i in range(np.uint64(len(cell))):
        s, t, at, ended = 0, 1.0, knots[0, i], False
        while not ended:
            j = 0.0
            while not ended and j < parts[i]:
                free = room[np.int64(at)] - 1.0001 if at >= 0.0 else 0.0
                blind = free * parts[i] < speed[s, i] * (parts[i] - j)  # other cells may be met
                j = j + max(1.0, np.floor(free / speed[s, i] * parts[i])) if blind else parts[i]
                t = j / parts[i]
                at = knots[s + 1, i] if j == parts[i] else _cell(state, slope, s, t, i, axes)
                if at >= 0.0:
                    n = number[np.int64(at)]
                    ended = (n < 0) | (n == attractor)
                else:
                    ended = forbid
            if s == len(speed) - 1:
                break
            s += not ended
        cell[i], arc[i], time[i] = at, s, t


@kernel
def places(state, slope, arc, time, place):  # type: ignore[no-untyped-def]
    """Fill in where the samples are then, shape (d, samples); at the end of an arc exactly."""
    for k in range(len(place)):
        for i in range(len(arc)):
            s = arc[i]
            end = time[i] == 1.0
            x = state[s + 1, k, i] if end else _hermite(state, slope, s, time[i], k, i)
            place[k, i] = x


@kernel
def integrals(state, slope, rate, k, arc, time, integral):  # type: ignore[no-untyped-def]
    """Fill in component k, an integral, until then; it never decreases along an arc.

    Where the integrand was negative or not a number before, it is that.
    """
    for i in range(len(integral)):
        s = arc[i]
        value = state[s + 1, k, i]
        if time[i] < 1.0:
            value = min(max(_hermite(state, slope, s, time[i], k, i), state[s, k, i]), value)
        for r in range(s + 1):
            for stage in range(rate.shape[1]):
                if not rate[r, stage, i] >= 0.0:
                    value = rate[r, stage, i]
        integral[i] = value

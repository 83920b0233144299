"""Enclosing blocks of boxes substep by substep, compiled: a group of components, and its arcs.

The operations are those of enclosing.py, sums with 0 are exact as there.
"""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats
from lmdsl.formulas.compiled.ends import UNIT
from lmdsl.formulas.compiled.machine import BLOCK, registers, run
from lmdsl.machine.kernels import kernel
from lmdsl.model.successors.compiled.enclosing import mean_values
from lmdsl.model.successors.compiled.sharing import Shared
from lmdsl.model.successors.enclosing import SLACK

START, FIRST, LAST, WAY, KNOT = range(5)  # of an arc: its start, slopes, and way; the next start


class GroupRoom(NamedTuple):
    """Registers of the tapes of a group, sides of boxes, and what is known of an arc."""

    box: Floats
    centre: Floats
    last_box: Floats
    last_centre: Floats
    away: Floats
    arc: Floats
    work: Floats


class GroupStretches(NamedTuple):
    """What is found of the own components of a group.

    Attributes
    ----------
    low, high
        Ends of all parts of the path, in order, and of the image, shape (stretches, own, boxes).
    rises, falls
        Whether the first part never goes below, or above, its start, shape (1, own, boxes).
    steep
        Of every arc the steepest end, in cells, shape (arcs, boxes).
    """

    low: Floats
    high: Floats
    rises: Bools
    falls: Bools
    steep: Floats


def room_for(shared: Shared, own: int) -> GroupRoom:
    """Return room for a group of so many components; threads need their own."""
    return GroupRoom(
        registers(shared.advance.box), registers(shared.advance.centre),
        registers(shared.last.box), registers(shared.last.centre),
        np.zeros((shared.sizes[1], 2, BLOCK)), np.zeros((5, own, 2, BLOCK)), np.zeros((7, BLOCK)),
    )  # fmt: skip


@kernel
def _load(rows, shared, given, begin, count):  # type: ignore[no-untyped-def]
    """Put boxes into registers; slopes and errors as they are at the start."""
    q, n, substeps, _ = shared.sizes
    for j in range(len(shared.place)):
        row = rows[shared.place[j]]
        for i in range(count):
            row[0, i], row[1, i] = given[j, 0, begin + i], given[j, 1, begin + i]
    if substeps > 1:
        for j in range(q * (n + 1)):
            x = 1.0 if (j < q * n) & (j % n == j // n) else 0.0
            for i in range(BLOCK):
                rows[q + j, 0, i] = rows[q + j, 1, i] = x


@kernel
def _centre(box, rows, side, away):  # type: ignore[no-untyped-def]
    """Put centres in place of boxes along all directions, and fill in the sides about them."""
    for k in range(len(side)):
        source, target = box[side[k]], rows[side[k]]
        for i in range(BLOCK):
            low, high = source[0, i], source[1, i]
            c = low / 2.0 + high / 2.0
            c = low if c < low else high if c > high else c
            target[0, i] = target[1, i] = c
            x, y = low - c, high - c
            x, y = x - abs(x) * UNIT, y + abs(y) * UNIT
            away[k, 0, i], away[k, 1, i] = low if c == 0.0 else x, high if c == 0.0 else y


@kernel
def _read(target, tapes, boxed, centred, away, first, rows):  # type: ignore[no-untyped-def]
    """Fill in what encloses outputs, some rows from ``first`` on."""
    for j in range(len(target)):
        k = rows[j] if len(rows) else first + j
        mean_values(target[j], boxed, tapes.out[k], centred[tapes.middle[k]], away)


@kernel
def _point(c, slopes, slack, low, high):  # type: ignore[no-untyped-def]
    """Fill in what holds the way from the start of an arc to a Bernstein point of a part of it."""
    for i in range(np.uint64(BLOCK)):
        low[i] = high[i] = 0.0
    for k in range(len(c)):
        if c[k] != 0.0:
            least, most = slopes[k, 0], slopes[k, 1]
            if c[k] < 0.0:
                least, most = most, least
            for i in range(np.uint64(BLOCK)):
                low[i] += c[k] * least[i]
                high[i] += c[k] * most[i]
    for i in range(np.uint64(BLOCK)):
        low[i] -= slack[i]
        high[i] += slack[i]


@kernel
def _part(points, start, slopes, work):  # type: ignore[no-untyped-def]
    """Fill in what holds a part of an arc, and the way from its start to its later points."""
    slack, a, b = work[0], work[1], work[2]
    x, y, low, high = work[3], work[4], work[5], work[6]
    _point(points[1], slopes, slack, low, high)
    for p in range(2, 4):
        _point(points[p], slopes, slack, a, b)
        for i in range(np.uint64(BLOCK)):
            low[i] = low[i] if low[i] < a[i] else a[i]
            high[i] = high[i] if high[i] > b[i] else b[i]
    _point(points[0], slopes, slack, a, b)
    for i in range(np.uint64(BLOCK)):
        s, e = start[0, i], start[1, i]
        least, most = a[i] if a[i] < low[i] else low[i], b[i] if b[i] > high[i] else high[i]
        p, q = s + least, e + most
        p, q = p - abs(p) * UNIT, q + abs(q) * UNIT
        still, zero = (least == 0.0) & (most == 0.0), (s == 0.0) & (e == 0.0)
        p, q = least if zero else p, most if zero else q
        p, q = s if still else p, e if still else q
        sound = q - p < np.inf
        x[i], y[i] = p if sound else -np.inf, q if sound else np.inf


@kernel
def _arc(s, points, room, width, limits, found):  # type: ignore[no-untyped-def]
    """Note all that is known of the s-th arc."""
    begin, end = limits
    arc, work = room.arc, room.work
    slack, x, y, low, high = work[0], work[3], work[4], work[5], work[6]
    for j in range(len(width)):
        slopes = arc[FIRST : WAY + 1, j]
        for i in range(BLOCK):
            slack[i] = 0.0
            for k in range(3):
                a, b = abs(slopes[k, 0, i]), abs(slopes[k, 1, i])
                slack[i] += a if a > b else b
            slack[i] *= SLACK
        for i in range(end - begin):
            for k in range(2):  # the slopes at both ends
                a, b = slopes[k, 0, i], slopes[k, 1, i]
                least = 0.0 if (a <= 0.0) & (b >= 0.0) else min(abs(a), abs(b)) / width[j]
                found.steep[s, begin + i] = max(found.steep[s, begin + i], least)
        for p in range(len(points)):
            at = s * len(points) + p
            _part(points[p], arc[START, j], slopes, work)
            for i in range(end - begin):
                found.low[at, j, begin + i], found.high[at, j, begin + i] = x[i], y[i]
                if at == 0:
                    found.rises[0, j, begin + i] = low[i] >= 0.0
                    found.falls[0, j, begin + i] = high[i] <= 0.0


@kernel
def _pass(source, target, count):  # type: ignore[no-untyped-def]
    """Copy the first registers."""
    for j in range(count):
        for i in range(BLOCK):
            target[j, 0, i], target[j, 1, i] = source[j, 0, i], source[j, 1, i]


@kernel
def enclose_substeps(  # type: ignore[no-untyped-def]
    shared, given, room, points, width, limits, found
):
    """Fill in what is found of boxes, between two limits.

    ``given`` are their ends, shape (inputs, 2, boxes); ``points`` the Bernstein points of the parts
    of an arc, shape (parts, 4, 3); ``width`` those of the cells of the own components.
    """
    q, n, substeps, parts = shared.sizes
    tapes, arc, own, path = shared.advance, room.arc, len(width), parts > 0
    none = shared.own[:0]
    for begin in range(limits[0], limits[1], BLOCK):
        end = min(begin + BLOCK, limits[1])
        _load(room.box, shared, given, begin, end - begin)
        _load(room.centre, shared, given, begin, end - begin)
        _centre(room.box, room.centre, shared.side, room.away)
        if path:
            for j in range(own):
                _pass(room.box[shared.own[j] : shared.own[j] + 1], arc[KNOT, j : j + 1], 1)
        for s in range(substeps):
            run(tapes.box, room.box)
            run(tapes.centre, room.centre)
            if path:
                _read(arc[LAST], tapes, room.box, room.centre, room.away, q, none)
                if s > 0:
                    _arc(s - 1, points, room, width, (begin, end), found)
                _pass(arc[KNOT], arc[START], own)
                _pass(arc[LAST], arc[FIRST], own)
                _read(arc[WAY], tapes, room.box, room.centre, room.away, q + own, none)
            if path or s == substeps - 1:
                _read(arc[KNOT], tapes, room.box, room.centre, room.away, 0, shared.own)
        if path:
            given_rows = q * (2 + n) + len(shared.place) - q
            _pass(room.box, room.last_box, given_rows)
            _pass(room.centre, room.last_centre, given_rows)
            run(shared.last.box, room.last_box)
            run(shared.last.centre, room.last_centre)
            _read(arc[LAST], shared.last, room.last_box, room.last_centre, room.away, 0, none)
            _arc(substeps - 1, points, room, width, (begin, end), found)
        last = len(found.low) - 1
        for j in range(own):
            for i in range(end - begin):
                found.low[last, j, begin + i] = arc[KNOT, j, 0, i]
                found.high[last, j, begin + i] = arc[KNOT, j, 1, i]

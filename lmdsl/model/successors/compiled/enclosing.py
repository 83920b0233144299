"""Enclosing images, paths and costs on many boxes: tapes run block by block.

The image of a box lies in N and in M + [-e, e] (enclosures.py): the natural interval, and the mean
value form about the centre with a bound of what rounding adds.
"""

from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.formulas.compiled.ends import LEAST, UNIT, down, up
from lmdsl.formulas.compiled.machine import BLOCK, registers, run
from lmdsl.machine.kernels import kernel
from lmdsl.model.successors.compiled.tapes import Step, Tapes

HERMITE = 2.0**-46  # relative error of a computed point of an arc, generously


class Given(NamedTuple):
    """Boxes and what acts on them: ends of states (B, d), controls (B, p), noise (B, r)."""

    low: Floats
    high: Floats
    control: Floats
    least: Floats
    most: Floats


class Enclosed(NamedTuple):
    """What is enclosed.

    Attributes
    ----------
    low, high
        Ends of all components of the image, shape (B, m).
    stretch
        How far a side of the box moves each component of the image, shape (B, m, d).
    arcs
        Ends of what holds each arc of the path that is judged, shape (B, arcs, d, 2).
    way
        Ends of what holds the ways from the start to the control points of the first arc, and of
        what holds the way to its end, shape (B, d, 4). Where the first do not hold 0, the arc
        leaves the start in one direction.
    knots
        Ends of all components at ends of arcs, (B, arcs, m, 2).
    middle, slope
        Where asked for: ends of what holds the images of centres and all that rounds, and of what
        holds the slopes in between, shapes (B, m, 2) and (B, m, d, 2): the image of x lies in
        middle + slope (x - centre).
    """

    low: Floats
    high: Floats
    stretch: Floats
    arcs: Floats
    way: Floats
    knots: Floats
    middle: Floats
    slope: Floats


class Room(NamedTuple):
    """Registers of the tapes of a step, sides of boxes about their centres, and what is found."""

    box: Floats
    centre: Floats
    end_box: Floats
    end_centre: Floats
    away: Floats
    found: Floats


def rows(step: Step) -> Room:
    """Return registers for a step; threads need their own."""
    return Room(
        registers(step.advance.box), registers(step.advance.centre), registers(step.end.box),
        registers(step.end.centre), np.zeros((step.sizes[0], 2, BLOCK)), np.zeros((2, BLOCK)),
    )  # fmt: skip


def enclose(step: Step, given: Given, held: Room | None = None, sloped: bool = False) -> Enclosed:
    """Enclose the step on boxes; with slopes if these are asked for. NaN is surely no number."""
    count, d, m = len(given.low), step.sizes[0], step.sizes[1]
    arcs, some = step.substeps if step.path else 0, count if sloped else 0
    found = Enclosed(
        np.empty((count, m)), np.empty((count, m)), np.empty((count, m, d)),
        np.empty((count, arcs, d, 2)), np.empty((count, d if step.path else 0, 4)),
        np.empty((count, arcs, m, 2)), np.empty((some, m, 2)), np.empty((some, m, d, 2)),
    )  # fmt: skip
    with np.errstate(all="ignore"):
        _enclose(step, given, rows(step) if held is None else held, found)
    if len(step.nowhere.middle):
        gone = ranges(step, step.nowhere, given)[0][:, 0] > 0.0
        found.low[gone, :d] = found.high[gone, :d] = found.arcs[gone] = np.nan
    return found


def ranges(step: Step, tapes: Tapes, given: Given) -> tuple[Floats, Floats]:
    """Enclose numbers that depend on states, controls and noise, shape (B, outputs) each."""
    shape = (len(given.low), len(tapes.middle))
    low, high = np.empty(shape), np.empty(shape)
    if shape[1]:
        sides, row = np.zeros((step.sizes[0], 2, BLOCK)), np.zeros((2, BLOCK))
        work = (registers(tapes.box), registers(tapes.centre), sides, row)
        _ranges(tapes, given, step.sizes, work, (low, high))
    return low, high


@kernel
def _load(rows, first, given, sizes, at, seed):  # type: ignore[no-untyped-def]
    """Put the boxes from ``at`` on into registers, components and their slopes at the start."""
    d, m, p, r = sizes
    count = min(BLOCK, len(given.low) - at)
    for k in range(d):
        for i in range(count):
            rows[k, 0, i], rows[k, 1, i] = given.low[at + i, k], given.high[at + i, k]
    for j in range(p):
        for i in range(count):
            rows[first + j, 0, i] = rows[first + j, 1, i] = given.control[at + i, j]
    for j in range(r):
        for i in range(count):
            rows[first + p + j, 0, i] = given.least[at + i, j]
            rows[first + p + j, 1, i] = given.most[at + i, j]
    if seed:
        for j in range(d, m * (d + 2)):
            x = 1.0 if (j >= m) & (j < m + m * d) & ((j - m) % d == (j - m) // d) else 0.0
            for i in range(BLOCK):
                rows[j, 0, i] = rows[j, 1, i] = x


@kernel
def _centre(box, rows, away):  # type: ignore[no-untyped-def]
    """Put centres in place of boxes, and fill in the sides about them."""
    for k in range(len(away)):
        for i in range(BLOCK):
            low, high = box[k, 0, i], box[k, 1, i]
            c = 0.5 * low + 0.5 * high
            c = low if c < low else high if c > high else c
            rows[k, 0, i] = rows[k, 1, i] = c
            x, y = low - c, high - c
            away[k, 0, i], away[k, 1, i] = x - abs(x) * UNIT, y + abs(y) * UNIT


@kernel
def mean_values(t, rows, out, middle, away):  # type: ignore[no-untyped-def]
    """Fill in what contains all values computed of an output on the boxes of a block."""
    value, error = rows[out[0]], rows[out[1]]
    for i in range(BLOCK):
        x, y = middle[0, i] - error[1, i], middle[1, i] + error[1, i]
        t[0, i], t[1, i] = x - (abs(x) * UNIT + LEAST), y + (abs(y) * UNIT + LEAST)
    for k in range(len(away)):
        if out[2 + k] < 0:
            continue  # no slope
        slope, side = rows[out[2 + k]], away[k]
        for i in range(BLOCK):
            p, q = slope[0, i] * side[0, i], slope[0, i] * side[1, i]
            r, s = slope[1, i] * side[0, i], slope[1, i] * side[1, i]
            p, q = p if p < q else q, q if p < q else p
            r, s = r if r < s else s, s if r < s else r
            x, y = p if p < r else r, s if q < s else q
            x, y = x - (abs(x) * UNIT + LEAST), y + (abs(y) * UNIT + LEAST)
            sound = (slope[1, i] - slope[0, i]) + (y - x) < np.inf
            x, y = t[0, i] + x, t[1, i] + y
            x, y = x - abs(x) * UNIT, y + abs(y) * UNIT
            t[0, i], t[1, i] = x if sound else -np.inf, y if sound else np.inf
    for i in range(BLOCK):
        x, y = t[0, i], t[1, i]
        sound = y - x < np.inf
        x, y = x if sound else -np.inf, y if sound else np.inf
        t[0, i] = x if x > value[0, i] else value[0, i]
        t[1, i] = y if y < value[1, i] else value[1, i]


@kernel
def _extend(arcs, b, s, k, low, high, fresh):  # type: ignore[no-untyped-def]
    """Make an arc hold a control point too."""
    arcs[b, s, k, 0] = low if fresh else min(arcs[b, s, k, 0], low)
    arcs[b, s, k, 1] = high if fresh else max(arcs[b, s, k, 1], high)


@kernel
def _points(arcs, tapes, held, at, s, row):  # type: ignore[no-untyped-def]
    """Extend arc s by the control points that are outputs from ``row`` on."""
    rows, middle, away, t = held
    for k in range(len(away)):
        mean_values(t, rows, tapes.out[row + k], middle[tapes.middle[row + k]], away)
        for i in range(min(BLOCK, len(arcs) - at)):
            _extend(arcs, at + i, s, k, t[0, i], t[1, i], False)


@kernel
def _ways(way, tapes, box, at, row, kind):  # type: ignore[no-untyped-def]
    """Note the ways from the start to control points, outputs from ``row`` on.

    ``kind`` 0: to the first, m/3; 1: to the last, b - a; 2: what the last but one lacks of that.
    """
    d = way.shape[1]
    for i in range(min(BLOCK, len(way) - at)):
        for k in range(d):
            low, high = box[tapes.out[row + k, 0], 0, i], box[tapes.out[row + k, 0], 1, i]
            w = way[at + i, k]
            if kind == 0:
                w[0], w[1] = low, high
            else:
                if kind == 1:
                    w[2], w[3] = low, high
                else:
                    low, high = down(w[2] - high), up(w[3] - low)
                w[0], w[1] = min(w[0], low), max(w[1], high)


@kernel
def _start(arcs, given, at, s):  # type: ignore[no-untyped-def]
    """Begin the first arc at the box."""
    for i in range(min(BLOCK, len(arcs) - at)):
        for k in range(arcs.shape[2]):
            _extend(arcs, at + i, s, k, given.low[at + i, k], given.high[at + i, k], True)


@kernel
def _knot(found, step, held, at, s):  # type: ignore[no-untyped-def]
    """Note the end of substep s: of the arc before it and, where there is one, the next."""
    rows, middle, away, t = held
    tapes, d, count = step.advance, len(away), min(BLOCK, len(found.low) - at)
    for k in range(len(found.low[0])):
        out = tapes.out[k]
        mean_values(t, rows, out, middle[tapes.middle[k]], away)
        for i in range(count):
            found.low[at + i, k], found.high[at + i, k] = t[0, i], t[1, i]
        for i in range(count if step.path else 0):
            found.knots[at + i, s, k, 0], found.knots[at + i, s, k, 1] = t[0, i], t[1, i]
        if step.path and k < d:
            for i in range(count):
                _extend(found.arcs, at + i, s, k, t[0, i], t[1, i], False)
                if s + 1 < step.substeps:
                    _extend(found.arcs, at + i, s + 1, k, t[0, i], t[1, i], True)
        for j in range(d):
            for i in range(count if s + 1 == step.substeps else 0):
                most = 0.0
                if out[2 + j] >= 0:
                    a, b = abs(rows[out[2 + j], 0, i]), abs(rows[out[2 + j], 1, i])
                    most = a if a > b else b
                found.stretch[at + i, k, j] = most * (away[j, 1, i] - away[j, 0, i])
        if len(found.slope) and s + 1 == step.substeps:
            _slopes(found, out, rows, middle[tapes.middle[k]], k, at)


@kernel
def _slopes(found, out, rows, middle, k, at):  # type: ignore[no-untyped-def]
    """Note the image of centres and the slopes of component k."""
    error = rows[out[1]]
    for i in range(min(BLOCK, len(found.low) - at)):
        found.middle[at + i, k, 0] = down(middle[0, i] - error[1, i])
        found.middle[at + i, k, 1] = up(middle[1, i] + error[1, i])
        for j in range(found.slope.shape[2]):
            for end in range(2):
                steep = rows[out[2 + j], end, i] if out[2 + j] >= 0 else 0.0
                found.slope[at + i, k, j, end] = steep


@kernel
def _pass(source, target, count):  # type: ignore[no-untyped-def]
    """Copy the first registers."""
    for j in range(count):
        for i in range(BLOCK):
            target[j, 0, i], target[j, 1, i] = source[j, 0, i], source[j, 1, i]


@kernel
def _enclose(step, given, held, found):  # type: ignore[no-untyped-def]
    d, m, p, r = step.sizes
    first = m * (2 + d)
    work = (held.box, held.centre, held.away, held.found)
    for at in range(0, len(given.low), BLOCK):
        _load(held.box, first, given, step.sizes, at, step.substeps > 1)
        _load(held.centre, first, given, step.sizes, at, step.substeps > 1)
        _centre(held.box, held.centre, held.away)
        if step.path:
            _start(found.arcs, given, at, 0)
        for s in range(step.substeps):
            run(step.advance.box, held.box)
            run(step.advance.centre, held.centre)
            if step.path:
                _points(found.arcs, step.advance, work, at, s, m)
                if s == 0:
                    _ways(found.way, step.advance, held.box, at, m + 2 * d, 0)
                    _ways(found.way, step.advance, held.box, at, m + 3 * d, 1)
                else:
                    _points(found.arcs, step.advance, work, at, s - 1, m + d)
                if s == 1:
                    _ways(found.way, step.advance, held.box, at, m + 2 * d, 2)
            _knot(found, step, work, at, s)
        if step.path:
            _pass(held.box, held.end_box, first + p + r)
            _pass(held.centre, held.end_centre, first + p + r)
            run(step.end.box, held.end_box)
            run(step.end.centre, held.end_centre)
            last = (held.end_box, held.end_centre, held.away, held.found)
            _points(found.arcs, step.end, last, at, step.substeps - 1, 0)
            if step.substeps == 1:
                _ways(found.way, step.end, held.end_box, at, d, 2)


@kernel
def _ranges(tapes, given, sizes, work, found):  # type: ignore[no-untyped-def]
    box, centre, away, t = work
    low, high = found
    d = sizes[0]
    plain = (d, d, sizes[2], sizes[3])
    for at in range(0, len(low), BLOCK):
        _load(box, d * (2 + d), given, plain, at, False)
        _load(centre, d * (2 + d), given, plain, at, False)
        _centre(box, centre, away)
        run(tapes.box, box)
        run(tapes.centre, centre)
        for k in range(low.shape[1]):
            mean_values(t, box, tapes.out[k], centre[tapes.middle[k]], away)
            for i in range(min(BLOCK, len(low) - at)):
                low[at + i, k], high[at + i, k] = t[0, i], t[1, i]

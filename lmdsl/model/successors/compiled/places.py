"""Where the states of a range of images lie: cells, and places within them, in whole numbers.

A place on an axis is cell times 2^32 plus the part of the cell, of 2^32 equal ones, that a state
lies in. The cells of a range are those between the cells of its ends, since locating grows with
the image (model/grid/axis.py); within the first and the last cell, its real coordinate bounds the
place, with a margin for the rounding of the state. Boxes are ranges of places, so that what meets
what is decided without rounding.
"""

from typing import Any, Final

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.axis import EDGE, MOST_TURNS, ROUNDING

BITS: Final = 32  # binary digits of a place within a cell
PARTS: Final = 2**32
LAST: Final = PARTS - 1  # the last part of a cell
MAY_LEAVE, MAY_ARRIVE, EMPTY = 1, 2, 4  # of an image: it may leave, meets A on its way, is no more


@kernel
def number(x, axis):  # type: ignore[no-untyped-def]
    """Return the index of a cell before the modulus; -1 and ``cells`` below and above a segment.

    NaN too many turns away from a circle, and where x is not a number.
    """
    low, high, width, cells = axis[0], axis[1], axis[2], axis[3]
    if axis[5] > 0.0:
        turns = 0.0
        if not ((x >= low) & (x <= high)):
            span, away = high - low, x - low
            turns = np.floor(away / span)
            rest = min(max(away - turns * span, 0.0), span)
            x = min(low + rest, high)
            if not abs(turns) <= MOST_TURNS:
                return np.nan
        return turns * cells + np.floor((x - low) / width + EDGE)
    t = (x - low) / width
    k = np.floor(t + EDGE)
    if (k >= cells) & ((t - cells <= EDGE) | (x <= high)):
        return cells - 1.0
    return min(max(k, -1.0), cells)


@kernel
def part(x, k, axis, sign):  # type: ignore[no-untyped-def]
    """Return the part of cell k that a state of image x lies in; at least or at most, by sign."""
    t = (x - axis[0]) / axis[2]
    reach = max(abs(axis[0]), abs(axis[1])) / axis[2]
    t = t + sign * 16.0 * ROUNDING * (abs(t) + axis[3] + reach)
    return np.int64(min(max(np.floor((t - k) * PARTS), 0.0), 1.0 * LAST))


@kernel
def located(low, high, axis, clip, slack):  # type: ignore[no-untyped-def]
    """Return the first and the last place of images in [low, high], and what else they may do.

    On a circle the last place may be a turn further. ``slack`` widens the range, in cells. What is
    surely no number, NaN, is out.
    """
    if np.isnan(low):
        return np.int64(0), np.int64(0), MAY_LEAVE | EMPTY
    cells, flags = axis[3], 0
    low, high = low - slack * axis[2], high + slack * axis[2]
    if not high - low < np.inf:
        flags |= MAY_LEAVE  # also what is undefined
    if axis[5] > 0.0:
        first, last = number(low, axis), number(high, axis)
        if not last - first < cells:  # a whole turn, or too many turns away
            flags |= MAY_LEAVE if not last - first < np.inf else 0
            return np.int64(0), np.int64(cells) * PARTS - 1, flags
        base = np.int64(first - np.floor(first / cells) * cells) * PARTS
        turned = base + np.int64(last - first) * PARTS
        return (base + part(low, first, axis, -1.0),
                turned + part(high, last, axis, 1.0), flags)  # fmt: skip
    if clip:
        low, high = min(max(low, axis[0]), axis[1]), min(max(high, axis[0]), axis[1])
    first, last = number(low, axis), number(high, axis)
    if first < 0.0 or last >= cells:
        flags |= MAY_LEAVE
    if last < 0.0 or first >= cells:
        return np.int64(0), np.int64(0), flags | EMPTY
    begin, end = np.int64(0), np.int64(cells) * PARTS - 1
    if first >= 0.0:
        begin = np.int64(first) * PARTS + part(low, first, axis, -1.0)
    if last < cells:
        end = np.int64(last) * PARTS + part(high, last, axis, 1.0)
    return begin, end, flags


@kernel
def locate_images(low, high, axes, clip, slack, image, flags):  # type: ignore[no-untyped-def]
    """Fill in the places of images, shape (B, d, 2), and add what else they may do to flags."""
    for b in range(len(image)):
        for k in range(len(axes)):
            first, last, more = located(low[b, k], high[b, k], axes[k], clip, slack)
            image[b, k, 0], image[b, k, 1] = first, last
            flags[b] |= more


@kernel(allocates=True)
def follow(found, start, ground, flags):  # type: ignore[no-untyped-def]
    """Add to flags what images may do on the way: leave, enter avoid, or enter the attractor.

    ``start`` has the cells of the starts before the modulus, shape (B, d).
    """
    room = np.empty((2, len(ground[0])))
    for b in range(len(flags)):
        for s in range(found.arcs.shape[1]):
            flags[b] |= _on_arc(found, start, ground, room, b, s)


@kernel
def _on_arc(found, start, ground, room, b, s):  # type: ignore[no-untyped-def]
    """Return what an image may do on arc s of its way."""
    axes, kind, clip, tolerance = ground
    first, last = room
    if np.isnan(found.arcs[b, s, 0, 0]):
        return MAY_LEAVE
    for k in range(len(axes)):
        low, high = found.arcs[b, s, k, 0], found.arcs[b, s, k, 1]
        error = tolerance * max(abs(low), abs(high))
        first[k], last[k] = number(low - error, axes[k]), number(high + error, axes[k])
        if s == 0:  # by MOST_PARTS parts of an arc, and t (3 - 3 t + t t) >= t
            if found.way[b, k, 0] > 2000.0 * error:
                first[k] = max(first[k], start[b, k])
            if found.way[b, k, 1] < -2000.0 * error:
                last[k] = min(last[k], start[b, k])
    return crossed(first, last, axes, kind, clip)


@kernel(allocates=True)
def absorb(found, start, ground, slack, flags):  # type: ignore[no-untyped-def]
    """Give images that surely enter the attractor on the way the flags of an absorbed one.

    They do where a substep ends in attractor cells only: at its end the path is judged. What would
    become of them after it does not matter.
    """
    axes, kind, _, _ = ground
    room = np.empty((2, len(axes)))
    for b in range(len(flags)):
        until = MAY_ARRIVE | EMPTY
        for s in range(found.knots.shape[1] if flags[b] & MAY_ARRIVE else 0):
            until |= _on_arc(found, start, ground, room, b, s)
            if _arrived(found.knots[b, s], axes, kind, slack, room):
                flags[b] = until
                break


MOST_CELLS = 256  # cells above which a substep is not said to end in the attractor


@kernel
def _arrived(knot, axes, kind, slack, room):  # type: ignore[no-untyped-def]
    """Return whether a substep ends in attractor cells only."""
    first, last = room
    count = 1.0
    for k in range(len(axes)):
        low, high = knot[k, 0] - slack * axes[k, 2], knot[k, 1] + slack * axes[k, 2]
        first[k], last[k] = number(low, axes[k]), number(high, axes[k])
        inside = (axes[k, 5] > 0.0) | ((first[k] >= 0.0) & (last[k] < axes[k, 3]))
        if not (inside & (last[k] - first[k] < axes[k, 3])):
            return False
        count *= last[k] - first[k] + 1.0
    if not count <= MOST_CELLS:
        return False
    others = 0
    for j in range(np.int64(count)):
        others += kind[_numbered(j, first, last, axes)] != MAY_ARRIVE
    return others == 0


@kernel
def _numbered(j, first, last, axes):  # type: ignore[no-untyped-def]
    """Return the index of the j-th cell between two."""
    rest, cell = np.int64(j), 0.0
    for k in range(len(axes)):
        size = np.int64(last[k] - first[k] + 1.0)
        at = first[k] + rest % size
        rest //= size
        cell += axes[k, 4] * (at - np.floor(at / axes[k, 3]) * axes[k, 3])
    return np.int64(cell)


MOST_CROSSED = 100_000  # cells above which an arc is said to meet anything


@kernel
def crossed(first, last, axes, kind, clip):  # type: ignore[no-untyped-def]
    """Return what a path may do that crosses cells between two; see :func:`follow`."""
    flags, count = 0, 1.0
    for k in range(len(axes)):
        cells = axes[k, 3]
        if axes[k, 5] > 0.0:
            if not last[k] - first[k] < cells:
                flags |= MAY_LEAVE if not last[k] - first[k] < np.inf else 0
                first[k], last[k] = 0.0, cells - 1.0
        else:
            if not ((first[k] >= 0.0) & (last[k] < cells)):
                flags |= 0 if clip else MAY_LEAVE
            first[k] = first[k] if first[k] > 0.0 else 0.0
            last[k] = last[k] if last[k] < cells else cells - 1.0
        count *= max(last[k] - first[k] + 1.0, 0.0)
    if not count <= MOST_CROSSED:
        return MAY_LEAVE | MAY_ARRIVE
    for j in range(np.int64(count)):
        flags |= kind[_numbered(j, first, last, axes)]
    return flags


def paid(found: Any, d: int) -> tuple[Floats, Floats]:
    """Return ends of the integral of a cost rate until any time on the way, shape (B,).

    The integral until then lies between those at the ends of its arc, which are kept in order.
    """
    if not found.knots.shape[1]:
        return found.low[:, d], found.high[:, d]
    at_ends = found.knots[:, :, d]
    return np.minimum(at_ends[..., 0].min(axis=1), 0.0), at_ends[..., 1].max(axis=1)

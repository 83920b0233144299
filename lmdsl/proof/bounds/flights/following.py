"""Parts of cells that are followed under the controller until they are torn, and what that costs.

A part is followed as a set (affine.py) while all of it lies in one cell, until it enters the
attractor. The largest bound of what it meets may stand for the rest of the way, and does where it
is torn between cells. Only states that arrive count: nothing is claimed of others.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.machine import threads
from lmdsl.machine.kernels import kernel
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.compiled import enclosing, places
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.proof.bounds.flights.affine import Sets, advance, boxed
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.proof.images.pieces import Pieces, pieces
from lmdsl.proof.loop import Loop

AT_A_TIME = 2**14  # parts followed at a time by a thread
MOST_STEPS = 1_000  # after which a part is taken as torn
MOST_MET = 2**12  # parts above which what is met is not bounded
ROUNDING = 2.0**-42  # of a bound: more than what rounds in so many steps
GOES, DONE = range(2)

Upper = NDArray[np.float32]  # bounds by part: infinite if unknown, -infinite where nothing arrives


class Flights:
    """The controller as it moves parts of cells; without noise, or with one part of it.

    Parameters
    ----------
    loop
        The closed loop.
    slack, rounding
        By how much what is met is widened, in cells, and bounds are raised, relative.
    """

    def __init__(self, loop: Loop, slack: float = 0.0, rounding: float = ROUNDING) -> None:
        self.loop, self.slack, self.rounding = loop, slack, rounding
        images = loop.images()
        self.step, self.noise = images.step, images.noise
        targets, _, most = loop.entry(images)
        self.entry = np.full(loop.partition.size, -np.inf)
        self.entry[targets] = most
        self.dearest = float(most.max(initial=-np.inf))
        self.axes = np.array(loop.partition.axes, dtype=np.float64)
        kind = np.zeros(loop.partition.size, dtype=np.int64)
        if absorbed_on_way(loop.problem.local_controller):
            kind[loop.status == CellStatus.ATTRACTOR] = places.MAY_ARRIVE
        self.ground = (self.axes, kind, loop.partition.clip, enclosing.HERMITE)

    @property
    def able(self) -> bool:
        """Whether parts can be followed: noise of several parts would take many ways."""
        return len(self.noise[0]) == 1

    def bounds(
        self, parts: Parts, some: Indices, known: Upper, grid: Parts
    ) -> tuple[Floats, Bools]:
        """Return upper bounds of the cost from some parts, by what is known of those of a grid.

        And which were never torn: cutting these brings little.
        """
        found, whole = np.empty(len(some)), np.empty(len(some), dtype=np.bool_)
        starts = range(0, len(some), AT_A_TIME)

        def follow(start: int) -> None:
            at = slice(start, start + AT_A_TIME)
            found[at], whole[at] = self._followed(parts, some[at], known, grid)

        threads.each(follow, list(starts))
        return found, whole

    def _followed(
        self, parts: Parts, some: Indices, known: Upper, grid: Parts
    ) -> tuple[Floats, Bools]:
        partition = self.loop.partition
        cell = parts.cell(partition, some)
        place = parts.by_axis(some) & ((1 << parts.split) - 1)
        boxes = pieces(partition, cell, np.broadcast_to(parts.split, place.shape), place)
        flight = _Flight.of(boxes, cell)
        room = enclosing.rows(self.step), np.zeros((4 + place.shape[1], place.shape[1]))
        for _ in range(MOST_STEPS):
            flight = self._advanced(flight, (known, grid), room)
            if not len(flight.owner):
                break
        flight.whole[flight.owner] = False
        found = np.full(len(some), -np.inf)
        np.maximum.at(found, boxes.owner, flight.best)
        whole = np.ones(len(some), dtype=np.bool_)
        whole[boxes.owner[~flight.whole]] = False
        finite = np.isfinite(found)
        found[finite] += np.abs(found[finite]) * self.rounding
        return found, whole & (found < np.inf)

    def _advanced(
        self, flight: "_Flight", rest: tuple[Upper, Parts], room: tuple[enclosing.Room, Floats]
    ) -> "_Flight":
        """Follow all sets for a step; those that go on are left."""
        sets, count = flight.sets, len(flight.owner)
        given = enclosing.Given(
            sets.low, sets.high, self.loop.control[flight.cell],
            *(np.broadcast_to(ends[0], (count, len(ends[0]))) for ends in self.noise),
        )  # fmt: skip
        found = enclosing.enclose(self.step, given, room[0], sloped=True)
        flags = np.zeros(count, dtype=np.uint8)
        if self.step.path:
            with np.errstate(all="ignore"):
                places.follow(found, flight.start, self.ground, flags)
        cost = self._cost(given, found)
        advance(sets, found, room[1])
        image = np.empty((count, sets.c.shape[1], 2), dtype=np.int64)
        with np.errstate(all="ignore"):
            places.locate_images(
                sets.low, sets.high, self.axes, self.loop.partition.clip, self.slack, image, flags
            )
        state = np.zeros(count, dtype=np.uint8)
        game = (self.loop.status, self.entry, self.dearest, self.loop.factor)
        known, grid = rest
        ranges = (grid.split, grid.shape, grid.stride)
        land(flight, image, flags, cost, game, self.axes, ranges, known, state)
        return flight.only(state == GOES)

    def _cost(self, given: enclosing.Given, found: enclosing.Enclosed) -> Floats:
        d = self.loop.partition.dimension
        if found.low.shape[1] > d:
            return np.maximum(found.high[:, d], places.paid(found, d)[1])
        return enclosing.ranges(self.step, self.step.cost, given)[1][:, 0]


class _Flight(NamedTuple):
    """Sets on their way.

    Attributes
    ----------
    sets, cell, start
        The sets, their cells, and these before the modulus, by axis.
    paid, weight
        What has been paid at most, and what later costs count.
    owner
        The piece that each set began as.
    entered, best, whole
        By piece, the most that is paid on entering A on the way, the best bound, and whether it was
        never torn.
    """

    sets: Sets
    cell: Indices
    start: Floats
    paid: Floats
    weight: Floats
    owner: Indices
    entered: Floats
    best: Floats
    whole: Bools

    @classmethod
    def of(cls, boxes: Pieces, cell: Indices) -> "_Flight":
        """Return pieces of parts before they move."""
        n = len(boxes.owner)
        return cls(
            boxed(boxes.low, boxes.high), cell[boxes.owner], boxes.start.copy(), np.zeros(n),
            np.ones(n), np.arange(n), np.full(n, -np.inf), np.full(n, np.inf),
            np.ones(n, dtype=np.bool_),
        )  # fmt: skip

    def only(self, some: NDArray[np.bool_]) -> "_Flight":
        """Return those that go on."""
        return self._replace(
            sets=Sets(*(array[some] for array in self.sets)), cell=self.cell[some],
            start=self.start[some], paid=self.paid[some], weight=self.weight[some],
            owner=self.owner[some],
        )  # fmt: skip


@kernel
def land(flight, image, flags, cost, game, axes, ranges, known, state):  # type: ignore[no-untyped-def]
    """Note what became of sets after a step: whether they go on or are done with."""
    status, entry, dearest, factor = game
    for i in range(len(state)):
        paid = flight.paid[i] + flight.weight[i] * cost[i]
        paid += abs(paid) * 2.0**-50
        weight, piece = flight.weight[i] * factor, flight.owner[i]
        if flags[i] & places.MAY_ARRIVE:
            flight.entered[piece] = max(flight.entered[piece], paid + weight * dearest)
        state[i] = DONE
        if flags[i] & places.EMPTY:
            _end(flight, piece, -np.inf)
            continue
        cell = _one_cell(image[i], axes)
        if cell >= 0 and status[cell] != CellStatus.STABILIZED:
            _end(flight, piece, paid + weight * entry[cell])
            continue
        _end(flight, piece, paid + weight * _dearest(image[i], ranges, known))
        if cell < 0 or not paid < flight.best[piece] or not _wrapped(flight, i, axes):
            flight.whole[piece] = False
            continue
        flight.paid[i], flight.weight[i], flight.cell[i] = paid, weight, cell
        state[i] = GOES


@kernel
def _end(flight, piece, cost):  # type: ignore[no-untyped-def]
    """Note what a piece costs at most by what is known of where it is now."""
    cost = max(cost, flight.entered[piece])
    flight.best[piece] = min(flight.best[piece], cost)


@kernel
def _one_cell(image, axes):  # type: ignore[no-untyped-def]
    """Return the cell in which all of an image lies, -1 where there is none."""
    cell = 0.0
    for k in range(len(axes)):
        first, last = image[k, 0] >> places.BITS, image[k, 1] >> places.BITS
        if first != last:
            return -1
        cell += axes[k, 4] * first
    return np.int64(cell)


@kernel
def _wrapped(flight, i, axes):  # type: ignore[no-untyped-def]
    """Make states of a set of images; return False where it is torn by the seam or the box."""
    sets = flight.sets
    for k in range(len(axes)):
        low, high = axes[k, 0], axes[k, 1]
        span = high - low
        turns = np.floor((0.5 * sets.low[i, k] + 0.5 * sets.high[i, k] - low) / span)
        if axes[k, 5] == 0.0:
            turns = 0.0
        error = 2.0**-48 * (abs(low) + abs(high) + abs(sets.low[i, k]) + abs(sets.high[i, k]))
        if turns != 0.0:
            sets.c[i, k] -= turns * span
            sets.low[i, k] -= turns * span + error
            sets.high[i, k] -= turns * span - error
            sets.e[i, k] += error
        if sets.low[i, k] < low or sets.high[i, k] > high:
            return False
        t = (0.5 * sets.low[i, k] + 0.5 * sets.high[i, k] - low) / axes[k, 2]
        flight.start[i, k] = np.floor(t + EDGE)
    return True


@kernel
def _dearest(image, ranges, known):  # type: ignore[no-untyped-def]
    """Return the largest bound of the parts that an image meets."""
    split, shape, stride = ranges
    d, count = len(shape), 1
    for k in range(d):
        shift = places.BITS - split[k]
        count *= (image[k, 1] >> shift) - (image[k, 0] >> shift) + 1
        if count > MOST_MET:
            return np.inf
    found = -np.inf
    for j in range(count):
        rest, at = np.int64(j), np.int64(0)
        for k in range(d - 1, -1, -1):
            shift = places.BITS - split[k]
            first = image[k, 0] >> shift
            size = (image[k, 1] >> shift) - first + 1
            at += (first + rest % size) % shape[k] * stride[k]
            rest //= size
        found = max(found, known[at])
        if found == np.inf:
            break
    return found

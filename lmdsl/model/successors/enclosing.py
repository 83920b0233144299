"""Enclosures of images and paths of boxes: the natural and the mean value form, intersected.

StepBoxes are given axis by axis, as intervals of shapes that broadcast against each other. So what
depends on the angle and the controls only is enclosed once for all positions.

The path of a substep is a cubic Hermite arc. A part of it lies in the hull of its four Bernstein
points, which are the start and sums of multiples of the slopes and the way (:func:`blossoms`).
"""

from collections.abc import Iterator, Sequence
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats, Guard
from lmdsl.formulas import intervals as iv
from lmdsl.formulas.enclosures import Jet, enclosure
from lmdsl.formulas.intervals import Interval
from lmdsl.model.discretization import noise_parts
from lmdsl.model.true_map import TrueMap

MOST_PARTS = 8  # most parts of an arc
SLACK = 2.0**-40  # of slopes and ways: more than what rounds in Bernstein points


StepJets = tuple[list[Jet], list[Jet], list[Jet]]  # states, controls and noise


class StepBoxes(NamedTuple):
    """Boxes of states, controls (numbers) and noise, each by axis; all arrays of as many axes."""

    states: Sequence[Interval]
    controls: Sequence[Floats]
    noise: Sequence[Interval]


class Stretch(NamedTuple):
    """Where images or a part of the path lie.

    Attributes
    ----------
    places
        An interval for each axis, each in the shape of what it depends on; its ends are infinite
        where the place may be undefined or infinite.
    rises, falls
        By axis, where the path begins: whether it certainly never goes below, or above, its start.
    judged
        Of the path: whether a place at which it is judged certainly lies in it; None at the end.
    """

    places: tuple[Interval, ...]
    rises: tuple[Bools, ...] = ()
    falls: tuple[Bools, ...] = ()
    judged: Bools | None = None


class Encloser:
    """Encloses the images of boxes under a map.

    Attributes
    ----------
    noise
        The boxes of noise that are covered, one interval of shape (parts,) for each variable.
    directions
        Number of states and of noise variables whose parts are no points.
    arc_parts
        Number of parts into which arcs are cut.
    """

    def __init__(self, true_map: TrueMap) -> None:
        self.true_map = true_map
        least, most = noise_parts(true_map.problem)
        self.noise = [Interval(a, b) for a, b in zip(least.T, most.T, strict=True)]
        self.parts = len(least)
        self.varying = [j for j, part in enumerate(self.noise) if (part.low < part.high).any()]
        self.width = true_map.partition.width
        self.directions = len(self.width) + len(self.varying)
        self.arc_parts = 1

    def stretches(
        self, boxes: StepBoxes, path: bool, guard: Guard | None = None
    ) -> Iterator[Stretch]:
        """Enclose the parts of the path, where it is judged, and last the images."""
        if path:
            yield from self.path(boxes, guard)
        yield self.images(boxes, guard)

    def images(self, boxes: StepBoxes, guard: Guard | None = None) -> Stretch:
        """Enclose the images of all boxes."""
        around, centre, away = self._around(boxes)
        jets = self.true_map.enclose(*around, guard), self.true_map.enclose(*centre, guard)
        axes = max(np.ndim(x.low) for x in self._directed(boxes))
        with np.errstate(all="ignore"):
            found = (
                enclosure(box, at, away)
                for box, at in zip(jets[0] or (), jets[1] or (), strict=True)
            )
            return Stretch(tuple(Interval(*(_spread(x, axes) for x in each)) for each in found))

    def path(self, boxes: StepBoxes, guard: Guard | None = None) -> Iterator[Stretch]:
        """Enclose the parts of the path, in order; the end is not among them."""
        around, centre, away = self._around(boxes)
        arcs = self.true_map.arcs(*around, guard), self.true_map.arcs(*centre, guard)
        begun = False
        for boxed, middle in zip(*arcs, strict=True):
            with np.errstate(all="ignore"):
                start, *parts = (
                    [enclosure(x, at, away) for x, at in zip(xs, ats, strict=True)]
                    for xs, ats in zip(boxed, middle, strict=True)
                )
                fast = self._judged_often(parts)
                for i, points in enumerate(blossoms(self.arc_parts)):
                    judged = fast | (i == self.arc_parts - 1)  # the end of an arc always is
                    ways = [_ways(points, each) for each in zip(*parts, strict=True)]
                    places = tuple(
                        iv.add(at, iv.hull(way[0], way[1]))
                        for at, way in zip(start, ways, strict=True)
                    )
                    rises, falls = (w[1].low >= 0 for w in ways), (w[1].high <= 0 for w in ways)
                    turns = () if begun else (tuple(rises), tuple(falls))
                    yield Stretch(places, *(turns or ((), ())), judged)
                    begun = True

    def _judged_often(self, parts: Sequence[Sequence[Interval]]) -> Bools:
        """Return whether every part of an arc certainly holds a place at which it is judged.

        These are equally spaced, at least as many as twice the cells of the steepest end.
        """
        steep = np.zeros(())
        for slopes in parts[:2]:
            for slope, width in zip(slopes, self.width, strict=True):
                steep = np.maximum(steep, iv.mignitude(slope) / width)
        return np.asarray(2 * steep > self.arc_parts - 1 + 1e-6)

    def speed(self, boxes: StepBoxes, guard: Guard | None = None) -> Floats:
        """Return how far the substeps lead at most, in cells of an axis."""
        around, _, _ = self._around(boxes)
        most = np.zeros(())
        for arc in self.true_map.arcs(*around, guard):
            for rise, width in zip(arc.rise, self.width, strict=True):
                most = np.maximum(most, iv.magnitude(rise.value) / width)
        return most

    def excess(self, boxes: StepBoxes, guard: Guard | None = None) -> list[Floats]:
        """Return by how much the mean value form is too wide, in cells, at first order.

        That is what cutting the boxes removes: an array for every state, and then for every noise
        variable that varies.
        """
        around, _, _ = self._around(boxes)
        images, total = self.true_map.enclose(*around, guard), []
        for i, box in enumerate(self._directed(boxes)):
            worst = np.zeros(())
            for jet, width in zip(images or (), self.width, strict=True):
                slack = (jet.slope.high[i] - jet.slope.low[i]) / 2 * (box.high - box.low) / width
                worst = np.maximum(worst, np.where(np.isnan(slack), np.inf, slack))
            total.append(worst)
        return total

    def _around(self, boxes: StepBoxes) -> tuple[StepJets, StepJets, list[Interval]]:
        """Return the jets of boxes and of their midpoints, and the boxes minus these."""
        directed = self._directed(boxes)
        middle = [Interval.point(x.midpoint) for x in directed]
        away = [iv.subtract(x, m) for x, m in zip(directed, middle, strict=True)]
        n = self.directions
        around = [Jet.variable(x, k, n) for k, x in enumerate(directed)]
        centre = [Jet.held(x, 0) for x in middle]
        return self._jets(boxes, around, n), self._jets(boxes, centre, 0), away

    def _jets(self, boxes: StepBoxes, directed: Sequence[Jet], directions: int) -> StepJets:
        d = len(boxes.states)
        noise = [Jet.held(w, directions) for w in boxes.noise]
        for jet, j in zip(directed[d:], self.varying, strict=True):
            noise[j] = jet
        controls = [Jet.constant(u, directions) for u in boxes.controls]
        return list(directed[:d]), controls, noise

    def _directed(self, boxes: StepBoxes) -> list[Interval]:
        return [*boxes.states, *(boxes.noise[j] for j in self.varying)]


def _spread(x: Floats, axes: int) -> Floats:
    """Return an array of as many axes; a constant has none."""
    return x.reshape(x.shape or (1,) * axes)


def _ways(
    points: Sequence[tuple[float, float, float]], parts: Sequence[Interval]
) -> tuple[Interval, Interval]:
    """Return the first Bernstein point of a part of an arc, and the hull of the other three.

    They are sums of multiples of slope, slope and way, widened by far more than rounds in them and
    in a computed point between them.
    """
    found, slack = [], SLACK * sum(map(iv.magnitude, parts))
    for point in points:
        low, high = 0.0, 0.0
        for c, part in zip(point, parts, strict=True):
            if c:
                a, b = part if c > 0 else (part.high, part.low)
                low, high = low + c * a, high + c * b
        found.append(Interval(low - slack, high + slack))
    return found[0], reduce(iv.hull, found[1:])


def blossoms(parts: int) -> Iterator[list[tuple[float, float, float]]]:
    """Yield the Bernstein points of equal parts of an arc: multiples of slope, slope, way.

    With Bernstein points 0, m/3, r - n/3 and r of the whole arc, those of [s, e] are its blossom
    at (s, s, s), (s, s, e), (s, e, e) and (e, e, e).
    """
    cuts = np.linspace(0.0, 1.0, parts + 1).tolist()
    for s, e in pairwise(cuts):
        points = []
        for u, v, w in ((s, s, s), (s, s, e), (s, e, e), (e, e, e)):
            one = u * (1 - v) * (1 - w) + v * (1 - u) * (1 - w) + w * (1 - u) * (1 - v)
            two = u * v * (1 - w) + u * w * (1 - v) + v * w * (1 - u)
            points.append((one / 3, -two / 3, two + u * v * w))
        yield points

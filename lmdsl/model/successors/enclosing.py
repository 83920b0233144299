"""Enclosures of the images of boxes: the natural and the mean value form, intersected.

Boxes are given axis by axis, as intervals of shapes that broadcast against each other. So what
depends on the angle and the controls only is enclosed once for all positions.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lmdsl.common.types import Floats, Guard
from lmdsl.errors import BadInput
from lmdsl.formulas import intervals as iv
from lmdsl.formulas.enclosures import Jet, enclosure
from lmdsl.formulas.intervals import Interval
from lmdsl.model.discretization import noise_parts
from lmdsl.model.true_map import TrueMap


class Boxes(NamedTuple):
    """Boxes of states, controls (numbers) and noise, each by axis; all arrays of as many axes."""

    states: Sequence[Interval]
    controls: Sequence[Floats]
    noise: Sequence[Interval]


class Encloser:
    """Encloses the images of boxes under a map.

    Attributes
    ----------
    noise
        The boxes of noise that are covered, one interval of shape (parts,) for each variable.
    directions
        Number of states and of noise variables whose parts are no points.
    """

    def __init__(self, true_map: TrueMap) -> None:
        self.true_map = true_map
        least, most = noise_parts(true_map.problem)
        self.noise = [Interval(a, b) for a, b in zip(least.T, most.T, strict=True)]
        self.parts = len(least)
        self.varying = [j for j, part in enumerate(self.noise) if (part.low < part.high).any()]
        self.width = true_map.partition.width
        self.directions = len(self.width) + len(self.varying)

    def __call__(self, boxes: Boxes, guard: Guard | None = None) -> tuple[Interval, ...]:
        """Enclose the images of all boxes: an interval for each axis.

        Each comes in the shape of what it depends on; its ends are infinite where the image may be
        undefined or infinite.
        """
        directed = self._directed(boxes)
        middle = [Interval.point(x.midpoint) for x in directed]
        away = [iv.subtract(x, m) for x, m in zip(directed, middle, strict=True)]
        around = self._jets(boxes, directed, self.directions, guard)
        centre = self._jets(boxes, middle, 0, guard)
        with np.errstate(all="ignore"):
            return tuple(enclosure(box, at, away) for box, at in zip(around, centre, strict=True))

    def excess(self, boxes: Boxes, guard: Guard | None = None) -> list[Floats]:
        """Return by how much the mean value form is too wide, in cells, at first order.

        That is what cutting the boxes removes: an array for every state, and then for every noise
        variable that varies.
        """
        directed = self._directed(boxes)
        around, total = self._jets(boxes, directed, self.directions, guard), []
        for i, box in enumerate(directed):
            worst = np.zeros(())
            for jet, width in zip(around, self.width, strict=True):
                slack = (jet.slope.high[i] - jet.slope.low[i]) / 2 * (box.high - box.low) / width
                worst = np.maximum(worst, np.where(np.isnan(slack), np.inf, slack))
            total.append(worst)
        return total

    def _directed(self, boxes: Boxes) -> list[Interval]:
        return [*boxes.states, *(boxes.noise[j] for j in self.varying)]

    def _jets(
        self, boxes: Boxes, directed: Sequence[Interval], directions: int, guard: Guard | None
    ) -> tuple[Jet, ...]:
        d = len(boxes.states)

        def made(k: int) -> Jet:
            if directions:
                return Jet.variable(directed[k], k, directions)
            return Jet.held(directed[k], 0)

        states = [made(k) for k in range(d)]
        controls = [Jet.constant(u, directions) for u in boxes.controls]
        noise = [Jet.held(w, directions) for w in boxes.noise]
        for i, j in enumerate(self.varying):
            noise[j] = made(d + i)
        images = self.true_map.enclose(states, controls, noise, guard)
        if images is None:
            raise BadInput("this system cannot be enclosed; write it in formulas", "successors")
        return images

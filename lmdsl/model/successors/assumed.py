"""Images of boxes under a Python function, as far as its Lipschitz constants go: assumed.

Nobody knows what the function does between samples; what is made of these boxes is no proof. The
image of a box is that of its middle, widened by the constants times half the box.
"""

from typing import Any

import numpy as np

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.errors import BadInput
from lmdsl.formulas import intervals as iv
from lmdsl.formulas.intervals import Interval
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.successors.enclosing import Encloser, StepBoxes, Stretch
from lmdsl.model.true_map import TrueMap
from lmdsl.systems.black_box.steepness import Steepness


class AssumedEncloser(Encloser):
    """Encloses the images of boxes under a function with Lipschitz constants.

    Attributes
    ----------
    steepness
        The constants.
    """

    def __init__(self, true_map: TrueMap, steepness: Steepness) -> None:
        super().__init__(true_map)
        self.steepness = steepness

    def images(self, boxes: StepBoxes, guard: Guard | None = None) -> Stretch:
        """Enclose the images of all boxes."""
        every = [*boxes.states, *boxes.noise]
        middle = [x.midpoint for x in every]
        d = len(boxes.states)
        images = self.true_map(middle[:d], boxes.controls, middle[d:], guard)
        with np.errstate(all="ignore"):
            away = [_half(x) for x in every]
            size = [iv.magnitude(x) for x in every]
            ones = np.ones((1,) * max(np.ndim(x.low) for x in every))  # all have as many axes
            found = []
            for row, image in enumerate(images):
                by = self.steepness.spread(row, image, away, size) * ones
                found.append(_around(image, by))
            return Stretch(tuple(found))

    def excess(self, boxes: StepBoxes, guard: Guard | None = None) -> list[Floats]:
        """Return how far half the boxes reach, in cells: what cutting them makes smaller."""
        total = []
        directed = [*boxes.states, *(boxes.noise[j] for j in self.varying)]
        columns = [*range(len(boxes.states)), *(len(boxes.states) + j for j in self.varying)]
        for column, box in zip(columns, directed, strict=True):
            reach = [
                row[column] / w for row, w in zip(self.steepness.rows, self.width, strict=True)
            ]
            total.append(max(reach) * _half(box))
        return total


def encloser_of(true_map: TrueMap) -> Encloser:
    """Return what encloses the images of boxes."""
    steepness = true_map.steepness
    return Encloser(true_map) if steepness is None else AssumedEncloser(true_map, steepness)


def require_samples_within(
    transitions: Transitions, partition: Partition, ranges: tuple[Any, Any], admissible: Bools,
    cells: Indices,
) -> None:  # fmt: skip
    """Refuse constants that a sample contradicts: it ends in no cell of its pair's ranges.

    ``ranges`` are first and last indices, shape (pairs, parts, d), of the pairs of ``cells``. So
    rows lie within them.
    """
    rows, free = transitions.rows, transitions.sets.free
    pair = np.repeat(np.arange(rows.count), np.diff(rows.pointer))
    inside = (rows.target < len(free)) & admissible[pair]
    pair, cell = pair[inside], free[rows.target[inside]]
    index = partition.multi_index(cell)
    within = np.zeros(len(pair), dtype=np.bool_)
    for part in range(ranges[0].shape[1]):
        each = np.ones(len(pair), dtype=np.bool_)
        for k, n in enumerate(partition.cells):
            first, last = (end[pair, part, k].astype(np.int64) for end in ranges)
            each &= (index[k] - first) % int(n) <= last - first
        within |= each
    if not within.all():
        at = int(pair[np.argmin(within)])
        own = int(cells[owner(transitions.pair_pointer)[at]])
        raise BadInput(
            f"a sample of cell {own} under control {int(transitions.control[at])} ends further "
            "from the image of the cell's middle than the constants allow; make them larger, or "
            "leave lipschitz out",
            "system.lipschitz",
        )


def _half(box: Interval) -> Floats:
    """Return how far an interval reaches from its middle, rounded up."""
    middle = box.midpoint
    return np.asarray(np.nextafter(np.maximum(box.high - middle, middle - box.low), np.inf))


def _around(image: Floats, by: Floats) -> Interval:
    """Return the interval around images, the whole line where one is not finite."""
    found = iv.outward(image - by, image + by)
    return iv.either(np.isfinite(image), found, iv.whole(by))

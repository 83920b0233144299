"""Claim 7 of a certificate: no run of the map that starts in C is lost before it enters A.

It is proved of every cell i of C: whatever state a run holds that is located in cell i, and
whatever noise is covered, the map as computed leads under the control of cell i into a cell of C or
of the attractor A; where the path of a differential equation is judged, on a path that stays in the
box outside the avoided cells, up to a part of it in A. All that is said of the map is written
in `map` of the head:

  states, controls, noise   names, in order
  formulas                  by state: of its next value, or for an `ode` of its derivative
  let, parameters           named formulas, earlier ones first, and numbers, that these use
  ode                       null for a map, else [h, substeps, path]: classical Runge-Kutta steps of
                            length h, control and noise held; whether their path is judged
  axes                      by state: [low, high, cells, periodic]; clip: whether images beyond an
                            axis are moved to its end
  attractor, avoid          cells, numbered in C order of the axes
  ends_on_path              whether a step ends where its path enters A
  control_vectors           by number
  noise_parts               boxes of noise that are covered: [low, high] by variable
  admissible                a condition on states and controls that must hold, or null

A cell is a box of states; it is cut in two until every part is proved, at most MOST times. See
intervals.py and jets.py for the arithmetic.
"""

import itertools
import math
import sys

from claim_7.axes import Axis
from claim_7.intervals import UNDEFINED, Unclear, down, hull, least, minus, most, up
from claim_7.jets import Jet, add, constant, enclosure
from claim_7.true_map import TrueMap, bernstein, combined

MOST = 2**9  # boxes of a cell and a part of the noise after which nothing is claimed of it
LARGE = 10**6  # cells of a range above which it is not looked at
ROUNDING = 2.0**-46  # relative to an arc: more than rounds in a point of it that is computed

NEAR = (1 - 1e-12, 1 + 1e-12)  # more than rounds in the number of parts into which arcs are cut


def judged_within(s, e, fewest, largest):
    """Return whether a step surely ends where its path is in A from s to e of an arc.

    An arc is judged at the ends of q equal parts, q twice its steepest slope at an end of an arc in
    cells, rounded up: between ``fewest`` and ``largest``.
    """
    return e == 1 or (
        largest <= 1000
        and all(
            math.floor(e * q - 1e-9) >= max(1, math.ceil(s * q + 1e-9))
            for q in range(fewest, largest + 1)
        )
    )


class Judge:
    """Proves the pairs of a policy one by one."""

    def __init__(self, said, cells):
        self.axes = [Axis(*axis, said["clip"]) for axis in said["axes"]]
        self.map, self.clip = TrueMap(said), said["clip"]
        size = math.prod(axis.cells for axis in self.axes)
        self.attractor, self.avoid, inside = map(set, (said["attractor"], said["avoid"], cells))
        self.allowed = inside | self.attractor
        every = [*said["attractor"], *said["avoid"], *cells]
        if len({*every}) < len(every) or not all(type(k) is int and 0 <= k < size for k in every):
            raise ValueError("a cell is twice in C, the attractor and avoid, or none of the box")
        if len(self.axes) != self.map.dimension:
            raise ValueError("the states have other axes")
        self.controls = [[float.fromhex(x) for x in u] for u in said["control_vectors"]]
        self.noise = [[tuple(map(float.fromhex, w)) for w in part] for part in said["noise_parts"]]
        numbers = (len(said["controls"]), len(said["noise"]))
        lengths = {*((len(u), len(w)) for u in self.controls for w in self.noise)}
        if lengths != {numbers}:
            raise ValueError("controls or noise have other names")
        finite = all(-math.inf < a <= b < math.inf for w in self.noise for a, b in w)
        if not finite or not all(map(math.isfinite, itertools.chain(*self.controls))):
            raise ValueError("a control or the noise is not finite")
        self.ends, self.pieces = said["ends_on_path"], [{} for _ in self.axes]
        self.boxes = 0

    def unproved(self, cell, control):
        """Return why a pair is not proved; None if it is."""
        index = []
        for axis in reversed(self.axes):
            cell, k = divmod(cell, axis.cells)
            index.insert(0, k)
        pieces = []
        for axis, known, k in zip(self.axes, self.pieces, index, strict=True):
            if k not in known:
                known[k] = axis.pieces(k)
            pieces.append(known[k])
        for place in itertools.product(*pieces):
            for part in self.noise:
                box = [*((low, high) for low, high, _ in place), *part]
                why = self._bisected(box, self.controls[control], [k for *_, k in place])
                if why:
                    return why
        return None

    def _bisected(self, box, control, start):
        """Prove a box, cut where that helps; return why not."""
        unit = [axis.width for axis in self.axes]
        unit += [max(high - low, 5e-324) for low, high in box[len(unit) :]]
        boxes = [box]
        for _ in range(MOST):
            if not boxes:
                return None
            self.boxes += 1
            box = boxes.pop()
            longest = [(high - low) / w for (low, high), w in zip(box, unit, strict=True)]
            middle = [min(max(low / 2 + high / 2, low), high) for low, high in box]
            try:
                proved, gains = self._proved(box, middle, control, start)
            except UNDEFINED:
                proved, gains = False, None
            if proved:
                continue
            if self._refuted(middle, control):
                return f"the state {middle[: len(self.axes)]} leads out of C and the attractor"
            k = max(range(len(box)), key=lambda j: ((gains or longest)[j], longest[j]))
            low, high = box[k]
            if not low < middle[k] < high:
                break
            boxes += [[*box[:k], half, *box[k + 1 :]] for half in
                      ((low, middle[k]), (middle[k], high))]  # fmt: skip
        return (
            "its enclosure does not show that it leads into C or the attractor" if boxes else None
        )

    def _values(self, box, control):
        """Return the jets of a box; a direction for each number that varies."""
        d = len(self.axes)
        found = [
            Jet(low, high, {k: (1.0, 1.0)} if low < high else {}, 0.0)
            for k, (low, high) in enumerate(box)
        ]
        return [*found[:d], *map(constant, control), *found[d:]]

    def _proved(self, box, middle, control, start):
        """Return whether a box is proved, and what cutting it in each direction would gain."""
        values = self._values(box, control)
        points = self._values([(x, x) for x in middle], control)
        away = [minus(b, (x, x)) for b, x in zip(box, middle, strict=True)]
        images, arcs = self.map.step(values)
        centres, central = self.map.step(points)
        gains = None
        if all(image.slopes is not None for image in images):
            gains = [
                max((image.slopes.get(k, (0.0, 0.0))[1] - image.slopes.get(k, (0.0, 0.0))[0])
                    / axis.width for image, axis in zip(images, self.axes, strict=True))
                * (high - low)
                for k, (low, high) in enumerate(box)
            ]  # fmt: skip
            gains = gains if any(gains) else None
        if not self.map.admits(values):
            return False, None
        if self.map.path:
            ended = self._along(arcs, central, away, start)
            if ended is not None:
                return ended, gains
        ranges = [
            axis.met(*enclosure(image, centre, away))
            for axis, image, centre in zip(self.axes, images, centres, strict=True)
        ]
        return self._inside(ranges, self.allowed), gains

    def _along(self, arcs, central, away, start):
        """Judge a path: True where it surely ends in A, False where it may be lost, else None."""
        slopes = [list(zip(self.axes, arc[k], strict=True)) for arc in arcs for k in (1, 2)]
        steep = (max(f(m.ends) / a.width for slope in slopes for a, m in slope)
                 for f in (least, most))  # fmt: skip
        fewest, largest = (max(1, math.ceil(2 * x * c)) for x, c in zip(steep, NEAR, strict=True))
        for number, (arc, middle) in enumerate(zip(arcs, central, strict=True)):
            far = max(most(w.ends) / axis.width for axis, w in zip(self.axes, arc[3], strict=True))
            count = max(1, min(8, math.ceil(2 * far) + 1))
            for j in range(count):
                s, e = j / count, (j + 1) / count
                begins = start if number == 0 and j == 0 else None
                ranges = self._stretch(list(bernstein(s, e)), arc, middle, away, begins)
                if self._meets(ranges, self.avoid):
                    return False
                if (
                    self.ends
                    and self._inside(ranges, self.attractor)
                    and judged_within(s, e, fewest, largest)
                ):
                    return True
        return None

    def _stretch(self, points, arc, middle, away, start):
        """Return the ranges of a part of an arc."""
        ranges = []
        for k, axis in enumerate(self.axes):
            (x, *parts), (c, *centres) = ([y[k] for y in jets] for jets in (arc, middle))
            ways = [(combined(point, parts), combined(point, centres)) for point in points]
            low, high = hull(*(enclosure(add(x, w), add(c, v), away) for w, v in ways))
            slack = ROUNDING * sum(most(y.ends) for y in parts)
            place = (down(low - slack), up(high + slack)) if slack else (low, high)
            if start is None:
                ranges.append(axis.met(*place))
                continue
            lowest, highest = hull(*(enclosure(w, v, away) for w, v in ways[1:]))
            ranges.append(axis.met(*place, (start[k], lowest >= 0, highest <= 0)))
        return ranges

    def _refuted(self, middle, control):
        """Return whether the middle of a box certainly leads out; not asked where paths end."""
        if self.map.path:
            return False
        try:
            images, _ = self.map.step(self._values([(x, x) for x in middle], control))
            numbers = [[axis.number(end) for end in image.ends]
                       for axis, image in zip(self.axes, images, strict=True)]  # fmt: skip
        except UNDEFINED:
            return False
        if any(first is None or first != last for first, last in numbers):
            return any(first is last is None for first, last in numbers)
        return not self._inside(numbers, self.allowed)

    def _cells(self, ranges):
        """Yield the cells of a product of ranges."""
        spans = []
        for axis, (first, last) in zip(self.axes, ranges, strict=True):
            if first > last:
                raise Unclear
            whole = axis.periodic and last - first >= axis.cells
            numbers = range(axis.cells) if whole else range(first, last + 1)
            spans.append([k % axis.cells for k in numbers])
        if math.prod(map(len, spans)) > LARGE:
            raise Unclear
        for index in itertools.product(*spans):
            cell = 0
            for axis, k in zip(self.axes, index, strict=True):
                cell = cell * axis.cells + k
            yield cell

    def _inside(self, ranges, cells):
        return all(cell in cells for cell in self._cells(ranges))

    def _meets(self, ranges, cells):
        return any(cell in cells for cell in self._cells(ranges))


def check(said, cells):
    """Return why claim 7 fails, or None, and sentences; ``cells`` are the lines of the cells."""
    sys.setrecursionlimit(20_000)
    judge = Judge(said, [entry["cell"] for entry in cells])
    about = "derivative" if judge.map.ode else "next value"
    sentences = [
        f"{about} of {name!a}: {text!a}"
        for name, text in zip(said["states"], said["formulas"], strict=True)
    ]
    if judge.map.ode:
        what = "their path is judged" if judge.map.path else "their path is not judged"
        sentences.append(
            f"Runge-Kutta steps of length {judge.map.h!r}, {judge.map.substeps} a step; {what}"
        )
    for entry in cells:
        control = entry["policy"]
        if not (type(control) is int and 0 <= control < len(judge.controls)):
            raise ValueError("the policy of a cell is no control")
        why = judge.unproved(entry["cell"], control)
        if why:
            return f"cell {entry['cell']}: {why}", sentences
    return None, [*sentences, f"{judge.boxes} boxes enclosed"]

"""The axes of the box, and the cells on them."""

import math
from math import nextafter

from claim_7.intervals import Unclear

EDGE = 1e-9  # widths of a cell up to which an image below an edge counts as lying on it


class Axis:
    """An axis of the box, and in which cells its points lie."""

    def __init__(self, low, high, cells, periodic, clip):
        self.low, self.high, self.cells = float.fromhex(low), float.fromhex(high), cells
        self.periodic, self.clip = periodic, clip and not periodic
        if not (type(cells) is int and 0 < cells < 2**31 and -math.inf < self.low < self.high):
            raise ValueError("an axis is none")
        self.width = (self.high - self.low) / cells
        if not 0 < self.width < math.inf:
            raise ValueError("an axis is none")

    def number(self, x):
        """Return the number of an image's cell, on a circle before the modulus; None outside.

        It grows with the image: all images between two have numbers between theirs.
        """
        turns = 0
        if self.periodic and not self.low <= x <= self.high:
            span = self.high - self.low
            turns = math.floor((x - self.low) / span)
            if abs(turns) > 2**20:
                return None
            rest = min(max(x - self.low - float(turns) * span, 0.0), span)
            x = min(self.low + rest, self.high)
        if self.clip:
            x = min(max(x, self.low), self.high)
        t = (x - self.low) / self.width
        k = math.floor(t + EDGE)
        if self.periodic:
            return turns * self.cells + k
        if k >= self.cells and (t - self.cells <= EDGE or x <= self.high):
            k = self.cells - 1
        return k if 0 <= k < self.cells else None

    def _home(self, x):
        """Return the number of a state, which no turn leads away from."""
        if (self.periodic or self.clip) and not self.low <= x <= self.high:
            return -1 if x < self.low else self.cells + 1
        k = self.number(x)
        if k is None:
            return -1 if x < self.low + self.width / 2 else self.cells + 1
        return k

    def _first(self, k):
        """Return the first double located at or behind k."""
        below, above = self.low + (k - 1) * self.width, self.low + (k + 1) * self.width
        if not self._home(below) < k <= self._home(above):
            raise ValueError("the cells of an axis are too small")
        while below < (middle := below / 2 + above / 2) < above:
            if self._home(middle) >= k:
                above = middle
            else:
                below = middle
        return above

    def pieces(self, i):
        """Return the intervals of all states located in cell i, with their numbers."""
        found = [(self._first(i), nextafter(self._first(i + 1), -math.inf), i)]
        if self.periodic and i == 0:  # states at the other end, up to `high` itself
            found.append((self._first(self.cells), self.high, self.cells))
        return [piece for piece in found if piece[0] <= piece[1]]

    def met(self, low, high, start=None):
        """Return the first and last number of images in an interval.

        ``start`` is (number, rises, falls): from there a path begins that certainly never falls, or
        never rises.
        """
        first, last = self.number(low), self.number(high)
        if start:
            number, rises, falls = start
            first = number if rises and (first is None or first < number) else first
            last = number if falls and (last is None or last > number) else last
        if first is None or last is None:
            raise Unclear
        return first, last

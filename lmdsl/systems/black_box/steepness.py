"""Lipschitz constants of a user's function: what they promise, and samples that contradict them.

The promise is about the function as it is computed, on the whole box of states and noise: two
images of the same control differ, state by state, by at most the constants times the distances
along the axes, and by what rounds (``ROUNDS`` of the sizes of what stands in that).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.errors import BadInput

Matrix = tuple[tuple[float, ...], ...]

ROUNDS = 2.0**-40  # of images, and of arguments times constants: what may round in them


class Steepness:
    """The constants of a function: of image i by variable j, |df_i/dx_j| <= ``rows[i][j]``.

    Parameters
    ----------
    rows
        One row per state, of a number per state and, where there are more, per noise variable.
    states, noise
        Their names.
    """

    def __init__(self, rows: Matrix, states: Sequence[str], noise: Sequence[str]) -> None:
        self.rows, self.states = rows, states
        self.variables = (*states, *noise)[: len(rows[0])]

    def spread(self, row: int, image: Floats, away: Sequence[Any], size: Sequence[Any]) -> Floats:
        """Return by how much at most an image differs from others.

        Parameters
        ----------
        row
            Of which state it is the image.
        image
            The image.
        away, size
            Of each variable how far the others are away, and the largest modulus among all.
        """
        total, around = np.zeros(()), np.abs(image)
        for constant, by, most in zip(self.rows[row], away, size, strict=False):
            if constant:  # else the shape of this variable stays out
                total = total + constant * by
                around = around + constant * most
        return np.asarray((total + ROUNDS * around) * (1 + ROUNDS) + 2.0**-1000)

    def require(self, values: Mapping[str, Any], images: Sequence[Floats]) -> None:
        """Refuse samples next to each other that contradict the constants.

        ``values`` are named arrays of as many axes, ``images`` those of the states. Where what has
        no constants varies along an axis, controls above all, samples are not compared along it.
        """
        axes = max(np.ndim(x) for x in values.values())
        ours = [np.asarray(values[name]) for name in self.variables]
        others = [np.shape(x) for name, x in values.items() if name not in self.variables]
        whole = [np.reshape(x, (1,) * (axes - np.ndim(x)) + np.shape(x)) for x in images]
        for axis in range(axes):
            if all(x.shape[axis] == 1 for x in ours) or any(x[axis] > 1 for x in others):
                continue
            a, b = ([_shifted(x, axis, k) for x in (*ours, *whole)] for k in (0, 1))
            self._compare(a, b)

    def _compare(self, a: Sequence[Floats], b: Sequence[Floats]) -> None:
        count = len(self.variables)
        with np.errstate(all="ignore"):
            away = [np.abs(x - y) for x, y in zip(a[:count], b[:count], strict=True)]
            size = [np.maximum(np.abs(x), np.abs(y)) for x, y in zip(a, b, strict=True)]
            for row, (f, g) in enumerate(zip(a[count:], b[count:], strict=True)):
                most = self.spread(row, size[count + row], away, size)
                wrong = ~(np.abs(f - g) <= most) & (np.isfinite(f) | np.isfinite(g))
                if wrong.any():
                    shape = np.broadcast_shapes(*(x.shape for x in (*a, *b)))
                    at = np.argwhere(np.broadcast_to(wrong, shape))[0]
                    raise self._contradicted(row, at, shape, a, b)

    def _contradicted(
        self, row: int, at: Any, shape: Any, a: Sequence[Floats], b: Sequence[Floats]
    ) -> BadInput:
        count = len(self.variables)
        points = []
        for side in (a, b):
            every = [float(np.broadcast_to(x, shape)[tuple(at)]) for x in side]
            where = zip(self.variables, every[:count], strict=True)
            said = ", ".join(f"{name} = {x!r}" for name, x in where)
            points.append(f"{every[count + row]!r} at {said}")
        constants = ", ".join(repr(float(x)) for x in self.rows[row])
        return BadInput(
            f"the image of {self.states[row]} is {points[0]} and {points[1]}: further apart "
            f"than the constants {constants} allow; make them larger (on a circle the image must "
            "not be wrapped), or leave lipschitz out",
            f"system.lipschitz[{row}]",
        )


def _shifted(x: Floats, axis: int, by: int) -> Floats:
    """Return all along an axis but the last, or the first; what does not vary as it is."""
    if x.shape[axis] == 1:
        return x
    return np.take(x, range(by, x.shape[axis] - 1 + by), axis=axis)

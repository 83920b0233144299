"""The sample points of a cell."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Discriminator, Tag

from lmdsl.common.strict_model import Count, Declared, Seed, frozen_dict, plain
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput, shown
from lmdsl.problem.unions import kinds

MOST_AXES = 8  # with corners: 256 of them

PerAxis = Annotated[
    Annotated[Count, Tag("<one>")]
    | Annotated[dict[str, Count], BeforeValidator(plain), frozen_dict, Tag("<each>")],
    Discriminator(lambda value: "<each>" if isinstance(value, Mapping) else "<one>"),
]


class _Sampling(Declared):
    """Some sample points of a cell, and its corners on request.

    Attributes
    ----------
    corners
        Whether the corners of the closed cell follow: offsets 0 and 1, C order.
    """

    kind: str
    corners: bool = False

    def check(self, states: Sequence[str]) -> None:
        """Refuse what does not fit the axes of a problem."""
        if self.corners and len(states) > MOST_AXES:
            raise BadInput(
                f"a cell of {len(states)} axes has 2^{len(states)} corners; corners are for at "
                f"most {MOST_AXES} axes, leave the key out",
                "sampling.corners",
            )

    def count(self, states: Sequence[str]) -> int:
        """Return the number of sample points in a cell with these axes."""
        return self._inner(states) + (2 ** len(states) if self.corners else 0)

    def offsets(self, states: Sequence[str]) -> Floats:
        """Return the sample offsets within a cell, shape (points, d), in [0, 1]."""
        inner = self._points(states)
        if not self.corners:
            return inner
        corners = list(itertools.product((0.0, 1.0), repeat=len(states)))
        return np.concatenate([inner, corners])

    def _inner(self, states: Sequence[str]) -> int:
        raise NotImplementedError

    def _points(self, states: Sequence[str]) -> Floats:
        raise NotImplementedError


class Grid(_Sampling):
    """Sample points (i + 1/2)/k on each axis of a cell, C order.

    Attributes
    ----------
    per_axis
        The k of all axes, or of each by name.
    """

    kind: Literal["grid"] = "grid"
    per_axis: PerAxis

    def check(self, states: Sequence[str]) -> None:
        """See :meth:`_Sampling.check`."""
        super().check(states)
        if not isinstance(self.per_axis, Mapping):
            return
        for name in self.per_axis:
            if name not in states:
                raise BadInput(
                    f"{shown(name)} is not an axis; the axes are {', '.join(states)}",
                    "sampling.per_axis",
                )
        for name in states:
            if name not in self.per_axis:
                raise BadInput(
                    f"no number for the axis {name}; give one each, or one number for all",
                    "sampling.per_axis",
                )

    def _each(self, states: Sequence[str]) -> list[int]:
        k = self.per_axis
        return [int(k[name] if isinstance(k, Mapping) else k) for name in states]

    def _inner(self, states: Sequence[str]) -> int:
        return math.prod(self._each(states))

    def _points(self, states: Sequence[str]) -> Floats:
        axes = [(np.arange(k) + 0.5) / k for k in self._each(states)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


class _Points(_Sampling):
    """A number of sample points, drawn with a seed."""

    points: Count
    seed: Seed = 0

    def _inner(self, states: Sequence[str]) -> int:
        return int(self.points)


class Random(_Points):
    """Uniform sample points, the same in every cell: ``default_rng(seed).random((points, d))``."""

    kind: Literal["random"] = "random"

    def _points(self, states: Sequence[str]) -> Floats:
        return np.random.default_rng(self.seed).random((self.points, len(states)))


class Sobol(_Points):
    """Scrambled Sobol points, the same in every cell."""

    kind: Literal["sobol"] = "sobol"

    def _points(self, states: Sequence[str]) -> Floats:
        from scipy.stats import qmc

        # Of another number than a power of two SciPy warns: their balance is lost. Filters of
        # warnings are the process's, not a thread's: the next power is drawn, its first are taken.
        drawn = qmc.Sobol(len(states), scramble=True, seed=self.seed)
        points: Floats = drawn.random_base2((self.points - 1).bit_length())
        return points[: self.points]


if TYPE_CHECKING:
    SamplingUnion = Grid | Random | Sobol
else:
    SamplingUnion = kinds(Grid, Random, Sobol)

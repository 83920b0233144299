"""The sample points of a cell."""

import warnings
from typing import TYPE_CHECKING, Literal

import numpy as np

from lmdsl.common.strict_model import Count, Declared, Seed
from lmdsl.common.types import Floats
from lmdsl.problem.unions import kinds


class Grid(Declared):
    """Sample points (i + 1/2)/k on each axis of a cell, C order."""

    kind: Literal["grid"] = "grid"
    per_axis: Count

    def count(self, d: int) -> int:
        """Return the number of sample points in a cell of d axes."""
        return int(self.per_axis**d)

    def offsets(self, d: int) -> Floats:
        """Return the sample offsets within a cell, shape (points, d), in [0, 1)."""
        axis = (np.arange(self.per_axis) + 0.5) / self.per_axis
        return np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)


class _Points(Declared):
    """A number of sample points, drawn with a seed."""

    kind: str
    points: Count
    seed: Seed = 0

    def count(self, d: int) -> int:
        """See :meth:`Grid.count`."""
        return int(self.points)


class Random(_Points):
    """Uniform sample points, the same in every cell: ``default_rng(seed).random((points, d))``."""

    kind: Literal["random"] = "random"

    def offsets(self, d: int) -> Floats:
        """See :meth:`Grid.offsets`."""
        return np.random.default_rng(self.seed).random((self.points, d))


class Sobol(_Points):
    """Scrambled Sobol points, the same in every cell."""

    kind: Literal["sobol"] = "sobol"

    def offsets(self, d: int) -> Floats:
        """See :meth:`Grid.offsets`."""
        from scipy.stats import qmc

        with warnings.catch_warnings():
            # Balance wants a power of two; any number of points is a valid sample.
            warnings.simplefilter("ignore", UserWarning)
            points: Floats = qmc.Sobol(d, scramble=True, seed=self.seed).random(self.points)
        return points


if TYPE_CHECKING:
    SamplingUnion = Grid | Random | Sobol
else:
    SamplingUnion = kinds(Grid, Random, Sobol)

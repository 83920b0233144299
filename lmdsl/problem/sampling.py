"""The sample points of a cell."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from lmdsl.common.strict_model import Count, Declared, Seed
from lmdsl.problem.unions import kinds


class Grid(Declared):
    """Sample points (i + 1/2)/k on each axis of a cell, C order."""

    kind: Literal["grid"] = "grid"
    per_axis: Count


class Random(Declared):
    """Uniform sample points, the same in every cell: ``default_rng(seed).random((points, d))``."""

    kind: Literal["random"] = "random"
    points: Count
    seed: Seed = 0


class Sobol(Declared):
    """Scrambled Sobol points, the same in every cell."""

    kind: Literal["sobol"] = "sobol"
    points: Count
    seed: Seed = 0


if TYPE_CHECKING:
    SamplingUnion = Grid | Random | Sobol
else:
    SamplingUnion = kinds(Grid, Random, Sobol)

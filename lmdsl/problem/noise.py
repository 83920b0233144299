"""The distributions of the noise."""

import math
from typing import Annotated, Self

import numpy as np
from pydantic import BeforeValidator, Field, Tag, model_validator

from lmdsl.common.strict_model import Declared, Number, Numbers, Positive, frozen_dict, plain
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.formulas.names import named_keys, valid_names
from lmdsl.problem.unions import EachWords, tag_by_key

MAX_HERMITE = 64  # number of nodes above which a quadrature is refused
MAX_MIDPOINTS = 1_000


class NoiseValues(Declared):
    """A discrete noise variable: values and their probabilities."""

    values: Numbers
    weights: Annotated[Numbers, EachWords({"minimum": 0, "maximum": 1 + 1e-9})]

    @model_validator(mode="after")
    def _distribution(self) -> Self:
        if len(self.values) != len(self.weights):
            raise BadInput(
                f"{len(self.weights)} weights for {len(self.values)} values; give one each",
                "weights",
            )
        for i, weight in enumerate(self.weights):
            if weight < 0:
                raise BadInput(
                    f"{weight!r} is negative; weights are probabilities", f"weights[{i}]"
                )
        for i, weight in enumerate(self.weights):
            if weight > 1 + 1e-9:
                raise BadInput(
                    f"{weight!r} is more than 1; weights are probabilities", f"weights[{i}]"
                )
        total = math.fsum(self.weights)
        if abs(total - 1) > 1e-9:
            raise BadInput(f"the weights sum to {total!r}; they must sum to 1", "weights")
        return self

    def count(self) -> int:
        """Return the number of nodes without making them."""
        return len(self.values)

    def nodes(self) -> tuple[Floats, Floats]:
        """Return the nodes and their weights, which are not scaled and may be zero."""
        return np.array(self.values), np.array(self.weights)

    def draw(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw from the distribution, shape (count,)."""
        values, weights = self.nodes()
        return rng.choice(values, size=count, p=weights / math.fsum(weights))

    def parts(self) -> tuple[Floats, Floats]:
        """Return intervals that hold every value that enclosures cover: their ends."""
        values, weights = self.nodes()
        return values[weights > 0], values[weights > 0]


class Normal(Declared):
    """A normal distribution of mean 0 by Gauss-Hermite quadrature.

    Attributes
    ----------
    std, points
        Standard deviation, and number of nodes.
    within
        Standard deviations that enclosures cover beside the nodes.
    """

    std: Positive
    points: Annotated[int, Field(strict=True, ge=1, le=MAX_HERMITE), BeforeValidator(plain)]
    within: Positive | None = None

    @model_validator(mode="after")
    def _finite(self) -> Self:
        if not math.isfinite((self.within or 0.0) * self.std):
            raise BadInput(f"{self.within!r} deviations are too far for doubles", "within")
        return self


class NoiseNormal(Declared):
    """A normally distributed noise variable."""

    normal: Normal

    def count(self) -> int:
        """See :meth:`NoiseValues.count`."""
        return self.normal.points

    def nodes(self) -> tuple[Floats, Floats]:
        """See :meth:`NoiseValues.nodes`."""
        x, w = np.polynomial.hermite.hermgauss(self.normal.points)
        return math.sqrt(2) * self.normal.std * x, w

    def draw(self, rng: np.random.Generator, count: int) -> Floats:
        """See :meth:`NoiseValues.draw`."""
        return self.normal.std * rng.standard_normal(count)

    def parts(self) -> tuple[Floats, Floats]:
        """See :meth:`NoiseValues.parts`."""
        nodes, _ = self.nodes()
        if self.normal.within is None:
            return nodes, nodes
        reach = self._reach(self.normal.within)
        ends = np.linspace(-reach, reach, self.normal.points + 1)
        return ends[:-1], ends[1:]

    def missed(self) -> float:
        """Return the probability of what enclosures do not cover, rounded up."""
        if self.normal.within is None:
            return 1.0
        return math.erfc(self._reach(self.normal.within) / self.normal.std / math.sqrt(2)) * 1.001

    def _reach(self, within: float) -> float:
        return max(float(self.nodes()[0][-1]), within * self.normal.std)


class Uniform(Declared):
    """A uniform distribution by the midpoints of equal parts."""

    low: Number
    high: Number
    points: Annotated[int, Field(strict=True, ge=1, le=MAX_MIDPOINTS), BeforeValidator(plain)]

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.low < self.high:
            raise BadInput(f"{self.low!r} is not below high = {self.high!r}", "low")
        if not math.isfinite(self.high - self.low):
            raise BadInput(f"{self.high!r} is too far from low for doubles", "high")
        return self


class NoiseUniform(Declared):
    """A uniformly distributed noise variable."""

    uniform: Uniform

    def count(self) -> int:
        """See :meth:`NoiseValues.count`."""
        return self.uniform.points

    def nodes(self) -> tuple[Floats, Floats]:
        """See :meth:`NoiseValues.nodes`."""
        low, high, k = self.uniform.low, self.uniform.high, self.uniform.points
        return low + (np.arange(k) + 0.5) / k * (high - low), np.full(k, 1.0 / k)

    def draw(self, rng: np.random.Generator, count: int) -> Floats:
        """See :meth:`NoiseValues.draw`."""
        return rng.uniform(self.uniform.low, self.uniform.high, count)

    def parts(self) -> tuple[Floats, Floats]:
        """See :meth:`NoiseValues.parts`."""
        ends = np.linspace(self.uniform.low, self.uniform.high, self.uniform.points + 1)
        return ends[:-1], ends[1:]


NoiseUnion = Annotated[
    Annotated[NoiseNormal, Tag("<normal>")]
    | Annotated[NoiseUniform, Tag("<uniform>")]
    | Annotated[NoiseValues, Tag("<other>")],
    tag_by_key({"normal": NoiseNormal, "uniform": NoiseUniform}),
]

Noise = Annotated[
    dict[str, NoiseUnion], BeforeValidator(plain), valid_names, named_keys, frozen_dict
]

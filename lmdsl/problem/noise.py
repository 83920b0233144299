"""The distributions of the noise."""

import math
from typing import Annotated, Self

import numpy as np
from pydantic import BeforeValidator, Field, Tag, model_validator

from lmdsl.common.strict_model import Declared, Numbers, Positive, frozen_dict, plain
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.formulas.names import named_keys, valid_names
from lmdsl.problem.unions import EachWords, tag_by_key

MAX_HERMITE = 64  # number of nodes above which a quadrature is refused


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


class Normal(Declared):
    """A normal distribution of mean 0 by Gauss-Hermite quadrature."""

    std: Positive
    points: Annotated[int, Field(strict=True, ge=1, le=MAX_HERMITE), BeforeValidator(plain)]


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


NoiseUnion = Annotated[
    Annotated[NoiseNormal, Tag("<a>")] | Annotated[NoiseValues, Tag("<b>")],
    tag_by_key("normal", NoiseNormal),
]

Noise = Annotated[
    dict[str, NoiseUnion], BeforeValidator(plain), valid_names, named_keys, frozen_dict
]

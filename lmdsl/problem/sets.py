"""Sets of cells: the attractor, what is to be avoided, and where runs start."""

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator

from lmdsl.common.faults import written
from lmdsl.common.inputs import is_number
from lmdsl.common.strict_model import Box, Declared, Number, Numbers, frozen_dict, plain
from lmdsl.errors import BadInput
from lmdsl.formulas.names import Conditions, FormulaText
from lmdsl.problem.unions import EachWords

MAX_BOXES = 10_000  # number of boxes, points or cells above which a set is refused

Point = Annotated[
    Annotated[tuple[Number, ...], Tag("<a>")]
    | Annotated[dict[str, Number], frozen_dict, Tag("<b>")],
    Discriminator(lambda v: "<b>" if isinstance(v, Mapping) else "<a>"),
    BeforeValidator(plain),
]


def _several(value: Any) -> Any:
    """Refuse one point or box where a list of them is wanted, and say how to write that."""
    value = plain(value)
    one = isinstance(value, dict) or (
        isinstance(value, tuple) and value and all(map(is_number, value))
    )
    if not one:
        return value
    what = written(value)
    raise BadInput(f"{what} stands for one; write a list of them, [{what}]")


Points = Annotated[tuple[Point, ...], Field(fail_fast=True), BeforeValidator(_several)]

Boxes = Annotated[
    tuple[Box, ...], Field(max_length=MAX_BOXES, fail_fast=True), BeforeValidator(_several)
]

SomeBoxes = Annotated[
    tuple[Box, ...],
    Field(min_length=1, max_length=MAX_BOXES, fail_fast=True),
    BeforeValidator(_several),
]

CellIndex = Annotated[
    tuple[Annotated[int, Field(strict=True, ge=0, lt=2**31)], ...], BeforeValidator(plain)
]

CellIndices = Annotated[tuple[CellIndex, ...], Field(fail_fast=True), BeforeValidator(plain)]


class Attractor(Declared):
    """The attractor cells: the union of points, boxes, cells and conditions.

    Attributes
    ----------
    points
        Every closed cell within 1e-9 widths of a point; a list or an object per point.
    boxes
        The cells inside a box (up to 1e-9 widths).
    cells
        Multi-indices of cells.
    where
        A condition in the states, or several: the cells on all of which one certainly holds.
    """

    points: Points = ()
    boxes: Boxes = ()
    cells: CellIndices = ()
    where: Conditions | None = None

    @property
    def empty(self) -> bool:
        """Whether nothing is declared, which only a problem with a discount may do."""
        return not (self.points or self.boxes or self.cells or self.where is not None)


_SOME_ATTRACTOR = {
    "anyOf": [
        {"required": [key], "properties": {key: {"not": {"type": "array", "maxItems": 0}}}}
        for key in ("points", "boxes", "cells", "where")
    ]
}
# The words of a JSON Schema for a problem with an attractor, or with a discount.
REACHED_OR_ENDED = {
    "anyOf": [{"required": ["discount"]}, {"properties": {"attractor": _SOME_ATTRACTOR}}]
}


class Avoid(Declared):
    """Unsafe cells: landing there counts as leaving.

    Attributes
    ----------
    boxes
        Every cell whose interior overlaps one.
    where
        A condition in the states, or several: every cell in which one may hold somewhere.
    """

    model_config = ConfigDict(
        json_schema_extra={"anyOf": [{"required": [key]} for key in ("boxes", "where")]}
    )

    boxes: SomeBoxes | None = None
    where: Conditions | None = None

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.boxes is None and self.where is None:
            raise BadInput("nothing to avoid; give boxes or where")
        return self


class Measure(Declared):
    """The weight m of the starting cells, up to a factor; it is intersected with C and scaled.

    Attributes
    ----------
    boxes
        Only the cells inside their union carry weight.
    where
        A condition in the states, or several: the cells on all of which one certainly holds carry
        weight, those in boxes too.
    density
        Formula in the states, evaluated at the centre of each cell; finite and >= 0. Default 1.
    weights
        One number >= 0 per cell, C order, instead of a density.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [{"required": [key]} for key in ("boxes", "where", "density", "weights")],
            "not": {"required": ["density", "weights"]},
        }
    )

    boxes: SomeBoxes | None = None
    where: Conditions | None = None
    density: FormulaText | None = None
    weights: Annotated[Numbers, EachWords({"minimum": 0})] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if all(x is None for x in (self.boxes, self.where, self.density, self.weights)):
            raise BadInput("give boxes, where, a density or weights")
        if self.density is not None and self.weights is not None:
            raise BadInput("density and weights exclude each other; keep one")
        for i, weight in enumerate(self.weights or ()):
            if weight < 0:
                raise BadInput(f"{weight!r} is negative; weights are >= 0", f"weights[{i}]")
        return self

"""The parts of a problem: axes, controls, noise, samplings, sets of cells; each a small model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from lmdsl.common.strict_model import (
    Box,
    Count,
    Declared,
    Number,
    Numbers,
    Positive,
    SchemaWords,
    Seed,
    frozen_dict,
    plain,
)
from lmdsl.errors import BadInput
from lmdsl.formulas.names import FormulaText, named_keys, valid_names
from lmdsl.systems import NAMED, FunctionSystem, MapSystem, OdeSystem, System

MAX_AXES = 16
MAX_HERMITE = 64
MAX_BOXES = 10_000


class _Each(SchemaWords):
    """Words for each number of a list."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        schema = handler(core)
        return {**schema, "items": {**schema["items"], **self.words}}


class Axis(Declared):
    """One axis of the state box.

    Attributes
    ----------
    low, high
        Ends of the axis, low < high, in the units of the state.
    cells
        Number of equal cells.
    periodic
        True on a circle: images are wrapped into [low, high].
    """

    low: Number
    high: Number
    cells: Count
    periodic: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> Axis:
        width = (self.high - self.low) / self.cells
        if not self.low < self.high:
            raise BadInput(f"low {self.low!r} must be less than high {self.high!r}")
        if not math.isfinite(width):
            raise BadInput(f"high - low overflows: {self.low!r}, {self.high!r}; rescale the state")
        scale = max(abs(self.low), abs(self.high))
        if self.cells < 2**40 and not width > 1e-13 * scale:
            raise BadInput(f"cells of width {width!r} are below what doubles resolve; use fewer")
        return self


class ControlRange(Declared):
    """Equally spaced control values: ``numpy.linspace(low, high, points)``."""

    low: Number
    high: Number
    points: Count

    @model_validator(mode="after")
    def _ordered(self) -> ControlRange:
        if self.points == 1 and self.low != self.high:
            raise BadInput(f"one point needs low == high, not {self.low!r} and {self.high!r}")
        if self.points > 1 and not self.low < self.high:
            raise BadInput(f"low {self.low!r} must be less than high {self.high!r}")
        if not math.isfinite(self.high - self.low):
            raise BadInput(f"high - low overflows: {self.low!r}, {self.high!r}")
        return self


class ControlValues(Declared):
    """Control values written out; distinct, order kept."""

    values: Annotated[Numbers, SchemaWords({"uniqueItems": True})]

    @model_validator(mode="after")
    def _distinct(self) -> ControlValues:
        seen: set[float] = set()
        for value in self.values:
            if value in seen:
                raise BadInput(f"{value!r} stands twice; list each value once", "values")
            seen.add(value)
        return self


class NoiseValues(Declared):
    """A discrete noise variable: values and their probabilities."""

    values: Numbers
    weights: Annotated[Numbers, _Each({"minimum": 0, "maximum": 1 + 1e-9})]

    @model_validator(mode="after")
    def _distribution(self) -> NoiseValues:
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


class Normal(Declared):
    """A normal distribution of mean 0 by Gauss-Hermite quadrature."""

    std: Positive
    points: Annotated[int, Field(strict=True, ge=1, le=MAX_HERMITE), BeforeValidator(plain)]


class NoiseNormal(Declared):
    """A normally distributed noise variable."""

    normal: Normal


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


def _tag_by_kind(value: Any) -> str:
    kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
    return f"<{kind}>" if isinstance(kind, str) else "<?>"


def _tag_by_key(key: str, model: type) -> Any:
    def tag(value: Any) -> str:
        held = isinstance(value, model) or (isinstance(value, Mapping) and key in value)
        return "<a>" if held else "<b>"

    return Discriminator(tag)


def _kinds(*models: type[Declared]) -> Any:
    tagged = [Annotated[m, Tag(f"<{m.model_fields['kind'].default}>")] for m in models]
    union: Any = tagged[0]
    for member in tagged[1:]:
        union = union | member
    names = ", ".join(str(m.model_fields["kind"].default) for m in models)
    return Annotated[
        union,
        Discriminator(
            _tag_by_kind,
            custom_error_type="kind",
            custom_error_message=f"'kind' is missing or unknown; known kinds: {names}",
        ),
    ]


class _KindsOfFiles:
    """Leaves what no JSON can be out of the JSON Schema of a union."""

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        schema: dict[str, Any] = handler(core)
        kinds = [one for one in schema["oneOf"] if not _is_function(one)]
        return {**schema, "oneOf": kinds}


def _is_function(schema: dict[str, Any]) -> bool:
    """Return whether a schema, or what it refers to and may not be made yet, is a function's."""
    return schema == {"not": {}} or FunctionSystem.__name__ in schema.get("$ref", "")


def _json_kinds(value: Any) -> Any:
    if isinstance(value, Mapping) and value.get("kind") == "function":
        raise BadInput(
            "kind 'function' cannot be declared as data; build a FunctionSystem in Python, "
            "or write formulas with kind 'map' or 'ode'"
        )
    return value


if TYPE_CHECKING:
    SystemUnion = System
    SamplingUnion = Grid | Random | Sobol
else:
    SystemUnion = Annotated[
        _kinds(MapSystem, OdeSystem, *NAMED.values(), FunctionSystem),
        BeforeValidator(_json_kinds),
        _KindsOfFiles(),
    ]
    SamplingUnion = _kinds(Grid, Random, Sobol)
ControlUnion = Annotated[
    Annotated[ControlValues, Tag("<a>")] | Annotated[ControlRange, Tag("<b>")],
    _tag_by_key("values", ControlValues),
]
NoiseUnion = Annotated[
    Annotated[NoiseNormal, Tag("<a>")] | Annotated[NoiseValues, Tag("<b>")],
    _tag_by_key("normal", NoiseNormal),
]

MAX_ORBIT = 64

NamedNumbers = Annotated[dict[str, Number], BeforeValidator(plain), frozen_dict]
PositiveNumbers = Annotated[dict[str, Positive], BeforeValidator(plain), frozen_dict]
PerPoint = Annotated[
    Annotated[Number, Tag("<a>")] | Annotated[Numbers, Tag("<b>")],
    Discriminator(lambda v: "<b>" if isinstance(v, list | tuple | np.ndarray) else "<a>"),
]
"""One number for all points of an orbit, or one for each."""
AlongOrbit = Annotated[dict[str, PerPoint], BeforeValidator(plain), frozen_dict]
Gain = Annotated[dict[str, AlongOrbit], BeforeValidator(plain), frozen_dict]
Point = Annotated[
    Annotated[tuple[Number, ...], Tag("<a>")]
    | Annotated[dict[str, Number], frozen_dict, Tag("<b>")],
    Discriminator(lambda v: "<b>" if isinstance(v, Mapping) else "<a>"),
    BeforeValidator(plain),
]
Points = Annotated[tuple[Point, ...], Field(fail_fast=True), BeforeValidator(plain)]
Orbit = Annotated[
    tuple[Point, ...],
    Field(min_length=1, max_length=MAX_ORBIT, fail_fast=True),
    BeforeValidator(plain),
]
Boxes = Annotated[
    tuple[Box, ...], Field(max_length=MAX_BOXES, fail_fast=True), BeforeValidator(plain)
]
SomeBoxes = Annotated[
    tuple[Box, ...],
    Field(min_length=1, max_length=MAX_BOXES, fail_fast=True),
    BeforeValidator(plain),
]
CellIndex = Annotated[
    tuple[Annotated[int, Field(strict=True, ge=0, lt=2**31)], ...], BeforeValidator(plain)
]
CellIndices = Annotated[tuple[CellIndex, ...], Field(fail_fast=True), BeforeValidator(plain)]


class Attractor(Declared):
    """The attractor cells: the union of points, boxes and cells.

    Attributes
    ----------
    points
        Every closed cell within 1e-9 widths of a point; a list or an object per point.
    boxes
        The cells inside a box (up to 1e-9 widths).
    cells
        Multi-indices of cells.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [
                {"required": [key], "properties": {key: {"not": {"maxItems": 0}}}}
                for key in ("points", "boxes", "cells")
            ]
        }
    )

    points: Points = ()
    boxes: Boxes = ()
    cells: CellIndices = ()

    @model_validator(mode="after")
    def _something(self) -> Attractor:
        if not (self.points or self.boxes or self.cells):
            raise BadInput("no attractor cell; give points, boxes or cells")
        return self


class Avoid(Declared):
    """Unsafe cells: every cell whose interior overlaps a box. Landing there counts as leaving."""

    boxes: SomeBoxes


class Measure(Declared):
    """The weight m of the starting cells, up to a factor; it is intersected with C and scaled.

    Attributes
    ----------
    boxes
        Only the cells inside their union carry weight.
    density
        Formula in the states, evaluated at the centre of each cell; finite and >= 0. Default 1.
    weights
        One number >= 0 per cell, C order, instead of a density.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "anyOf": [{"required": [key]} for key in ("boxes", "density", "weights")],
            "not": {"required": ["density", "weights"]},
        }
    )

    boxes: SomeBoxes | None = None
    density: FormulaText | None = None
    weights: Annotated[Numbers, _Each({"minimum": 0})] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Measure:
        if self.boxes is None and self.density is None and self.weights is None:
            raise BadInput("give boxes, a density or weights")
        if self.density is not None and self.weights is not None:
            raise BadInput("density and weights exclude each other; keep one")
        for i, weight in enumerate(self.weights or ()):
            if weight < 0:
                raise BadInput(f"{weight!r} is negative; weights are >= 0", f"weights[{i}]")
        return self


class ConstantControl(Declared):
    """A local controller that holds one control vector on the attractor cells.

    Attributes
    ----------
    control
        Control name to value; controls left out are 0.
    """

    kind: Literal["constant"] = "constant"
    control: NamedNumbers = Field(default_factory=dict, validate_default=True)


class LinearFeedback(Declared):
    """A local controller u = u_k - K (x - x_k) around the nearest point of an orbit.

    Attributes
    ----------
    orbit
        The fixed point (one), or the points of a periodic orbit in the order visited.
    control
        Control name to its value along the orbit (a number, or one per point); default 0.
    gain
        Control name to axis name to an entry of K (a number, or one per point); entries left out
        are 0.
    """

    kind: Literal["linear"] = "linear"
    orbit: Orbit
    control: AlongOrbit = Field(default_factory=dict, validate_default=True)
    gain: Gain


class LqrFeedback(Declared):
    """A local controller u = u_k - K_k (x - x_k), K_k by the linear-quadratic regulator (LQR).

    The system is linearised along the orbit; K minimises the sum of x'Qx + u'Ru of the deviations,
    Q and R diagonal.

    Attributes
    ----------
    orbit
        The fixed point (one), or the points of a periodic orbit in the order visited.
    control
        Control name to its value along the orbit (a number, or one per point); default 0.
    state_weights
        Axis name to its entry of Q, > 0; default 1 / (cell width)^2 (Bryson's rule).
    control_weights
        Control name to its entry of R, > 0; default 1 / (largest |value - control|)^2.
    """

    kind: Literal["lqr"] = "lqr"
    orbit: Orbit
    control: AlongOrbit = Field(default_factory=dict, validate_default=True)
    state_weights: PositiveNumbers = Field(default_factory=dict, validate_default=True)
    control_weights: PositiveNumbers = Field(default_factory=dict, validate_default=True)


if TYPE_CHECKING:
    LocalUnion = ConstantControl | LinearFeedback | LqrFeedback
else:
    LocalUnion = _kinds(ConstantControl, LinearFeedback, LqrFeedback)

StateBox = Annotated[
    dict[str, Axis],
    Field(min_length=1, max_length=MAX_AXES),
    BeforeValidator(plain),
    valid_names,
    named_keys,
    frozen_dict,
]
ControlGrid = Annotated[
    dict[str, ControlUnion], BeforeValidator(plain), valid_names, named_keys, frozen_dict
]
Noise = Annotated[
    dict[str, NoiseUnion], BeforeValidator(plain), valid_names, named_keys, frozen_dict
]

"""What the user writes: the problem file as strict, frozen pydantic models, and its reader.

Reading never runs code, opens no other file, and costs time and memory in proportion to the
file (at most 16 MiB). Geometry is resolved later, in partition.py.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator
from pydantic.json_schema import GenerateJsonSchema

from lmdsl.declared import (
    Box,
    Count,
    Declared,
    FrozenDict,
    Number,
    Numbers,
    Seed,
    _frozen_dict,
    _names,
    _plain,
)
from lmdsl.errors import BadInput, shown
from lmdsl.files import read_json, write_whole
from lmdsl.formulas import Formula, parse
from lmdsl.systems import NAMED, FunctionSystem, MapSystem, OdeSystem, System

FORMAT = "lmdsl/1"
MAX_AXES = 16
MAX_HERMITE = 64

Positive = Annotated[Number, Field(gt=0)]


class Axis(Declared):
    """One axis of the state box.

    Attributes
    ----------
    low, high
        Ends of the axis, low < high, in the units of the state.
    cells
        Number of equal cells.
    periodic
        True on a circle: images are wrapped into [low, high).
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
            raise BadInput(f"cells of width {width!r} are below the resolution of doubles; use fewer")
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

    values: Annotated[Numbers, Field(min_length=1)]

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

    values: Annotated[Numbers, Field(min_length=1)]
    weights: Annotated[Numbers, Field(min_length=1)]

    @model_validator(mode="after")
    def _distribution(self) -> NoiseValues:
        if len(self.values) != len(self.weights):
            raise BadInput(
                f"{len(self.weights)} weights for {len(self.values)} values; give one each", "weights"
            )
        for i, weight in enumerate(self.weights):
            if weight < 0:
                raise BadInput(f"{weight!r} is negative; weights are probabilities", f"weights[{i}]")
        total = math.fsum(self.weights)
        if abs(total - 1) > 1e-9:
            raise BadInput(f"the weights sum to {total!r}; they must sum to 1", "weights")
        return self


class Normal(Declared):
    """A normal distribution of mean 0 by Gauss-Hermite quadrature."""

    std: Positive
    points: Annotated[Count, Field(le=MAX_HERMITE)]


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


def _json_kinds(value: Any) -> Any:
    if isinstance(value, Mapping) and value.get("kind") == "function":
        raise BadInput(
            "kind 'function' cannot be declared as data; build a FunctionSystem in Python, "
            "or write formulas with kind 'map' or 'ode'"
        )
    return value


SystemUnion = Annotated[
    _kinds(MapSystem, OdeSystem, *NAMED.values(), FunctionSystem), BeforeValidator(_json_kinds)
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

Point = Annotated[
    tuple[Number, ...] | dict[str, Number],
    BeforeValidator(_plain),
    AfterValidator(lambda v: FrozenDict(v) if isinstance(v, dict) else v),
]
Points = Annotated[tuple[Point, ...], BeforeValidator(_plain)]
Boxes = Annotated[tuple[Box, ...], BeforeValidator(_plain)]
CellIndex = Annotated[
    tuple[Annotated[int, Field(strict=True, ge=0)], ...], BeforeValidator(_plain)
]
CellIndices = Annotated[tuple[CellIndex, ...], BeforeValidator(_plain)]


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

    boxes: Annotated[Boxes, Field(min_length=1)]


class Measure(Declared):
    """Support of the weight m: the cells inside the union of boxes, intersected with C."""

    boxes: Annotated[Boxes, Field(min_length=1)]


StateBox = Annotated[
    dict[str, Axis],
    BeforeValidator(_plain),
    Field(min_length=1, max_length=MAX_AXES),
    _names,
    _frozen_dict,
]
ControlGrid = Annotated[dict[str, ControlUnion], BeforeValidator(_plain), _names, _frozen_dict]
Noise = Annotated[dict[str, NoiseUnion], BeforeValidator(_plain), _names, _frozen_dict]


class Problem(Declared):
    """A stabilization problem: the models behind the problem file, with the same names.

    Attributes
    ----------
    system
        x+ = T(x, u, w).
    state_box
        Axes in order; the cells are their C-order product.
    attractor
        The set A to reach.
    control_grid
        Control variables; the control vectors are the C-order product of their values.
    stage_cost
        Formula G(x, u, w), finite and >= 0.
    sampling
        Sample points within a cell for Ulam's method.
    gamma
        Geometric weight of the cost, sum of gamma^n G(x_n, u_n).
    noise, avoid, measure, on_exit, name
        Optional; see the problem format in the documentation.

    Raises
    ------
    BadInput
        With the path of the field, the value and the fix.
    """

    format: Literal["lmdsl/1"] = FORMAT
    name: Annotated[str, Field(max_length=1000)] = ""
    system: SystemUnion
    state_box: StateBox
    attractor: Attractor
    avoid: Avoid | None = None
    control_grid: ControlGrid
    noise: Noise | None = None
    stage_cost: str
    sampling: SamplingUnion
    gamma: Positive = 1.0
    on_exit: Literal["forbid", "clip"] = "forbid"
    measure: Measure | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Problem:
        self._unique_names()
        self._axes_named()
        self.step()
        self.cost()
        return self

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, in the order of the axes."""
        return tuple(self.state_box)

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(self.control_grid)

    @property
    def noises(self) -> tuple[str, ...]:
        """Names of the noise variables."""
        return tuple(self.noise or ())

    def step(self) -> Any:
        """Return the system's function from named arrays to images (see systems/base.py)."""
        system: System = self.system
        return system.compile(self.states, self.controls, self.noises)

    def cost(self) -> Formula:
        """Return the parsed stage cost."""
        names = [*self.states, *self.controls, *self.noises, *self.system.constants()]
        try:
            return parse(self.stage_cost, names)
        except BadInput as error:
            raise BadInput(error.message, "stage_cost") from None

    def _unique_names(self) -> None:
        kinds = {
            "state_box": self.states,
            "control_grid": self.controls,
            "noise": self.noises,
            "system.parameters": tuple(self.system.constants()),
        }
        owner: dict[str, str] = {}
        for kind, names in kinds.items():
            for name in names:
                if name in owner:
                    raise BadInput(f"the name {name!r} is also used in {owner[name]}", kind)
                owner[name] = kind

    def _axes_named(self) -> None:
        for i, point in enumerate(self.attractor.points):
            if isinstance(point, dict) and set(point) != set(self.states):
                raise BadInput(
                    f"a point names every axis once: {', '.join(self.states)}",
                    f"attractor.points[{i}]",
                )
            if len(point) != len(self.states):
                raise BadInput(
                    f"{len(point)} coordinates for {len(self.states)} axes",
                    f"attractor.points[{i}]",
                )
        for i, cell in enumerate(self.attractor.cells):
            if len(cell) != len(self.states):
                raise BadInput(
                    f"{len(cell)} indices for {len(self.states)} axes", f"attractor.cells[{i}]"
                )
        for where in ("attractor", "avoid", "measure"):
            part = getattr(self, where)
            for i, box in enumerate(part.boxes if part else ()):
                self._box_named(box, f"{where}.boxes[{i}]")

    def _box_named(self, box: Mapping[str, tuple[float, float]], where: str) -> None:
        for name, (a, b) in box.items():
            if name not in self.state_box:
                raise BadInput(
                    f"{shown(name)} is not an axis; the axes are {', '.join(self.states)}", where
                )
            if not a < b:
                raise BadInput(f"[{a!r}, {b!r}] is empty; write [a, b] with a < b", f"{where}.{name}")

    def replaced(self, **changes: Any) -> Problem:
        """Return a copy with some keys changed, validated anew."""
        return Problem(**{**{key: getattr(self, key) for key in Problem.model_fields}, **changes})

    def to_dict(self) -> dict[str, Any]:
        """Return the problem as plain data that ``json.dumps`` accepts, defaults written out."""
        if isinstance(self.system, FunctionSystem):
            raise BadInput(
                "a FunctionSystem cannot be written to a file; use formulas", "system"
            )
        return self.model_dump(mode="json", exclude_none=True)

    def to_json(self) -> str:
        """Return the problem file as text."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the problem file; it appears whole or not at all."""
        write_whole(Path(path), self.to_json().encode())


def load(path: str | os.PathLike[str]) -> Problem:
    """Read a problem file.

    Parameters
    ----------
    path
        A JSON file of at most 16 MiB.

    Raises
    ------
    BadInput
        The file cannot be read, is no strict JSON, or declares no valid problem.
    """
    data = read_json(Path(path))
    for key in ("format", "system", "state_box", "attractor"):
        if isinstance(data, dict) and key not in data:
            raise BadInput("required key is missing; add it", key)
    return parse_problem(data)


def parse_problem(data: Any) -> Problem:
    """Validate plain data (the content of a problem file)."""
    if not isinstance(data, dict):
        raise BadInput(f"a problem file holds one JSON object, not {shown(data)}")
    problem: Problem = Problem.model_validate(data)
    return problem


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the problem file, made from the models themselves."""
    schema = Problem.model_json_schema(schema_generator=_FileSchema)
    systems = schema["properties"]["system"]["oneOf"]
    systems[:] = [kind for kind in systems if not kind["$ref"].endswith("/FunctionSystem")]
    del schema["$defs"]["FunctionSystem"]
    for model in schema["$defs"].values():
        if "kind" in model.get("properties", {}):
            model["required"] = ["kind", *model.get("required", [])]
    schema["required"] = ["format", *schema["required"]]
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "lmdsl problem file"
    return schema


class _FileSchema(GenerateJsonSchema):
    """The schema of what a file may hold: no null, no Python function."""

    def nullable_schema(self, schema: Any) -> Any:
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: Any) -> Any:
        generated = super().default_schema(schema)
        if generated.get("default", 0) is None:
            del generated["default"]
        return generated

    def callable_schema(self, schema: Any) -> Any:
        return {}

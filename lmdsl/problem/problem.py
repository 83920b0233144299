"""What the user writes: the problem file as one strict, frozen model, and its reader.

Reading never runs code, opens no other file, and costs time and memory in proportion to the
file (at most 16 MiB). Geometry is resolved later, in partition.py.
"""

import json
import os
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from lmdsl.common import inputs
from lmdsl.common.files import read_json, write_whole
from lmdsl.common.strict_model import Declared, FileSchema, Positive
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.language import Formula, parse
from lmdsl.formulas.names import FormulaText
from lmdsl.problem.axes import StateBox
from lmdsl.problem.controls import ControlGrid
from lmdsl.problem.local_control import ConstantControl, LinearFeedback, LocalUnion, LqrFeedback
from lmdsl.problem.noise import Noise
from lmdsl.problem.sampling import SamplingUnion
from lmdsl.problem.sets import Attractor, Avoid, Measure
from lmdsl.problem.unions import SystemUnion
from lmdsl.systems import FunctionSystem, System
from lmdsl.systems.base import StateMap


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
    local_controller
        Feedback on the attractor cells, where the controller of the LP says nothing.
    noise, avoid, measure, on_exit, name
        Optional; see the problem format in the documentation.

    Raises
    ------
    BadInput
        With the path of the field, the value and the fix.
    """

    format: Literal["lmdsl/1"] = "lmdsl/1"
    name: Annotated[str, Field(max_length=1000)] = ""
    system: SystemUnion
    state_box: StateBox
    attractor: Attractor
    avoid: Avoid | None = None
    control_grid: ControlGrid
    noise: Noise | None = None
    stage_cost: FormulaText
    sampling: SamplingUnion
    gamma: Positive = 1.0
    on_exit: Literal["forbid", "clip"] = "forbid"
    measure: Measure | None = None
    local_controller: LocalUnion | None = None

    @model_validator(mode="before")
    @classmethod
    def _without_schema(cls, data: Any) -> Any:
        """Drop the key by which editors find the JSON Schema of a file."""
        if not isinstance(data, dict) or "$schema" not in data:
            return data
        if not isinstance(data["$schema"], str):
            raise BadInput(f"{shown(data['$schema'])} is not accepted; write a string", "$schema")
        return {key: value for key, value in data.items() if key != "$schema"}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        self._unique_names()
        self._axes_named()
        self._local_named()
        self.step()
        self.cost()
        self.density()
        return self

    @classmethod
    def model_json_schema(cls, *args: Any, **options: Any) -> dict[str, Any]:
        """Return the JSON Schema of a problem file; see pydantic for the options."""
        if len(args) < 3:  # the third is the generator
            options = {"schema_generator": FileSchema, **options}
        return super().model_json_schema(*args, **options)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Allow the key that editors need, which no problem keeps."""
        schema = super().__get_pydantic_json_schema__(core, handler)
        handler.resolve_ref_schema(schema)["properties"]["$schema"] = {"type": "string"}
        return schema

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

    def step(self) -> StateMap:
        """Return the map of the system, from named arrays to images."""
        system: System = self.system
        return system.compile(self.states, self.controls, self.noises)

    def cost(self) -> Formula:
        """Return the parsed stage cost."""
        names = {*self.states, *self.controls, *self.noises, *self.system.constants()}
        try:
            return parse(self.stage_cost, names)
        except BadInput as error:
            raise BadInput(error.message, "stage_cost") from None

    def density(self) -> Formula | None:
        """Return the parsed density of the weight m, None where there is none."""
        if self.measure is None or self.measure.density is None:
            return None
        try:
            return parse(self.measure.density, {*self.states, *self.system.constants()})
        except BadInput as error:
            raise BadInput(error.message, "measure.density") from None

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
        self._points_named(self.attractor.points, "attractor.points")
        for i, cell in enumerate(self.attractor.cells):
            if len(cell) != len(self.states):
                raise BadInput(
                    f"{len(cell)} indices for {len(self.states)} axes", f"attractor.cells[{i}]"
                )
        for where in ("attractor", "avoid", "measure"):
            part = getattr(self, where)
            for i, box in enumerate((part.boxes or ()) if part else ()):
                self._box_named(box, f"{where}.boxes[{i}]")

    def _points_named(self, points: Any, where: str) -> None:
        for i, point in enumerate(points):
            if isinstance(point, dict) and set(point) != set(self.states):
                raise BadInput(
                    f"a point names every axis once: {', '.join(self.states)}", f"{where}[{i}]"
                )
            if len(point) != len(self.states):
                raise BadInput(
                    f"{len(point)} coordinates for {len(self.states)} axes", f"{where}[{i}]"
                )

    def _local_named(self) -> None:
        local, top = self.local_controller, "local_controller"
        if local is None:
            return
        orbit = () if isinstance(local, ConstantControl) else local.orbit
        self._points_named(orbit, f"{top}.orbit")
        tables: list[tuple[str, Any, Any]] = [("control", local.control, self.controls)]
        if isinstance(local, LqrFeedback):
            tables.append(("state_weights", local.state_weights, self.states))
            tables.append(("control_weights", local.control_weights, self.controls))
        if isinstance(local, LinearFeedback):
            tables.append(("gain", local.gain, self.controls))
            tables += [(f"gain.{u}", row, self.states) for u, row in local.gain.items()]
        for key, table, known in tables:
            for name in table:
                if name not in known:
                    choice = f"one of {', '.join(known)}" if known else "nothing: there is none"
                    raise BadInput(f"{shown(name)} is unknown; write {choice}", f"{top}.{key}")
        along = {"control": local.control}
        if isinstance(local, LinearFeedback):
            along |= {f"gain.{u}": row for u, row in local.gain.items()}
        for key, table in along.items():
            for name, values in table.items():
                if isinstance(values, tuple) and len(values) != len(orbit):
                    raise BadInput(
                        f"{len(values)} values for {len(orbit)} orbit points; give one each",
                        f"{top}.{key}.{name}",
                    )

    def _box_named(self, box: Mapping[str, tuple[float, float]], where: str) -> None:
        for name, (a, b) in box.items():
            if name not in self.state_box:
                raise BadInput(
                    f"{shown(name)} is not an axis; the axes are {', '.join(self.states)}", where
                )
            if not a < b:
                raise BadInput(
                    f"[{a!r}, {b!r}] is empty; write [a, b] with a < b", f"{where}.{name}"
                )

    def __eq__(self, other: object) -> bool:
        """Compare all keys, and the order of axes and controls: it numbers cells and vectors."""
        if not isinstance(other, Problem):
            return NotImplemented
        order = (self.states, self.controls) == (other.states, other.controls)
        return order and super().__eq__(other)

    def __hash__(self) -> int:
        return super().__hash__()

    def to_dict(self) -> dict[str, Any]:
        """Return the problem as plain data that ``json.dumps`` accepts, defaults written out."""
        if isinstance(self.system, FunctionSystem):
            raise BadInput("a FunctionSystem cannot be written to a file; use formulas", "system")
        data = self.model_dump(mode="json", exclude_none=True)
        for key in ("system", "sampling", "local_controller"):
            if key not in data:
                continue
            data[key] = {"kind": data[key]["kind"], **data[key]}  # kind first, for people
        return data

    def to_json(self) -> str:
        """Return the problem file as text."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the problem file; it appears whole or not at all."""
        write_whole(inputs.path(path), self.to_json().encode())


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
    try:
        data = read_json(inputs.path(path))
    except TypeError:
        raise BadInput(f"{shown(path)} is not a path") from None
    return parse_problem(data)


def parse_problem(data: Any) -> Problem:
    """Validate plain data (the content of a problem file)."""
    if not isinstance(data, dict):
        raise BadInput(f"a problem file holds one JSON object, not {shown(data)}")
    if "format" not in data:
        raise BadInput('required key is missing; add "format": "lmdsl/1"', "format")
    problem: Problem = Problem.model_validate(data)
    return problem


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the problem file, made from the models themselves."""
    schema = Problem.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "lmdsl problem file"
    return schema

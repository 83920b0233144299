"""What the user writes: the problem file as one strict, frozen model, and its reader.

Reading never runs code, opens no other file, and costs time and memory in proportion to the file.
Geometry is resolved later, in partition.py.
"""

import json
import os
from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from lmdsl.common import inputs
from lmdsl.common.files import read_json, write_whole
from lmdsl.common.strict_model import Declared, FileSchema, Fractional, Positive
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.language import Formula, defined
from lmdsl.formulas.names import FormulaText, Let
from lmdsl.formulas.program import Program
from lmdsl.problem.axes import StateBox
from lmdsl.problem.consistency import endings, texts
from lmdsl.problem.consistency.keys import PLACES, require_consistent, require_writable
from lmdsl.problem.controls import ControlGrid
from lmdsl.problem.local_control import LocalUnion
from lmdsl.problem.noise import Noise
from lmdsl.problem.sampling import SamplingUnion
from lmdsl.problem.sets import REACHED_OR_ENDED, Attractor, Avoid, Measure
from lmdsl.problem.unions import SystemUnion
from lmdsl.problem.whole import words
from lmdsl.systems import FunctionSystem
from lmdsl.systems.base import Names, StateMap
from lmdsl.systems.black_box.cost import StageCost, cost_map
from lmdsl.systems.runge_kutta import RungeKutta


class Problem(Declared):
    """A stabilization problem: the models behind the problem file, with the same names.

    Attributes
    ----------
    system
        x+ = T(x, u, w).
    let
        Named subexpressions, in order, for the formulas and conditions below and in the system.
    state_box
        Axes in order; the cells are their C-order product.
    attractor
        The set A to reach.
    control_grid
        Control variables; the control vectors are the C-order product of their values.
    admissible
        Condition in states and controls without which a pair is inadmissible.
    stage_cost
        Formula G(x, u, w), finite and >= 0; or a Python function, called as a function system is,
        with those of the variables and parameters that it names.
    cost_rate
        Instead, for a differential equation: a formula whose integral along the step is the cost.
    terminal_cost
        Formula in the states, paid on entering A.
    sampling
        Sample points within a cell for Ulam's method.
    successors
        ``sampled`` (default), or ``enclosed``: a pair survives by all that its whole cell can meet.
    gamma
        Geometric weight of the cost, sum of gamma^n G(x_n, u_n).
    discount
        b in (0, 1): after each step, once its cost is paid, the run ends with probability 1 - b.
    local_controller
        Feedback on the attractor cells, where the controller of the LP says nothing.
    noise, avoid, measure, on_exit, name
        Optional; see the problem format in the documentation.

    Raises
    ------
    BadInput
        With the path of the field, the value and the fix.
    """

    elsewhere: ClassVar[Mapping[str, str]] = PLACES
    format: Literal["lmdsl/1"] = "lmdsl/1"
    name: Annotated[str, Field(max_length=1000)] = ""
    system: SystemUnion
    let: Let | None = None
    state_box: StateBox
    attractor: Attractor
    avoid: Avoid | None = None
    control_grid: ControlGrid
    admissible: FormulaText | None = None
    noise: Noise | None = None
    stage_cost: StageCost | None = None
    cost_rate: FormulaText | None = None
    terminal_cost: FormulaText | None = None
    sampling: SamplingUnion
    successors: Literal["sampled", "enclosed"] | None = None
    gamma: Positive = 1.0
    discount: Fractional | None = None
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
        require_consistent(self)
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
        whole = handler.resolve_ref_schema(schema)
        whole["properties"]["$schema"] = {"type": "string"}
        whole["oneOf"] = [{"required": [key]} for key in ("stage_cost", "cost_rate")]
        whole["allOf"] = [REACHED_OR_ENDED]
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

    @property
    def ends_in_time(self) -> bool:
        """Whether gamma times the discount is below 1, so that all costs are finite."""
        return self.discount is not None and endings.rate(self) < 1

    def step(self) -> StateMap:
        """Return the map of the system, from named arrays to images."""
        return self.system.compile(self.names())

    def formula(
        self, text: str, where: str, kinds: Collection[str] = texts.ALL, condition: bool = False
    ) -> Formula:
        """Return a formula or condition of this problem, parsed.

        Parameters
        ----------
        text
            What the user wrote.
        where
            The path of its field.
        kinds
            Of what names may stand in it beside parameters and constants, and by which ``let``.
        condition
            Whether it is a condition.

        Raises
        ------
        BadInput
            It is no formula of these names.
        """
        named = {"state": self.states, "control": self.controls, "noise": self.noises}
        definitions = self.names().definitions  # whose faults are not of this field
        known = texts.Declarations(named, self.system.constants(), definitions)
        return texts.parsed(texts.Text(where, text, kinds, condition), known)

    @classmethod
    def _also_wrong(cls, data: Any) -> list[BadInput]:
        """Return what is wrong with the formulas."""
        return texts.faults(data, cls.model_fields)

    def names(self) -> Names:
        """Return what the system may name, with what ``let`` defines by it, parsed."""
        names = Names(self.states, self.controls, self.noises)
        known = (*names.valued, *self.system.constants())
        try:
            return names._replace(definitions=defined(tuple((self.let or {}).items()), known))
        except BadInput as error:
            raise BadInput(error.message, f"let.{error.where}") from None

    def program(self, *formulas: Formula) -> Program:
        """Return the function from named arrays to the values of formulas of this problem."""
        return Program(formulas, self.system.constants())

    @property
    def judged(self) -> str:  # a Literal type ends what completes names in notebooks
        """Whether ``path`` or ``endpoint`` of a step is judged; a map has no path."""
        return str(getattr(self.system, "judged", "endpoint"))

    def flow(self, cost: bool = True) -> RungeKutta | None:
        """Return how the equation, and with it the cost rate, is integrated; None for a map."""
        rate = self.cost() if cost and self.cost_rate is not None else None
        return self.system.flow(self.names(), rate)

    @property
    def functions(self) -> tuple[str, ...]:
        """The keys that are Python functions, which no file holds."""
        own = ("system",) * isinstance(self.system, FunctionSystem)
        return own + ("stage_cost",) * callable(self.stage_cost)

    def cost(self) -> Formula:
        """Return the parsed stage cost, or cost rate; a Python function is none."""
        if self.cost_rate is not None:
            return self.formula(self.cost_rate, "cost_rate")
        if callable(self.stage_cost):
            raise BadInput("a Python function is no formula, which is needed here", "stage_cost")
        return self.formula(str(self.stage_cost), "stage_cost")

    def stage(self) -> StateMap | None:
        """Return the stage cost of named arrays; None where a cost rate stands for it."""
        if callable(self.stage_cost):
            return cost_map(self.stage_cost, self)
        return None if self.cost_rate else self.program(self.cost())

    def terminal(self) -> Program | None:
        """Return the terminal cost of named arrays, None where there is none."""
        return self._given(self.terminal_cost, "terminal_cost", texts.STATES)

    def density(self) -> Program | None:
        """Return the density of the weight m of named arrays, None where there is none."""
        text = None if self.measure is None else self.measure.density
        return self._given(text, "measure.density", texts.STATES)

    def admitted(self) -> Program | None:
        """Return the condition of admissible pairs on named arrays, None where there is none."""
        return self._given(self.admissible, "admissible", texts.PAIRS, True)

    def _given(self, text: str | None, *how: Any) -> Program | None:
        return None if text is None else self.program(self.formula(text, *how))

    def conditions(self, where: str) -> tuple[Formula, ...]:
        """Return the conditions of ``attractor``, ``avoid`` or ``measure``."""
        written = getattr(getattr(self, where), "where", None) or ()
        if isinstance(written, str):
            return (self.formula(written, f"{where}.where", texts.STATES, condition=True),)
        return tuple(
            self.formula(text, f"{where}.where[{i}]", texts.STATES, condition=True)
            for i, text in enumerate(written)
        )

    def replaced(self, **changes: Any) -> Self:
        """Return a copy with some keys changed, validated anew."""
        changed = super().replaced(**changes)
        endings.require_same_data(self, changed)
        return changed

    def __eq__(self, other: object) -> bool:
        """Compare all keys, and the order of axes and controls: it numbers cells and vectors."""
        if not isinstance(other, Problem):
            return NotImplemented
        order = (self.states, self.controls) == (other.states, other.controls)
        return order and super().__eq__(other)

    __hash__ = Declared.__hash__
    _repr_html_ = words.html

    def to_dict(self) -> dict[str, Any]:
        """Return the problem as plain data that ``json.dumps`` accepts, defaults written out."""
        require_writable(self)
        data = self.model_dump(mode="json", exclude_none=True)
        for key in {"system", "sampling", "local_controller"} & data.keys():
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

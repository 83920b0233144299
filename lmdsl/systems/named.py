"""Systems with a name: formulas written once, parameters to choose."""

import re
from collections.abc import Mapping
from typing import Any, ClassVar, Self

from pydantic import model_validator

from lmdsl.common import spelling
from lmdsl.common.strict_model import Positive
from lmdsl.errors import BadInput, shown
from lmdsl.formulas.language import NO_DEFINITIONS, Formula
from lmdsl.formulas.operations import FORMULA_CONSTANTS, FORMULA_FUNCTIONS
from lmdsl.systems.base import (
    NO_TIME,
    OF_TIME,
    Judged,
    MapSystem,
    Names,
    OdeSystem,
    StateMap,
    Substeps,
    System,
)
from lmdsl.systems.runge_kutta import RungeKutta


class NamedSystem(System):
    """A system known by name: its formulas are fixed, its parameters have defaults.

    A subclass sets ``defaults`` (parameter values), ``source`` (a citation), ``summary`` (one
    line) and ``problem`` (the problem file that ``lmdsl init NAME`` writes, without ``format`` and
    ``system``, which the other values say).
    """

    elsewhere: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("next", "derivative"),
        "the formulas of a system known by name are fixed; leave it out, or write kind map or ode",
    )
    kind: str
    defaults: ClassVar[Mapping[str, float]] = {}
    source: ClassVar[str] = ""
    summary: ClassVar[str] = ""
    problem: ClassVar[Mapping[str, Any]] = {}
    formulas: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        if cls.problem:
            fields = cls.model_fields.items()
            own = {key: field.default for key, field in fields if key != "judged"}
            if "substeps" in own:
                own["substeps"] = "auto"
            system = {**own, "parameters": dict(cls.defaults)}
            cls.problem = {"format": "lmdsl/1", "system": system, **cls.problem}

    @model_validator(mode="after")
    def _known_parameters(self) -> Self:
        for name in self.parameters:
            if name not in self.defaults:
                known = ", ".join(self.defaults) or "none"
                near = spelling.hint(name, self.defaults) or ";"
                raise BadInput(
                    f"{shown(name)} is not a parameter of {self.kind}{near} its parameters: "
                    f"{known}",
                    "parameters",
                )
        return self

    def constants(self) -> Mapping[str, float]:
        """Return the values of all parameters, defaults included."""
        return {**self.defaults, **self.parameters}

    @classmethod
    def controls(cls) -> tuple[str, ...]:
        """Return the names of the controls in the formulas, sorted."""
        found = set(re.findall(r"[A-Za-z_]\w*", " ".join(cls.formulas.values())))
        known = {*FORMULA_FUNCTIONS, *FORMULA_CONSTANTS, *cls.defaults, *cls.formulas}
        return tuple(sorted(found - known))

    def definition(self) -> MapSystem | OdeSystem:
        """Return the same system with its formulas written out."""
        raise NotImplementedError

    def compile(self, names: Names) -> StateMap:
        """See :meth:`System.compile`."""
        if set(names.states) != set(self.formulas):
            raise BadInput(
                f"{self.kind} has the states {', '.join(self.formulas)}; declare these axes",
                "state_box",
            )
        for control in self.controls():
            if control not in names.controls and control not in names.noise:
                raise BadInput(
                    f"{self.kind} has the control {control}; declare it, for example "
                    f'"{control}": {{"values": [0]}}',
                    "control_grid",
                )
        return self.definition().compile(names._replace(definitions=NO_DEFINITIONS))


class NamedMap(NamedSystem):
    """A named discrete-time map; a subclass sets ``formulas``."""

    elsewhere: ClassVar[Mapping[str, str]] = {
        **NamedSystem.elsewhere,
        **dict.fromkeys(OF_TIME, NO_TIME),
    }

    def definition(self) -> MapSystem:
        """See :meth:`NamedSystem.definition`."""
        return MapSystem(parameters=dict(self.constants()), next=dict(self.formulas))


class NamedOde(NamedSystem):
    """A named differential equation; a subclass sets ``formulas`` and defaults for the step.

    Attributes
    ----------
    step
        Sampling time in seconds (or in the time unit of the equations).
    substeps
        RK4 steps per sampling time, or ``auto``.
    judged
        See :class:`lmdsl.systems.OdeSystem`.
    """

    step: Positive = 0.1
    substeps: Substeps = 1
    judged: Judged = "path"

    def definition(self) -> OdeSystem:
        """See :meth:`NamedSystem.definition`."""
        return OdeSystem(
            parameters=dict(self.constants()),
            derivative=dict(self.formulas),
            step=self.step,
            substeps=self.substeps,
            judged=self.judged,
        )

    def flow(self, names: Names, integrand: Formula | None = None) -> RungeKutta:
        """See :meth:`System.flow`."""
        return self.definition().flow(names._replace(definitions=NO_DEFINITIONS), integrand)


class NotStored(BadInput):
    """A Python function was called of which only a saved result is at hand."""

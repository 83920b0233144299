"""The stage cost: a formula; in Python also a function, or an expression of another tool."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import WrapSerializer, WrapValidator

from lmdsl.errors import BadInput
from lmdsl.formulas.names import FormulaText
from lmdsl.systems.base import System
from lmdsl.systems.black_box.function_map import FunctionMap, parameters_of
from lmdsl.systems.black_box.returned import Returned
from lmdsl.systems.black_box.scalar_map import ScalarMap
from lmdsl.systems.function import FunctionSystem
from lmdsl.systems.translated import casadi_systems, sympy_systems
from lmdsl.systems.translated.systems import comes_from
from lmdsl.systems.translated.terms import Untranslatable

# What a result directory says in place of a function.
FUNCTION: Final = {"kind": "function"}


def _read(value: Any, formula: Callable[[Any], Any]) -> Any:
    for package, tool in (("sympy", sympy_systems), ("casadi", casadi_systems)):
        if comes_from(package, value):  # it may be callable, but not with arrays by name
            try:
                return formula(tool.text(value))
            except Untranslatable as why:
                raise BadInput(
                    f"formulas have no place for {why}; write the cost as a Python function"
                ) from None
    return value if callable(value) else formula(value)


def _write(value: Any, formula: Callable[[Any], Any]) -> Any:
    return dict(FUNCTION) if callable(value) else formula(value)


if TYPE_CHECKING:
    StageCost = str | Callable[..., Any]
else:
    StageCost = Annotated[FormulaText, WrapValidator(_read), WrapSerializer(_write)]


def cost_map(function: Callable[..., Any], problem: Any) -> FunctionMap:
    """Return the cost function of a problem as a map; it is called as the system is.

    Raises
    ------
    BadInput
        It takes an argument that is no state, control, noise variable or parameter.
    """
    system: System = problem.system
    names = (*problem.states, *problem.controls, *problem.noises)
    parameters: Mapping[str, float] = system.constants()
    taken = parameters_of(function, (*names, *parameters), "stage_cost")
    results = Returned(("stage_cost",), "stage_cost", single=True)
    scalar = isinstance(system, FunctionSystem) and not system.vectorized
    made = ScalarMap if scalar else FunctionMap
    return made(function, results, parameters, taken)

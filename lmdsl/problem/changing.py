"""Changed copies of a problem: other parameters of its system."""

from collections.abc import Mapping
from typing import Any

from lmdsl.common import inputs, spelling
from lmdsl.errors import BadInput, shown
from lmdsl.problem.problem import Problem


def with_parameters(problem: Problem, parameters: Any) -> Problem:
    """Return a problem with other values of some of its parameters.

    BadInput: a name is no parameter of the system, or a value is no finite number.
    """
    inputs.kind(parameters, Mapping, "parameters", 'no values by name; write {"name": value}')
    system, known = problem.system, problem.system.constants()
    for name, value in parameters.items():
        where = f"parameters.{name}" if isinstance(name, str) else "parameters"
        if name not in known:
            near = spelling.hint(name, known) or ";"
            which = f"its parameters: {', '.join(known)}" if known else "it has none"
            raise BadInput(f"{shown(name)} is not a parameter of the system{near} {which}", where)
        if not inputs.is_number(value) or not -1e300 < value < 1e300:
            raise BadInput(f"{shown(value)} is not a finite number", where)
    changed = {**system.parameters, **{name: float(x) for name, x in parameters.items()}}
    return problem.replaced(system=system.replaced(parameters=changed))

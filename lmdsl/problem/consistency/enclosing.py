"""Whether what is to be enclosed can be: formulas, bounded noise, constants of a function."""

from typing import TYPE_CHECKING

from lmdsl.errors import BadInput
from lmdsl.problem.noise import NoiseNormal, NoiseValues
from lmdsl.systems import FunctionSystem, MatrixSystem

if TYPE_CHECKING:
    from lmdsl.problem.problem import Problem


def require_enclosable(problem: "Problem") -> None:
    """Refuse enclosed successors of what cannot be enclosed."""
    if problem.successors != "enclosed":
        return
    if isinstance(problem.system, FunctionSystem):
        _require_promised(problem.system, problem)
    elif isinstance(problem.system, MatrixSystem):
        raise BadInput(
            f"a system of kind {problem.system.kind!r} has no formulas to enclose; leave this key "
            "out",
            "successors",
        )
    for name, noise in (problem.noise or {}).items():
        if isinstance(noise, NoiseNormal) and noise.normal.within is None:
            raise BadInput(
                "normal noise has no bound that successors could be enclosed for; say how many "
                'standard deviations they cover, for example "within": 4',
                f"noise.{name}.normal",
            )


def _require_promised(system: FunctionSystem, problem: "Problem") -> None:
    if system.lipschitz is None:
        raise BadInput(
            "a system of kind 'function' has no formulas to enclose; write its formulas, promise "
            "its Lipschitz constants (lipschitz=, which is then assumed), or leave this key out",
            "successors",
        )
    for name, noise in (problem.noise or {}).items():
        if not isinstance(noise, NoiseValues) and len(system.lipschitz[0]) <= len(problem.states):
            raise BadInput(
                f"the constants are those of the states, and {name!r} varies over ranges; add a "
                "number for every noise variable to every row",
                "system.lipschitz",
            )


def require_constants(problem: "Problem") -> None:
    """Refuse Lipschitz constants of other numbers of states and noise variables."""
    system = problem.system
    if not isinstance(system, FunctionSystem) or system.lipschitz is None:
        return
    states, noise = problem.states, problem.noises
    if len(system.lipschitz) != len(states):
        raise BadInput(
            f"{len(system.lipschitz)} rows; write one for each of {', '.join(states)}",
            "system.lipschitz",
        )
    fits = {len(states), len(states) + len(noise)}
    for i, row in enumerate(system.lipschitz):
        if len(row) not in fits or len(row) != len(system.lipschitz[0]):
            raise BadInput(
                f"{len(row)} numbers; write one for each of {', '.join((*states, *noise))}, as "
                "many in every row",
                f"system.lipschitz[{i}]",
            )

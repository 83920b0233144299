"""Changed copies of a problem: other parameters of its system, another gamma, step, samples."""

import math
from collections.abc import Mapping
from typing import Any

from lmdsl.common import inputs, spelling
from lmdsl.errors import BadInput, shown
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem

MOST_SUBSTEPS = 1_000  # number above which no problem may have more


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


def gamma_alone(problem: Problem, changed: Problem) -> str:
    """Return what of the compiled model changes with gamma beside it; empty where nothing does."""
    if problem.terminal_cost is not None:
        return "the terminal cost is paid times gamma"
    if isinstance(problem.system, MatrixSystem) and problem.system.best_reward is not None:
        return "what a reward misses depends on gamma"
    if problem.ends_in_time != changed.ends_in_time:
        return "gamma times the discount goes through 1, and with it what can be stabilized"
    return ""


def with_gamma_alone(problem: Problem, gamma: float) -> Problem:
    """Return a problem with another gamma and the same finite model; BadInput where it differs."""
    changed = problem.replaced(gamma=gamma)
    why = gamma_alone(problem, changed)
    if why:
        raise BadInput(f"{why}: compile the problem again, problem.replaced(gamma=...)", "gamma")
    return changed


def with_samples(problem: Problem, count: int) -> Problem:
    """Return a problem with other samples: so many an axis of a grid, else so many a cell."""
    key = "per_axis" if problem.sampling.kind == "grid" else "points"
    return problem.replaced(sampling=problem.sampling.replaced(**{key: count}))


def with_step(problem: Problem, step: float) -> Problem:
    """Return a problem with another sampling time, integrated as finely; BadInput of a map."""
    system: Any = problem.system
    if not hasattr(system, "step"):
        raise BadInput("a map has no step; leave it out", "step")
    changes: dict[str, Any] = {"step": step}
    if isinstance(system.substeps, int):
        as_fine = math.ceil(min(system.substeps * step / system.step, 1e6) - 1e-9)
        changes["substeps"] = min(max(as_fine, 1), MOST_SUBSTEPS)
    return problem.replaced(system=system.replaced(**changes))

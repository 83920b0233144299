"""Systems, controllers and closed loops for python-control.

A sampled system makes one step of the problem a step, of ``dt`` the sampling time, or without unit
(``dt=True``) for a map. Noise variables are inputs, behind the controls; they are 0 unless given.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.optional import needed
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.problem.problem import Problem
from lmdsl.results.result import Result
from lmdsl.systems import MatrixSystem

RightHandSide = Callable[[Mapping[str, Any]], tuple[Floats, ...]]


def control_system(problem: Problem, *, sampled: bool = False) -> Any:
    """Return the system of a problem as a NonlinearIOSystem of python-control.

    Parameters
    ----------
    problem
        Its system, but for finite models.
    sampled
        Of a differential equation: the compiled step instead of the equation.

    Returns
    -------
    control.NonlinearIOSystem
        Inputs are the controls, then the noise; outputs are the states, neither wrapped nor
        clipped; its parameters are those of the system and can be changed when it is simulated.

    Raises
    ------
    BadInput
        The problem is a finite model, or python-control is not installed.
    """
    control = needed("control", "control_system", "control")
    inputs.kind(problem, Problem, "problem", "a Problem")
    _require_states(problem)
    flow = problem.flow(cost=False)
    continuous = flow is not None and not inputs.flag(sampled, "sampled")
    step = Parametrised(problem, continuous)
    return control.nlsys(
        step,
        lambda t, x, u, params: x,
        inputs=[*problem.controls, *problem.noises],
        outputs=list(problem.states),
        states=[*problem.states],
        params=dict(problem.system.constants()),
        dt=0 if continuous else sampling_time(problem),
        name=_name(problem, "system"),
    )


def controller_system(result: Result, otherwise: ArrayLike | None = None) -> Any:
    """Return the controller as a NonlinearIOSystem without states: from states to controls.

    Parameters
    ----------
    result
        An answer with a controller.
    otherwise
        The control where it says nothing, shape (p,); by default NaN, which python-control takes
        for an algebraic loop where systems are joined.

    Returns
    -------
    control.NonlinearIOSystem
        With the sampling time of the problem.
    """
    control = needed("control", "controller_system", "control")
    _require_controller(result)
    problem, fill = result.problem, np.full(len(result.problem.controls), np.nan)
    if otherwise is not None:
        fill = inputs.real(otherwise, "otherwise").reshape(-1)
        if len(fill) != len(problem.controls):
            wanted = f"({len(problem.controls)},)"
            raise BadInput(f"a control has shape {wanted}, not {fill.shape}", "otherwise")

    def law(t: float, x: Floats, u: Floats, params: Mapping[str, float]) -> Floats:
        found = result.controller(np.ravel(u))
        return np.where(np.isnan(found), fill, found)

    return control.nlsys(
        None,
        law,
        inputs=list(problem.states),
        outputs=[*problem.controls],
        dt=sampling_time(problem),
        name=_name(problem, "controller"),
    )


def closed_loop_system(result: Result) -> Any:
    """Return the closed loop as a NonlinearIOSystem: compiled steps under the controller.

    Parameters
    ----------
    result
        An answer with a controller.

    Returns
    -------
    control.NonlinearIOSystem
        Inputs are the noise variables, outputs the states and then the controls. States are
        wrapped and clipped as the problem says; NaN from where the controller says nothing on.
    """
    control = needed("control", "closed_loop_system", "control")
    _require_controller(result)
    problem, step = result.problem, Parametrised(result.problem, False)

    def update(t: float, x: Floats, w: Floats, params: Mapping[str, float]) -> Floats:
        u = result.controller(np.ravel(x))
        after = step(t, x, np.concatenate([u, np.ravel(w)]), params)
        wrapped: Floats = result.partition.states(after[None, :])[0]
        return wrapped

    return control.nlsys(
        update,
        lambda t, x, w, params: np.concatenate([np.ravel(x), result.controller(np.ravel(x))]),
        inputs=[*problem.noises],
        outputs=[*problem.states, *problem.controls],
        states=list(problem.states),
        params=dict(problem.system.constants()),
        dt=sampling_time(problem),
        name=_name(problem, "closed_loop"),
    )


class Parametrised:
    """The right-hand side of a system for given parameters: made once for each set of them."""

    def __init__(self, problem: Problem, continuous: bool) -> None:
        self.problem, self.continuous = problem, continuous
        self.names = (*problem.states, *problem.controls, *problem.noises)
        self.made: dict[tuple[tuple[str, float], ...], RightHandSide] = {}

    def __call__(self, t: float, x: Floats, u: Floats, params: Mapping[str, float]) -> Floats:
        """Return next states, or derivatives, shape (d,)."""
        numbers = np.concatenate([np.ravel(x), np.ravel(u)])
        values = dict(zip(self.names, np.atleast_2d(numbers).T, strict=True))
        return np.array([np.broadcast_to(y, 1)[0] for y in self._step(params)(values)])

    def _step(self, params: Mapping[str, float]) -> RightHandSide:
        own = self.problem.system.constants()
        key = tuple((name, float(params.get(name, own[name]))) for name in own)
        if key not in self.made:
            problem = self.problem
            if dict(key) != dict(own):
                system = problem.system.replaced(parameters=dict(key))
                problem = problem.replaced(system=system)
            flow = problem.flow(cost=False) if self.continuous else None
            self.made[key] = problem.step() if flow is None else flow.field
        return self.made[key]


def sampling_time(problem: Problem) -> float | bool:
    """Return the time of a step; True for a map, which has none."""
    step = getattr(problem.system, "step", None)
    return True if step is None else float(step)


def _require_states(problem: Problem) -> None:
    if isinstance(problem.system, MatrixSystem):
        raise BadInput("a finite model has no states between its cells", "system")


def _require_controller(result: Any) -> None:
    inputs.kind(result, Result, "result", "a Result")
    _require_states(result.problem)
    if (result.control_index < 0).all():
        raise BadInput("there is no controller: " + result.message)


def _name(problem: Problem, part: str) -> str:
    words = "".join(c if c.isalnum() else "_" for c in problem.name).strip("_")
    return f"{words}_{part}" if words else part

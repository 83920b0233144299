"""Linearisations and feedback gains, to and from python-control."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lmdsl.common import inputs
from lmdsl.common.optional import needed
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput
from lmdsl.interop.python_control import sampling_time
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import linearisation
from lmdsl.model.true_map import TrueMap
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem


def state_space(problem: Problem, state: ArrayLike, control: ArrayLike | None = None) -> Any:
    """Return the step of a problem, linearised at a fixed point, as a StateSpace of python-control.

    Parameters
    ----------
    problem
        Its system, but for finite models; noise is at its mean. Of ``auto`` substeps, which solving
        settles, there are 16 here; take ``result.problem`` for those that were chosen.
    state
        The fixed point, shape (d,), or by name.
    control
        The control there, shape (p,); 0 by default.

    Returns
    -------
    control.StateSpace
        x' = A x + B u of the deviations, y = x; discrete, with the sampling time of the problem.
        Derivatives are exact up to rounding, of Python functions by differences.

    Raises
    ------
    BadInput
        The point is not fixed, or the system is not differentiable there.
    """
    package = needed("control", "state_space", "control")
    inputs.kind(problem, Problem, "problem", "a Problem")
    if isinstance(problem.system, MatrixSystem):
        raise BadInput("a finite model has no states between its cells", "system")
    partition = Partition.of(problem)
    point, u = _point(problem, state), _control(problem, control)
    reach = np.ones(len(problem.controls))
    A, B = linearisation.along(
        TrueMap(problem, partition), point[None, :], u[None, :], reach, lambda: None
    )
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise BadInput("the system is not differentiable there", "state")
    width = partition.width  # A and B are per unit of cell widths
    A, B = width[:, None] * A[0] / width, width[:, None] * B[0]
    d, p = B.shape
    return package.ss(
        A, B, np.eye(d), np.zeros((d, p)), sampling_time(problem),
        states=list(problem.states), inputs=[*problem.controls], outputs=list(problem.states),
    )  # fmt: skip


def with_gain(
    problem: Problem, gain: ArrayLike, state: ArrayLike, control: ArrayLike | None = None
) -> Problem:
    """Return a problem with linear feedback on its attractor: u = u_0 - K (x - x_0).

    Parameters
    ----------
    problem
        A problem; a local controller that it names is replaced.
    gain
        K, shape (p, d), as ``control.dlqr`` and ``control.lqr`` return it.
    state, control
        x_0 and u_0, as of :func:`state_space`.

    Returns
    -------
    Problem
        With ``local_controller`` of kind ``linear``.
    """
    inputs.kind(problem, Problem, "problem", "a Problem")
    point, u = _point(problem, state), _control(problem, control)
    K = np.atleast_2d(inputs.real(gain, "gain"))
    if K.shape != (len(u), len(point)):
        raise BadInput(f"a gain has shape ({len(u)}, {len(point)}), not {K.shape}", "gain")
    names = problem.controls
    return problem.replaced(
        local_controller={
            "kind": "linear",
            "orbit": [dict(zip(problem.states, map(float, point), strict=True))],
            "control": dict(zip(names, map(float, u), strict=True)),
            "gain": {
                name: dict(zip(problem.states, map(float, row), strict=True))
                for name, row in zip(names, K, strict=True)
            },
        }
    )


def _point(problem: Problem, state: ArrayLike) -> Floats:
    point = inputs.states(state, problem.states, "state")
    if point.ndim != 1:
        raise BadInput(f"one state has shape ({len(problem.states)},), not {point.shape}", "state")
    return point


def _control(problem: Problem, control: ArrayLike | None) -> Floats:
    if control is None:
        return np.zeros(len(problem.controls))
    u = np.atleast_1d(inputs.states(control, problem.controls, "control"))
    if u.ndim != 1:
        wanted = f"({len(problem.controls)},)"
        raise BadInput(f"one control has shape {wanted}, not {u.shape}", "control")
    return u

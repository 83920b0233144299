"""The true map and its cells in plain numbers and texts, so that others can check claim 7."""

from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.formulas.program import Program
from lmdsl.model.discretization import control_vectors, noise_parts
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import sets_of
from lmdsl.problem.local_control import absorbed_on_way
from lmdsl.problem.problem import Problem
from lmdsl.systems.runge_kutta import RungeKutta


def described(lp: StabilizationLP) -> dict[str, Any]:
    """Return what claim 7 speaks of, as JSON: the map, its cells, controls and noise.

    Doubles are in hexadecimal; formulas are the texts that the problem, or its system, declares.
    """
    problem, partition = lp.problem, lp.partition
    sets, parts = sets_of(lp.cell_status), np.stack(noise_parts(problem), axis=-1)
    return {
        "states": problem.states,
        "controls": problem.controls,
        "noise": problem.noises,
        **_dynamics(problem),
        "let": dict(problem.let or {}),
        "parameters": {name: float(x).hex() for name, x in problem.system.constants().items()},
        "admissible": problem.admissible,
        "axes": [
            [axis.low.hex(), axis.high.hex(), int(axis.cells), axis.periodic]
            for axis in partition.axes
        ],
        "clip": partition.clip,
        "attractor": np.flatnonzero(sets.attractor).tolist(),
        "ends_on_path": absorbed_on_way(problem.local_controller),
        "avoid": np.flatnonzero(sets.avoid).tolist(),
        "control_vectors": _hexadecimal(control_vectors(problem)),
        "noise_parts": _hexadecimal(parts),
    }


def _dynamics(problem: Problem) -> dict[str, Any]:
    """Return the formulas of the map, or of its derivative and how that is integrated."""
    step = problem.step()
    ode = None
    if isinstance(step, RungeKutta):
        ode, step = [step.h.hex(), step.substeps, problem.judged == "path"], step.field
    assert isinstance(step, Program)  # nothing else is enclosed
    return {"ode": ode, "formulas": [formula.text for formula in step.formulas]}


def _hexadecimal(numbers: Floats) -> Any:
    """Return nested lists of doubles in hexadecimal."""
    return [_hexadecimal(x) if x.ndim else float(x).hex() for x in numbers]

"""What a name was probably meant to be: the nearest that is known, or what people write for it."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Final

# Characters of a name that are compared.
LONGEST: Final = 100

# Share of equal characters from which two names may be the same (difflib's ratio).
LIKENESS: Final = 0.75


def nearest(name: str, known: Iterable[str], habits: Mapping[str, str] = {}) -> str | None:
    """Return the known name that a name was probably meant to be, if any.

    Parameters
    ----------
    name
        What was written.
    known
        What may be written.
    habits
        What people write, in small letters without ``_``, and what they mean by it.
    """
    folded = {_folded(key): key for key in known}
    written = _folded(name[:LONGEST])
    meant = habits.get(written)
    if meant is not None and meant in folded.values():
        return meant
    found = difflib.get_close_matches(written, folded, 1, LIKENESS)
    return folded[found[0]] if found else None


def hint(name: object, known: Iterable[str], habits: Mapping[str, str] = {}) -> str:
    """Return ``; did you mean 'x'?`` for the end of a message, or nothing; see :func:`nearest`.

    What people mean by a name may also be an expression, such as ``x**y`` for ``pow``.
    """
    if not isinstance(name, str):
        return ""
    near = nearest(name, known, habits)
    if near is not None:
        return f"; did you mean {near!r}?"
    meant = habits.get(_folded(name[:LONGEST]), "")
    return "" if meant.isidentifier() or not meant else f"; write {meant}"


def _folded(name: str) -> str:
    return name.replace("_", "").replace("-", "").lower()


# Keys of problem files as people write them.
KEYS: Final[Mapping[str, str]] = {
    "state": "state_box", "states": "state_box", "box": "state_box", "domain": "state_box",
    "grid": "state_box", "axes": "state_box",
    "control": "control_grid", "controls": "control_grid", "input": "control_grid",
    "inputs": "control_grid", "actions": "control_grid", "action": "control_grid",
    "target": "attractor", "targets": "attractor", "goal": "attractor", "goals": "attractor",
    "obstacle": "avoid", "obstacles": "avoid", "unsafe": "avoid", "constraints": "admissible",
    "dynamics": "system", "cost": "stage_cost", "runningcost": "stage_cost",
    "finalcost": "terminal_cost", "lagrangian": "cost_rate", "samples": "sampling",
    "disturbance": "noise", "disturbances": "noise", "definitions": "let", "weight": "measure",
    "discountfactor": "discount", "dt": "step", "timestep": "step", "h": "step",
    "rhs": "derivative", "f": "derivative", "dot": "derivative", "map": "next",
    "params": "parameters",
    "min": "low", "minimum": "low", "lower": "low", "lb": "low", "from": "low", "max": "high",
    "maximum": "high", "upper": "high", "ub": "high", "to": "high", "n": "cells", "bins": "cells",
    "resolution": "cells", "num": "points", "count": "points", "circular": "periodic",
    "wrap": "periodic", "wraps": "periodic", "angle": "periodic", "sigma": "std",
    "gaussian": "normal", "gauss": "normal", "stddev": "std",
    "probabilities": "weights", "probs": "weights", "condition": "where",
    "if": "where", "set": "where", "type": "kind",
}  # fmt: skip

# Values of ``kind`` as people write them.
KINDS: Final[Mapping[str, str]] = {
    "continuous": "ode", "differentialequation": "ode", "flow": "ode", "vectorfield": "ode",
    "discrete": "map", "difference": "map", "uniform": "grid", "regular": "grid",
    "montecarlo": "random", "mc": "random", "qmc": "sobol", "feedback": "linear",
}  # fmt: skip

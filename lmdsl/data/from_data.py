"""A problem from recorded transitions."""

import os
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.types import Floats
from lmdsl.data.binning import Recording, Wishes, binned
from lmdsl.data.tables import NEXT, read_data
from lmdsl.errors import BadInput, shown
from lmdsl.machine import memory
from lmdsl.model.grid.partition import Partition
from lmdsl.problem.problem import Problem
from lmdsl.problem.sampling import Grid
from lmdsl.systems import DataSystem, FunctionSystem

FURTHEST = 0.5  # a control halfway between two values is no nearer to either


def from_data(
    x: Any,
    u: Any = None,
    x_next: Any = None,
    *,
    state_box: Any,
    control_grid: Any,
    stage_cost: str,
    attractor: Any,
    confidence: float | None = None,
    control_tolerance: float = 1e-6,
    unmatched: Literal["refuse", "drop"] = "refuse",
    min_count: int = 1,
    smoothing: float = 0.0,
    parameters: Mapping[str, float] | None = None,
    **keys: Any,
) -> Problem:
    """Return the problem of recorded transitions: x under u led to x_next.

    Every cell and control that were recorded together are a pair; its row is the counts of the
    cells that followed, over their total, exactly. A pair that was not recorded is inadmissible,
    and so is one that was seen to leave the box.

    Parameters
    ----------
    x
        States, shape (T, d), or what carries names: a mapping from axes to arrays, or a table.
        With ``u`` and ``x_next`` left out: a table, or the path of one (see
        :func:`lmdsl.read_data`), with a column for each state, control, and ``NAME_next``.
    u
        Controls, shape (T, p), or (T,) where there is one control, or with names. None where there
        is none.
    x_next
        States that followed, as ``x``; infinite where the run left.
    state_box, control_grid, stage_cost, attractor
        As in a problem file. The stage cost of a pair is its mean over the recorded states, under
        the control of the grid.
    confidence
        A level below 1, such as 0.95: intervals of all probabilities hold together at this level,
        whatever the data, and with them bounds of the policy's true cost (``result.data``). They
        rest on the assumptions `support` and `independence`.
    control_tolerance
        How far a control may be from a value of the grid, in parts of the least distance between
        two values; 0.5 takes the nearest.
    unmatched
        ``"refuse"`` controls that are further away, or ``"drop"`` their transitions, counted.
    min_count
        Pairs with fewer transitions are inadmissible.
    smoothing
        Added to the count of every recorded successor of a pair; intervals take the counts.
    parameters
        Values of names in ``stage_cost``.
    keys
        Others of a problem file: ``avoid``, ``gamma``, ``discount``, ``measure``, ``on_exit``,
        ``name``.

    Returns
    -------
    Problem
        ``problem.system.counts`` says how often each pair was recorded, ``problem.system.recorded``
        what was dropped. Results are saved with the rows.

    Raises
    ------
    BadInput
        The arrays do not fit each other or the problem, or hold what is no number.

    Examples
    --------
    >>> import lmdsl as lm
    >>> x, u = [[0.1], [0.9], [1.5], [1.7]], [-1, -1, -1, -1]
    >>> problem = lm.from_data(
    ...     x, u, [[0.2], [0.3], [0.6], [0.9]],
    ...     state_box={"x": {"low": 0, "high": 2, "cells": 4}},
    ...     control_grid={"u": {"values": [-1]}},
    ...     stage_cost="1",
    ...     attractor={"boxes": [{"x": [0, 0.5]}]},
    ... )
    >>> lm.solve(problem).value.round(9).tolist()
    [0.0, 1.0, inf, 2.0]
    """
    wishes = _wishes(control_tolerance, unmatched, min_count, smoothing)
    declared = {
        "state_box": state_box, "control_grid": control_grid, "stage_cost": stage_cost,
        "attractor": attractor, **keys,
    }  # fmt: skip
    constants = dict(parameters or {})
    draft = _draft(declared, constants)
    partition = Partition.of(draft)
    given = _transitions(draft, x, u, x_next)
    memory.require(64 * given.x.size + 200 * len(given.x), "recorded transitions")
    rows, recorded = binned(draft, partition, given, wishes)
    system = DataSystem(
        parameters=constants,
        rows=rows,
        recorded=recorded,
        confidence=confidence,
        smoothing=wishes.smoothing,
    )
    return draft.replaced(system=system)


def _wishes(tolerance: Any, unmatched: Any, min_count: Any, smoothing: Any) -> Wishes:
    if not inputs.is_number(tolerance) or not 0 <= tolerance <= FURTHEST:
        raise BadInput(f"{shown(tolerance)} must be between 0 and 0.5", "control_tolerance")
    if unmatched not in ("refuse", "drop"):
        raise BadInput(f'{shown(unmatched)} is not accepted; write "refuse" or "drop"', "unmatched")
    if not inputs.is_number(smoothing) or not 0 <= smoothing < np.inf:
        raise BadInput(f"{shown(smoothing)} must be a number >= 0", "smoothing")
    return Wishes(
        float(tolerance), unmatched == "drop", inputs.whole(min_count, "min_count"),
        float(smoothing),
    )  # fmt: skip


def _draft(declared: dict[str, Any], parameters: dict[str, float]) -> Problem:
    """Return the problem without its rows, so that all that is declared is checked first."""
    for key in ("sampling", "system", "noise", "local_controller"):
        if key in declared:
            raise BadInput("recorded data have none; leave it out", key)
    stand_in = FunctionSystem(next=_unknown, parameters=parameters)
    return Problem(**declared, system=stand_in, sampling=Grid(per_axis=1))


def _unknown(**values: Any) -> Any:
    raise BadInput("of the map nothing is known but the recorded data")


def _transitions(problem: Problem, x: Any, u: Any, x_next: Any) -> Recording:
    """Return transitions as arrays, shapes and numbers checked."""
    states, controls = problem.states, problem.controls
    if isinstance(x, str | os.PathLike):
        x = read_data(x)
        _nothing_beside(u, x_next)
    if x_next is None:
        _nothing_beside(u, x_next)
        after = tuple(name + NEXT for name in states)
        parts = [_named(x, names) if names else None for names in (states, controls, after)]
    else:
        if u is None and controls:
            raise BadInput(f"give the controls {', '.join(controls)}", "u")
        parts = [
            _array(x, states, "x"),
            _array(u, controls, "u") if controls else None,
            _array(x_next, states, "x_next"),
        ]
    T = 0 if parts[0] is None else len(parts[0])
    if not T:
        raise BadInput("no transition is given; record at least one", "x")
    whole = [np.zeros((T, 0)) if part is None else part for part in parts]
    for part, name in zip(whole, ("x", "u", "x_next"), strict=True):
        if len(part) != T:
            raise BadInput(f"{len(part)} rows, where x has {T}; give one for each", name)
        wrong = np.isnan(part) if name == "x_next" else ~np.isfinite(part)
        if wrong.any():
            row, k = (int(i) for i in np.argwhere(wrong)[0])
            fix = ", or write inf where the run left the box" if name == "x_next" else ""
            raise BadInput(
                f"transition {row} holds {float(part[row, k])!r}; leave such transitions out{fix}",
                name,
            )
    return Recording(*whole)


def _nothing_beside(u: Any, x_next: Any) -> None:
    if u is not None or x_next is not None:
        raise BadInput("a table holds the controls and what followed: leave u and x_next out", "x")


def _named(table: Any, names: tuple[str, ...]) -> Floats:
    """Return columns of a table, shape (T, names)."""
    if not hasattr(table, "keys") and not getattr(getattr(table, "dtype", None), "names", None):
        raise BadInput(
            f"give u and x_next, or a table with a column for each state, control and NAME{NEXT}",
            "x_next",
        )
    return _tall(inputs.states(table, names, "x"), "x")


def _array(values: Any, names: tuple[str, ...], where: str) -> Floats:
    """Return an array of shape (T, names); of one name also from shape (T,)."""
    column = (
        getattr(values, "ndim", 0) == 1
        and getattr(getattr(values, "dtype", None), "names", None) is None
    )
    if len(names) == 1 and (column or not hasattr(values, "keys")):
        plain = inputs.real(values, where)
        if plain.ndim == 1:
            return plain[:, None]
    return _tall(inputs.states(values, names, where), where)


def _tall(array: Floats, where: str) -> Floats:
    if array.ndim != 2:
        raise BadInput(f"transitions are rows of a table, not of shape {array.shape}", where)
    return array

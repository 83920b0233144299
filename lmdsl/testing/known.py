"""Small LPs whose answers are derived by hand, from problem data through the public API.

Cell 0 is the attractor everywhere, so the cells of C are 1, 2, ... Write g for gamma.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np

from lmdsl.common.types import Floats
from lmdsl.machine.forking import cached_property
from lmdsl.model.lp import StabilizationLP, compile
from lmdsl.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Known:
    """A problem and its V."""

    name: str  # how reports call it
    data: Mapping[str, Any]  # the problem as plain data
    value: Floats  # V derived by hand, shape (n,)

    def compile(self) -> StabilizationLP:
        """Return the LP, made anew: what a backend did to another one is not in it."""
        lp = compile(Problem.model_validate(dict(self.data)))
        assert lp.n == len(self.value), f"the LP {self.name} is not what its answer is for"
        return lp

    @cached_property
    def own(self) -> StabilizationLP:
        """The LP to judge with, which no backend is given."""
        return self.compile()

    def optimum(self, lp: StabilizationLP) -> float:
        """Return the optimal cost m'V for the weight that backends solve with."""
        return float(lp.solve_weight @ self.value)


@dataclass(frozen=True, repr=False, eq=False)
class Weighted(StabilizationLP):
    """The same model, to be solved with another weight."""

    other: Floats | None = None  # the weight, positive, shape (n,)

    @property
    def solve_weight(self) -> Floats:
        """The other weight, shape (n,)."""
        return super().solve_weight if self.other is None else self.other


def weighted(lp: StabilizationLP, weight: Floats) -> Weighted:
    """Return the model with the weight, shape (n,), that backends are to solve with."""
    own = {field.name: getattr(lp, field.name) for field in fields(StabilizationLP)}
    return Weighted(**own, other=weight)


@cache
def single(gamma: float) -> Known:
    """x+ = 2x modulo 1 on two cells: half of cell 1 reaches A, half stays.

    V = 1 + g/2 V, so V = 1/(1 - g/2), infinite from gamma_bar = 2 on.
    """
    data = _data("2*x", 2, {}, "1", gamma, 2)
    data["state_box"] = {"x": {"low": 0, "high": 1, "cells": 2, "periodic": True}}
    return Known(f"single cell, gamma {gamma!r}", data, np.array([_series(gamma / 2)]))


@cache
def choice(gamma: float) -> Known:
    """A single cell and two controls: half of it stays at cost 1, or a quarter at cost 2.

    V = min(1/(1 - g/2), 2/(1 - g/4)), the first infinite from g = 2 on; gamma_bar = 4.
    """
    data = _data("x - 0.125*u", 2, {"u": {"values": [2, 3]}}, "u - 1", gamma, 4)
    data["state_box"] = {"x": {"low": 0, "high": 1, "cells": 2}}
    value = min(_series(gamma / 2), 2 * _series(gamma / 4))
    return Known(f"choice of two controls, gamma {gamma!r}", data, np.array([value]))


@cache
def steps(n: int, gamma: float, unit: float = 1.0) -> Known:
    """Stay, or one cell down, each at the cost ``unit``.

    V_1 = unit and V_(i+1) = unit + g V_i: staying only adds to the cost.
    """
    data = _data("x - u", n + 1, {"u": {"values": [0, 1]}}, f"{unit!r}", gamma)
    value = unit * np.cumsum(gamma ** np.arange(n))
    return Known(f"{n} cells, gamma {gamma!r}, cost {unit!r}", data, value)


@cache
def walk(n: int, unit: float = 1.0) -> Known:
    """A random walk one cell up or down at cost 1, held at the top; or surely down at cost 9.

    gamma = 1. Let d_i = V_i - V_(i-1). Walking: V_i = 1 + (V_(i-1) + V_(i+1))/2 gives d_i = 2 +
    d_(i+1), at the top V_n = 1 + (V_(n-1) + V_n)/2 gives d_n = 2. Going down: d_i = 9. The cheaper
    of both is d_i = min(9, 2 (n - i + 1)): walk on the four topmost cells, go down on the others.
    """
    data = _data("x - u + (1 - u)*w", n + 1, {"u": {"values": [0, 1]}}, "", 1.0)
    data["stage_cost"] = f"{unit!r}*(1 + 8*u)"
    data["noise"] = {"w": {"values": [-1, 1], "weights": [0.5, 0.5]}}
    data["on_exit"] = "clip"
    value = unit * np.cumsum(np.minimum(9.0, 2.0 * np.arange(n, 0, -1)))
    return Known(f"random walk on {n} cells, cost {unit!r}", data, value)


@cache
def tie(gamma: float) -> Known:
    """Two controls that do and cost the same: every pair of columns is one column twice.

    V = 1, 1 + g, as with one of them.
    """
    data = _data("x - abs(u)", 3, {"u": {"values": [-1, 1]}}, "1", gamma)
    return Known(f"exact tie, gamma {gamma!r}", data, np.array([1, 1 + gamma]))


@cache
def degenerate(n: int) -> Known:
    """One cell down at cost 1 or two at cost 2, gamma = 1: every policy is optimal.

    V_i = i, and every reduced cost is zero. (Two down from cell 1 would leave the box.)
    """
    data = _data("x - u", n + 1, {"u": {"values": [1, 2]}}, "u", 1.0)
    return Known(f"{n} cells where every policy is optimal", data, np.arange(1.0, n + 1))


@cache
def trapped() -> Known:
    """Six cells, of which 3 and 4 stay where they are and 5 leaves the box: C is cells 1 and 2.

    Controls -1, 1, 2 go up 1, down 1, down 2 and cost 1, 3, 4; -1 from cell 2 (into the trap) and 2
    from cell 1 (out of the box) do not survive. gamma = 1. V_1 = min(3, 1 + V_2) = 3 and V_2 =
    min(3 + V_1, 4) = 4.
    """
    motion = "where(x < 3, x - u, where(x < 5, x, x + 1))"
    data = _data(motion, 6, {"u": {"values": [-1, 1, 2]}}, "2 + u", 1.0)
    return Known("two cells beside trapped ones", data, np.array([3.0, 4.0]))


@cache
def zero_cost(gamma: float) -> Known:
    """Stay, or one cell down, on three cells, for nothing: V = 0."""
    data = _data("x - u", 4, {"u": {"values": [0, 1]}}, "0", gamma)
    return Known(f"zero cost, gamma {gamma!r}", data, np.zeros(3))


@cache
def zeros(gamma: float) -> Known:
    """Stay for nothing, or one cell down at cost 1, on two cells.

    For g >= 1 staying for ever has no finite occupation: V = 1, 1 + g. For g < 1 it has: V = 0.
    """
    data = _data("x - u", 3, {"u": {"values": [0, 1]}}, "u", gamma)
    value = np.array([1, 1 + gamma]) if gamma >= 1 else np.zeros(2)
    return Known(f"free stay, gamma {gamma!r}", data, value)


def _series(share: float) -> float:
    """Return 1 + share + share^2 + ..."""
    return 1 / (1 - share) if share < 1 else math.inf


def _data(
    motion: str, cells: int, controls: dict[str, Any], cost: str, gamma: float, per_axis: int = 1
) -> dict[str, Any]:
    """Return a problem on cells of width 1; one sample per cell is its centre."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": motion}},
        "state_box": {"x": {"low": 0, "high": cells, "cells": cells}},
        "attractor": {"cells": [[0]]},
        "control_grid": controls,
        "stage_cost": cost,
        "sampling": {"kind": "grid", "per_axis": per_axis},
        "gamma": gamma,
    }


BY_HAND = (
    *(single(gamma) for gamma in (0.9, 1.0, 1.5)),
    *(choice(gamma) for gamma in (1.0, 1.5, 3.0)),
    *(steps(2, gamma) for gamma in (0.5, 1.0, 1.25)),
    walk(60),
)
LARGE = walk(1000)
SMALL = steps(3, 1.25)

"""The checks: each takes a :class:`Probe` and returns, or says what is Broken or Unjudged.

The docstring of a check is what holds when it passes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from importlib.util import find_spec
from typing import Any

import numpy as np

from lmdsl import backends
from lmdsl.backends import Solution, Stop
from lmdsl.common.types import Floats
from lmdsl.errors import BadInput, LmdslError
from lmdsl.machine import quiet
from lmdsl.model.lp import StabilizationLP
from lmdsl.testing import known
from lmdsl.testing.probe import (
    ACCURACY,
    Broken,
    Probe,
    Unjudged,
    cost_to_go,
    judge,
    misshapen,
    owned,
)

BY_HAND = (
    *(known.single(gamma) for gamma in (0.9, 1.0, 1.5)),
    *(known.choice(gamma) for gamma in (1.0, 1.5, 3.0)),
    *(known.steps(2, gamma) for gamma in (0.5, 1.0, 1.25)),
    known.walk(60),
)
LARGE = known.walk(1000)
SMALL = known.steps(3, 1.25)
TIGHT = 1e-7
OVER = (2.0, 2 + 2e-3, 3.0)
UNKNOWN = "no such algorithm"


def requires(probe: Probe) -> None:
    """Every package that the record requires can be imported."""
    absent = [name for name in probe.backend.requires if not _importable(name)]
    if absent:
        raise Broken(f"no package {', '.join(absent)} can be imported")


def algorithms(probe: Probe) -> None:
    """The names of the algorithms are distinct, and an unknown one is refused with BadInput."""
    names = probe.backend.capabilities.algorithms
    if names:  # then the registry refuses all others
        if len(set(names)) < len(names) or not all(isinstance(n, str) and n for n in names):
            raise Broken("algorithms are not distinct names")
        return
    try:
        with quiet.foreign():
            probe.backend.solve(SMALL.compile(), backends.Options(algorithm=UNKNOWN))
    except BadInput:
        return
    except Exception as error:
        raise Broken(f"an unknown algorithm raises {type(error).__name__}, not BadInput") from error
    raise Broken("the record lists no algorithms, and an unknown one is not refused with BadInput")


def value(probe: Probe) -> None:
    """V is right on problems solved by hand."""
    for one in BY_HAND:
        probe.right(one)


def occupation(probe: Probe) -> None:
    """Theta is nonnegative, A theta = m, and c'theta is the optimal cost."""
    for one in BY_HAND:
        lp, found = probe.claimed(one)
        theta = found.occupation
        if theta is None:
            raise Unjudged("no occupation measure is given")
        top = max(1.0, float(np.abs(theta).max()))
        if theta.min() < -ACCURACY * top:
            raise Broken(f"theta is negative ({theta.min():.1e}) on the LP {one.name}")
        residual = float(np.abs(lp.A @ theta - lp.solve_weight).sum())
        if not residual <= ACCURACY * top:
            raise Broken(f"A theta misses m by {residual:.1e} on the LP {one.name}")
        judge(one, lp, Solution(found.stop, "", occupation=theta))


def policy(probe: Probe) -> None:
    """The policy takes one column of each cell's own, and its cost-to-go is V."""
    for one in BY_HAND:
        lp, found = probe.claimed(one)
        if found.policy is None:
            raise Unjudged("no policy is given")
        if not owned(lp, found.policy):
            raise Broken(f"a column of another cell is taken on the LP {one.name}")
        error = np.abs(cost_to_go(lp, found.policy) - one.value).max() / one.value.max()
        if not error <= ACCURACY:
            raise Broken(f"the policy costs {error:.1e} relative too much on the LP {one.name}")


def vertex(probe: Probe) -> None:
    """Theta is a vertex: at most one positive entry per cell, also where controls tie."""
    _needs(probe, "vertex")
    for one in (known.tie(1.0), known.degenerate(12), known.walk(60)):
        lp, found = probe.claimed(one)
        if found.occupation is None:
            raise Unjudged("no occupation measure is given")
        positive = found.occupation > 1e-9 * found.occupation.max()
        if (np.add.reduceat(positive, lp.pair_pointer[:-1], dtype=np.int64) > 1).any():
            raise Broken(f"a cell has two positive entries of theta on the LP {one.name}")


def dual_sign(probe: Probe) -> None:
    """V is the derivative of the optimal cost in m, sign included, by finite differences."""
    weight, h = np.array([0.5, 0.3, 0.2]), 0.1

    def at(m: Floats) -> tuple[float, Solution]:
        found = probe.ask(known.weighted(SMALL.compile(), m))
        lp = known.weighted(SMALL.own, m)
        if not found.stop.success:
            raise Broken(f"it stops with {found.stop.name} where m is not uniform")
        theta = found.occupation
        return (SMALL.optimum(lp) if theta is None else float(lp.c @ theta)), found

    cost, found = at(weight)
    if found.value is None:
        raise Unjudged("no V is given")
    for i in range(3):
        slope = (at(weight + h * np.eye(3)[i])[0] - cost) / h
        if not abs(found.value[i] - slope) <= 1e-3 * abs(slope):
            raise Broken(f"V = {found.value[i]:.6g} where the cost rises by {slope:.6g} per m")


def exact_tie(probe: Probe) -> None:
    """V is right where two controls are the same."""
    for gamma in (1.0, 1.25):
        probe.right(known.tie(gamma))


def degenerate(probe: Probe) -> None:
    """V is right where every policy is optimal."""
    probe.right(known.degenerate(12))


def trapped(probe: Probe) -> None:
    """V is right on the cells that are left where others are trapped or leave the box."""
    probe.right(known.trapped())


def gamma_under(probe: Probe) -> None:
    """Gamma a thousandth under its limit is solved."""
    probe.right(known.single(2 * (1 - 1e-3)))
    probe.right(known.choice(4 * (1 - 1e-3)))


def gamma_over(probe: Probe) -> None:
    """No solution and no unbounded LP is claimed where gamma is at its limit or over."""
    for one in (*(known.single(g) for g in OVER), known.choice(4 + 4e-3)):
        _, found = probe.answer(one)
        if found.stop.success:
            raise Broken(f"{found.stop.name} is claimed on the infeasible LP {one.name}")
        if found.stop is Stop.UNBOUNDED:
            raise Broken(f"UNBOUNDED is claimed, with costs >= 0, on the LP {one.name}")


def rays(probe: Probe) -> None:
    """A gamma far over the limit is called INFEASIBLE."""
    _needs(probe, "rays")
    for one in (known.single(3.0), known.choice(6.0)):
        _, found = probe.answer(one)
        if found.stop is not Stop.INFEASIBLE:
            raise Broken(f"{found.stop.name} is claimed on the infeasible LP {one.name}")


def zero_cost(probe: Probe) -> None:
    """V = 0 where nothing costs anything."""
    for gamma in (0.9, 1.0, 1.25):
        probe.right(known.zero_cost(gamma))


def zeros(probe: Probe) -> None:
    """V is right where staying is free."""
    for gamma in (0.9, 1.0, 1.25):
        probe.right(known.zeros(gamma))


def scale(probe: Probe) -> None:
    """V is right, relative to the cost, for costs from 1e-9 to 1e9."""
    for unit in (1e-9, 1e-4, 1e4, 1e9):
        probe.right(known.steps(3, 1.0, unit))
        probe.right(known.walk(60, unit=unit))


def start(probe: Probe) -> None:
    """A first policy is used or ignored, and V is the same."""
    for one in (known.walk(60), SMALL):
        probe.right(one, start=one.own.tree[1].copy())


def tolerance(probe: Probe) -> None:
    """A tolerance of 1e-7 is reached."""
    _needs(probe, "tolerance")
    for one in (SMALL, known.walk(60)):
        lp, found = probe.solved(one, tolerance=TIGHT)
        if found.stop is Stop.OPTIMAL:
            judge(one, lp, found, TIGHT)


def time_limit(probe: Probe) -> None:
    """A time limit of a nanosecond ends the work, and is no success."""
    _needs(probe, "time_limit")
    _, found = probe.answer(LARGE, time_limit=1e-9)
    if found.stop.success:
        raise Broken(f"{found.stop.name} is claimed on 1000 cells within a nanosecond")
    if found.stop in (Stop.INFEASIBLE, Stop.UNBOUNDED):
        raise Broken(f"{found.stop.name} is claimed where time ran out")


def iteration_limit(probe: Probe) -> None:
    """One iteration is no success, unless the LP is really solved by then."""
    _needs(probe, "iteration_limit")
    for one in (SMALL, known.walk(60), LARGE):
        lp, found = probe.answer(one, max_iterations=1)
        if found.stop in (Stop.INFEASIBLE, Stop.UNBOUNDED):
            raise Broken(f"{found.stop.name} is claimed where the iterations ran out")
        if found.stop.success:
            judge(one, lp, found)
            if found.iterations is not None and found.iterations > 1:
                raise Broken(f"{found.iterations} iterations are made where 1 is allowed")


def options(probe: Probe) -> None:
    """Extreme and meaningless options are refused by an exception of lmdsl or do no harm."""
    nan, inf = math.nan, math.inf
    strange: list[dict[str, Any]] = [
        *({"tolerance": x} for x in (0.0, 1e9, -1.0, nan)),
        *({"time_limit": x} for x in (inf, 1e9, 0.0, -1.0, nan)),
        *({"max_iterations": x} for x in (10**12, 2**31 - 1, 0, -1)),
    ]
    noted = len(probe.malformed)
    for given in strange:
        lp = SMALL.own
        try:
            found = probe.raw(SMALL.compile(), **given)
        except LmdslError:
            continue
        except Unjudged:
            fault = probe.malformed.pop() if len(probe.malformed) > noted else "it raises"
            raise Broken(f"with {given}, {fault}") from None
        wrong = misshapen(lp, found)
        if wrong is None and found.stop.success and given.get("tolerance") != 1e9:
            try:
                judge(SMALL, lp, found)
            except Broken as broken:
                wrong = str(broken)
        if wrong is not None:
            raise Broken(f"with {given}, {wrong}")


def inputs(probe: Probe) -> None:
    """The arrays of the model and the first policy are what they were."""
    lp = SMALL.compile()
    first = lp.tree[1].copy()
    before = _bytes(lp, first)
    probe.ask(lp, start=first)
    changed = [name for name, content in _bytes(lp, first).items() if before[name] != content]
    if changed:
        raise Broken(f"it changes {', '.join(changed)}")


def deterministic(probe: Probe) -> None:
    """Asked twice it gives the same bytes."""
    for one in (known.walk(60), known.tie(1.0)):
        first, second = probe.answer(one)[1], probe.ask(one.compile())
        for name in ("value", "occupation", "policy"):
            a, b = getattr(first, name), getattr(second, name)
            if (a is None) != (b is None) or (a is not None and a.tobytes() != b.tobytes()):
                raise Broken(f"{name} differs from one time to the next on the LP {one.name}")


def solution(probe: Probe) -> None:
    """Every solve of every check returned a well-formed Solution."""
    if probe.malformed:
        first, more = probe.malformed[0], len(probe.malformed) - 1
        raise Broken(first + (f" (and {more} more like that)" if more else ""))


CHECKS: dict[str, Callable[[Probe], None]] = {
    "requires": requires,
    "algorithms": algorithms,
    "value": value,
    "occupation": occupation,
    "policy": policy,
    "vertex": vertex,
    "dual sign": dual_sign,
    "exact tie": exact_tie,
    "degenerate": degenerate,
    "trapped": trapped,
    "gamma under": gamma_under,
    "gamma over": gamma_over,
    "rays": rays,
    "zero cost": zero_cost,
    "zeros in the cost": zeros,
    "scale": scale,
    "start": start,
    "tolerance": tolerance,
    "time limit": time_limit,
    "iteration limit": iteration_limit,
    "options": options,
    "inputs": inputs,
    "deterministic": deterministic,
    "solution": solution,
}
"""All checks, in order; ``solution`` is last, for it speaks of the solves of all others."""


def _needs(probe: Probe, capability: str) -> None:
    if not getattr(probe.backend.capabilities, capability):
        raise Unjudged(f"the record says {capability}=False")


def _importable(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def _bytes(lp: StabilizationLP, first: np.ndarray) -> dict[str, bytes]:
    arrays = {field.name: getattr(lp, field.name) for field in fields(lp)}
    arrays |= {f"rows.{field.name}": getattr(lp.rows, field.name) for field in fields(lp.rows)}
    arrays |= {"rows.shares.value": lp.rows.shares.value, "cell": lp.cell, "start": first}
    return {name: a.tobytes() for name, a in arrays.items() if isinstance(a, np.ndarray)}

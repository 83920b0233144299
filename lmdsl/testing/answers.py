"""Checks of what a backend says of an LP: the value, the policy, the occupation, the status."""

import numpy as np

from lmdsl.backends import Solution, Stop
from lmdsl.common.types import Floats
from lmdsl.testing import known
from lmdsl.testing.probe import ACCURACY, Broken, Probe, Unjudged, cost_to_go, judge, owned

OVER = (2.0, 2 + 2e-3, 3.0)


def value(probe: Probe) -> None:
    """V is right on problems solved by hand."""
    for one in known.BY_HAND:
        probe.right(one)


def occupation(probe: Probe) -> None:
    """Theta is nonnegative, A theta = m, and c'theta is the optimal cost."""
    for one in known.BY_HAND:
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
    for one in known.BY_HAND:
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
    probe.needs("vertex")
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
        found = probe.ask(known.weighted(known.SMALL.compile(), m))
        lp = known.weighted(known.SMALL.own, m)
        if not found.stop.success:
            raise Broken(f"it stops with {found.stop.name} where m is not uniform")
        theta = found.occupation
        return (known.SMALL.optimum(lp) if theta is None else float(lp.c @ theta)), found

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
    probe.needs("rays")
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

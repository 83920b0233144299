"""Policies of the finite model: evaluate, improve, break ties.

A policy is an array of columns, one per cell of C (``policy``). P_u, G_u are its rows. It is
*gamma-stabilizing* when the spectral radius of gamma P_u is below 1; then its value
V = G_u + gamma P_u V is finite. Write g = max(gamma, 1).

For gamma >= 1, policy iteration from a gamma-stabilizing policy u and V >= T_u V that changes a
control only where strictly better keeps every policy gamma-stabilizing, zeros in the cost included
(docs/mathematics.md, Policy iteration).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.types import Floats, Policy, never
from lmdsl.common.types import TimeUp as TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.linear import equations, extrapolation
from lmdsl.optimize.linear.gauss_seidel import CEILING, TOLERANCE
from lmdsl.optimize.linear.substitution import Peeled
from lmdsl.optimize.policies.evaluation import evaluate, peeled, stability_vector
from lmdsl.optimize.policies.screening import Pass, Screen

TIE = 1e-12  # relative difference in Q above which two controls are not tied

LEAST_SWEEPS, MOST_SWEEPS = 12, 60  # least and largest number of sweeps of an evaluation

# Number of cells for each changed one above which another pass costs less than an evaluation.
FEW = 500

# Number of sweeps in unfinished evaluations above which a Krylov method takes their place.
PATIENCE = 200

PROBES = 64  # number of rows looked at before all are


@dataclass(frozen=True, eq=False)
class Iteration:
    """The outcome of policy iteration."""

    # policy, value: the last policy and its value
    policy: Policy
    value: Floats
    steps: int  # improvement steps that changed the policy
    converged: bool  # false when stopped early
    screen: Screen  # lower bounds of the rivals of each cell's control at the value


def iterate(
    lp: StabilizationLP,
    policy: Policy,
    value: Floats,
    gamma: float | None = None,
    cost: Floats | None = None,
    time_up: TimeUp = never,
    limit: int | None = None,
    changes: Callable[[int], None] | None = None,
    keep: Callable[[Policy, Floats], None] | None = None,
) -> Iteration:
    """Policy iteration from a gamma-stabilizing policy until no control is better.

    Parameters
    ----------
    lp, policy
        The model and the first policy.
    value
        Its value, or any V >= T_u V, such as :func:`bound` gives.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    time_up, limit
        Asked before every step; largest number of steps.
    changes
        Told after every step how many controls it changed.
    keep
        Told after every step the policy and V >= T_u V.

    Notes
    -----
    Each step changes every control for which another one is better by a relative 1e-12. Then the
    new policy u is evaluated: to the end where few cells lie on cycles, else by sweeps V <- T_u V,
    about as long as the improvement took, or by an extrapolation along the one mode in which they
    stall (:func:`~extrapolation.extrapolate`); not at all after the first step, and every second
    time where few controls changed. V >= T_u V stays true whatever the number of sweeps, so V falls
    and every policy on the way is gamma-stabilizing (docs/mathematics.md, Policy iteration); only a
    policy evaluated to the end is returned as the last.
    """
    screen = Screen(lp, gamma, cost)
    sweeps = _Sweeps(screen, time_up)
    rows: Peeled | None = None  # those of the policy at hand
    V, last, step = value, None, 0  # last: the policy evaluated to the end, and its value
    unevaluated = False  # the policy at hand was not evaluated at all

    def ended(converged: bool) -> Iteration:
        return Iteration(*(last or (policy, V)), step, converged, screen)

    while True:
        out = time_up() or step == limit
        done = screen.improve(V, policy, TIE) if not out else Pass(V, policy, 0, 0)
        exact = None
        if changes:
            changes(done.changed)
        if done.changed:
            step += 1
            x = done.value
            unevaluated = not unevaluated and (step == 1 or done.changed * FEW < lp.n)
            rows = None if unevaluated else Peeled.of(screen.slots.current)  # the pass copied them
            if rows:
                x, exact = sweeps.lower(rows, V, done)
            screen.follow(V, x)
            policy, V = done.policy, x
        elif last is not None and last[0] is policy:
            return ended(not out)
        else:
            try:
                exact = _to_the_end(screen, policy, done.value, rows, time_up)
            except Stopped:
                return ended(False)
            if exact is None:
                return ended(last is not None and not out)
            screen.follow(V, np.minimum(exact, V))
            V = exact
        if keep:
            keep(policy, V)
        if exact is not None:
            if last is not None and not (exact < last[1]).any():
                return ended(not out)  # rounding made a change look better than it is
            last = policy, exact
        if out:
            return ended(False)


class _Sweeps:
    """Evaluations that are cut short: sweeps, about as long as the improvement took."""

    def __init__(self, screen: Screen, time_up: TimeUp) -> None:
        self.screen, self.time_up = screen, time_up
        self.swept = 0  # sweeps that did not reach the end
        self.stalls = True  # sweeps do, in a single mode, as far as was seen

    def lower(self, rows: Peeled, V: Floats, done: Pass) -> tuple[Floats, Floats | None]:
        """Return a value between those before and after, and the exact one where that is it."""
        x, cost = done.value.copy(), self.screen.policy_cost
        count = min(max(done.looked // len(x), LEAST_SWEEPS), MOST_SWEEPS)
        fall = 0.0 if rows.small else _fall(V, x)
        far, left = 0.0, np.inf
        if self.stalls and not rows.small:
            far = extrapolation.extrapolate(rows.system, cost, x)
            self.stalls = 2 * far > count
        positive = bool((cost > 0).all())  # else what is free has to become 0
        slow = self.swept > PATIENCE and positive
        if slow:
            slow = equations.descend(rows, cost, x, 0.1 * (fall or _fall(V, x)), self.time_up)
            self.swept = self.swept if slow else 0
        if far < count and not slow:
            left = equations.advance(rows, cost, x, count, 0.1 * fall, 0.0)
            if left > TOLERANCE and left > 0.1 * (fall or _fall(V, x)):
                self.swept += count
        return np.minimum(x, done.value), x if left <= TOLERANCE and positive else None


def _to_the_end(
    screen: Screen, policy: Policy, V: Floats, rows: Peeled | None, time_up: TimeUp
) -> Floats | None:
    """Return the value of a policy with V >= T_u V, None where none is found."""
    lp, gamma, cost = screen.lp, screen.gamma, screen.cost
    rows = rows or Peeled.of(screen.slots.system(policy))
    exact = evaluate(lp, policy, gamma, cost, V, True, time_up, rows)
    return evaluate(lp, policy, gamma, cost, time_up=time_up) if exact is None else exact


def _fall(before: Floats, after: Floats) -> float:
    """Return the largest relative decrease."""
    ratio = np.divide(after, before, out=np.ones(len(before)), where=before > 0)
    return 1.0 - float(ratio.min(initial=1.0))


def bound(lp: StabilizationLP, policy: Policy, w: Floats | None = None) -> Floats | None:
    """Return V >= T_u V of a g-stabilizing policy, close to its value; None where none is found.

    With w >= g P_u w + d, c w serves as soon as c d >= G_u; sweeps then lower it. Where all rows
    lose about as much of the cost, a constant is close already.
    """
    cost = lp.cost[policy]
    even = _even(lp, policy, lp.gamma, cost)
    if even is not None:
        return even
    w, d = stability_vector(lp, policy, w)
    if w is None or d is None:
        return None
    V = _covering(w, d, cost)
    if V is None or _close(V[0] / w[0], d, cost):
        return V
    x = V.copy()
    equations.advance(peeled(lp, policy, lp.gamma), cost, x, MOST_SWEEPS, 1e-2, 0.0)
    return np.minimum(x, V)


def _even(lp: StabilizationLP, policy: Policy, gamma: float, cost: Floats) -> Floats | None:
    """Return a constant V >= T_u V within a percent of the policy's value, None where none is."""
    some = np.arange(0, lp.n, lp.n // PROBES + 1)  # few have to be looked at where none is
    rows = lp.rows.take(policy[some])
    stays = np.where(rows.target < lp.n, rows.shares.value[rows.code], 0.0)
    d = 1 - gamma * np.add.reduceat(stays, rows.pointer[:-1])
    if not ((d > 0).all() and _close(float((cost[some] / d).max()), d, cost[some])):
        return None
    ones = np.ones(lp.n)
    lost = bounds.decrease(lp, policy, ones, gamma)
    V = None if lost is None else _covering(ones, lost, cost)
    return V if V is not None and lost is not None and _close(V[0], lost, cost) else None


def _covering(w: Floats, d: Floats, cost: Floats) -> Floats | None:
    """Return the least c w with c d >= cost, None where doubles end."""
    with np.errstate(over="ignore"):
        V: Floats = w * (float((cost / d).max()) * (1 + 1e-12))
    return V if (V < CEILING).all() else None


def _close(factor: float, d: Floats, cost: Floats) -> bool:
    """Return whether c w is within a percent of a policy's value, for w >= g P_u w + d."""
    return bool((d * (factor * (1 - 1e-2)) <= cost).all())

"""The cost of a policy, and the vector that proves it stabilizing."""

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.types import Floats, Policy, never
from lmdsl.common.types import TimeUp as TimeUp
from lmdsl.model.algorithm_1 import reaches_attractor
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.linear import equations
from lmdsl.optimize.linear.policy_system import of_policy
from lmdsl.optimize.linear.substitution import Peeled


def evaluate(
    lp: StabilizationLP,
    policy: Policy,
    gamma: float | None = None,
    cost: Floats | None = None,
    start: Floats | None = None,
    transient: bool = False,
    time_up: TimeUp = never,
    rows: Peeled | None = None,
) -> Floats | None:
    """Return V = G_u + gamma P_u V, shape (n,); None where the policy has no finite value.

    gamma and cost, shape (K,), are the LP's by default; ``start`` is a guess of V, ``rows`` gamma
    P_u where it is at hand. Of a policy known to be ``transient`` (gamma-stabilizing) nobody looks
    whether it reaches A. ``time_up`` ends the work with Stopped.
    """
    gamma = lp.gamma if gamma is None else gamma
    b = (lp.cost if cost is None else cost)[policy]
    if gamma >= 1 and not transient and not reaches_attractor(lp, policy).all():
        return None
    x = np.array(b if start is None else start, dtype=np.float64)
    rows = peeled(lp, policy, gamma) if rows is None else rows
    found = equations.solve_from(
        rows, b, x, lambda: gamma * lp.rows.matrix(policy), time_up=time_up
    )
    return x if found else None


def peeled(lp: StabilizationLP, policy: Policy, gamma: float) -> Peeled:
    """Return gamma P_u, ready for :func:`evaluate`."""
    return Peeled.of(of_policy(lp, policy, gamma))


def stability_vector(
    lp: StabilizationLP,
    policy: Policy,
    guess: Floats | None = None,
    g: float | None = None,
    sharp: bool = False,
    time_up: TimeUp = never,
    rows: Peeled | None = None,
) -> tuple[Floats, Floats] | tuple[None, None]:
    """Return w > 0, d > 0 with w >= g P_u w + d: a proof that the policy is g-stabilizing.

    w is close to the unit-cost value, closer where ``sharp``. Where that spans so many decades that
    1 is lost in rounding, the value at a slightly larger weight leaves a relative slack instead.
    """
    g = lp.growth if g is None else g
    if guess is not None and (d := bounds.decrease(lp, policy, guess, g)) is not None:
        return guess, d
    unit = np.ones(lp.n)
    w = unit.copy()
    rows = peeled(lp, policy, g) if rows is None else rows
    # Sweeps from below leave 1 + g P w - w at most what they still move.
    if equations.advance(rows, unit, w, 128, 0.0, 1e-2 if sharp else 0.25) < np.inf:
        d = bounds.decrease(lp, policy, w, g)
        if d is not None:
            return w, d
    units = np.broadcast_to(1.0, lp.K)  # takes no memory
    for inflation in (0.0, 5e-7, 1e-10):
        w_more = evaluate(lp, policy, g * (1 + inflation), units, guess, time_up=time_up)
        if w_more is not None and (d := bounds.decrease(lp, policy, w_more, g)) is not None:
            return w_more, d
    return None, None

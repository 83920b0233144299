"""Making the vectors behind a certificate: good guesses, repaired until the checks accept them.

Nothing here is trusted: the judge decides on what comes out.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.certificate.checks import (
    MEASURE_TOLERANCE,
    check_lower,
    check_measure,
    check_upper,
    gap,
    weighted,
)
from lmdsl.certificate.claims import Verified, Witness
from lmdsl.certificate.judge import PARALLEL_FROM, verdict
from lmdsl.common.types import Floats, Policy, TimeUp, never
from lmdsl.machine import threads
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize import descent
from lmdsl.optimize.linear import equations
from lmdsl.optimize.linear.substitution import Peeled
from lmdsl.optimize.policies import evaluation, iteration

MOST_GUESSED = 1e-7  # relative slack above which a lower bound is not made by scaling V

# Number of passes towards the lower bound, and of transitions read above which they end.
LEAST_PASSES, MOST_PASSES, MOST_READ = 100, 2000, 2 * 10**8

# Near gamma_bar rounding of large values exceeds an absolute slack. The value at gamma (1 + s)
# leaves a slack s gamma P V relative to V above; the optimum at gamma (1 - s) below.
RELATIVE_SLACK = (1e-13, 1e-11, 1e-9)


def certify(
    lp: StabilizationLP,
    policy: Policy,
    tolerance: float,
    value: Floats | None = None,
    time_up: TimeUp = never,
) -> Verified:
    """Make the vectors of claims 1 to 4 for a policy and check them.

    ``value`` is the policy's as :func:`~evaluation.evaluate` gives it, made where missing; what is
    not established when ``time_up`` ends the work is not claimed.
    """
    try:
        witness, V = _first_try(lp, policy, tolerance, value, time_up)
    except Stopped:
        witness, V = Witness(policy), None
    proof = verdict(lp, witness, tolerance)
    if V is not None and (proof.gap is None or proof.gap > tolerance):
        witness = _tightened(lp, witness, V, tolerance, time_up)
        proof = verdict(lp, witness, tolerance)
    return Verified(proof, witness)


def _first_try(
    lp: StabilizationLP, policy: Policy, tolerance: float, value: Floats | None, time_up: TimeUp
) -> tuple[Witness, Floats | None]:
    """Return vectors that serve as a rule, and the policy's value."""
    under, own = lp.under(policy), np.arange(lp.n)
    rows = evaluation.peeled(under, own, lp.gamma)
    growing = rows if lp.growth == lp.gamma else None

    def bounds_of_cost() -> tuple[Witness, Floats | None]:
        w, d = evaluation.stability_vector(under, own, sharp=True, time_up=time_up, rows=growing)
        V = value
        if V is None:
            V = evaluation.evaluate(under, own, transient=w is not None, time_up=time_up, rows=rows)
        if V is None:
            return Witness(policy, w, None, lower_vector(lp, None, tolerance, time_up), None), None
        return Witness(
            policy, w, upper_vector(under, own, V, w, d), _guessed(under, V, tolerance)
        ), V

    def lyapunov_measure() -> Floats | None:
        return _measure_vector(under, rows, time_up)

    if value is not None:  # then the Lyapunov measure is finite too
        (witness, V), mu = threads.both(bounds_of_cost, lyapunov_measure, lp.n >= PARALLEL_FROM)
    else:
        witness, V = bounds_of_cost()
        mu = None if V is None else lyapunov_measure()
    return replace(witness, mu=mu), V


def _tightened(
    lp: StabilizationLP, witness: Witness, V: Floats, tolerance: float, time_up: TimeUp
) -> Witness:
    """Bring the bounds of the cost together, where the first try did not."""
    policy, V_up, W = witness.policy, witness.V_up, _scaled(lp, V)
    assert policy is not None
    W = np.zeros(lp.n) if W is None else W
    best = gap(lp, V_up, W)
    for slack in RELATIVE_SLACK:
        if best <= tolerance:
            break
        try:
            V_up = _lesser(lp, V_up, _upper_with_slack(lp, policy, slack, time_up))
            W = _greater(lp, W, _lower_with_slack(lp, policy, V, slack, time_up))
        except Stopped:
            break
        best = gap(lp, V_up, W)
    if best > tolerance and not time_up():
        W = _greater(lp, W, lower_vector(lp, V, tolerance, time_up))
    return replace(witness, V_up=V_up, W=W)


def _upper_with_slack(
    lp: StabilizationLP, policy: Policy, slack: float, time_up: TimeUp
) -> Floats | None:
    V = evaluation.evaluate(lp, policy, lp.gamma * (1 + slack), time_up=time_up)
    return V if V is not None and check_upper(lp, policy, V) else None


def _lower_with_slack(
    lp: StabilizationLP, policy: Policy, V: Floats, slack: float, time_up: TimeUp
) -> Floats | None:
    gamma = lp.gamma * (1 - slack)
    value = evaluation.evaluate(lp, policy, gamma, start=V, time_up=time_up)
    if value is None:
        return None
    W = iteration.iterate(lp, policy, value, gamma, time_up=time_up, limit=20).value
    return W if check_lower(lp, W) else None


def _lesser(lp: StabilizationLP, a: Floats | None, b: Floats | None) -> Floats | None:
    known = [x for x in (a, b) if x is not None]
    return min(known, key=lambda x: weighted(lp, x), default=None)


def _greater(lp: StabilizationLP, a: Floats, b: Floats | None) -> Floats:
    return a if b is None or weighted(lp, a) >= weighted(lp, b) else b


def upper_vector(
    lp: StabilizationLP, policy: Policy, V: Floats, w: Floats | None, d: Floats | None
) -> Floats | None:
    """Return V_up = V + delta w with delta >= max(residual / d), None where it fails."""
    if not np.isfinite(V).all() or not (V >= 0).all():
        return None
    if (w is None or d is None) and lp.gamma < 1:
        w, d = np.ones(lp.n), np.full(lp.n, (1 - lp.gamma) * 0.99)
    for _ in range(4):
        future = bounds.expected_above(lp, policy, V, lp.gamma)
        residual = bounds.add_above(future, lp.cost[policy]) - V
        if (residual <= 0).all():
            return V
        if w is None or d is None:
            return None
        delta = max(float((residual / d).max()), 0.0) * 1.01
        V = V + delta * w
        if not np.isfinite(V).all():
            return None
    return V if check_upper(lp, policy, V) else None


def lower_vector(
    lp: StabilizationLP, V: Floats | None, tolerance: float, time_up: TimeUp = never
) -> Floats:
    """Return W of claim 3, as large as can be proved from V; 0 always serves."""
    zero = np.zeros(lp.n)
    candidates: list[Floats] = []
    if V is not None:
        W = _scaled(lp, V)
        if W is not None:
            return W
        start = V * (1 - min(tolerance, 1e-6) / 4)
        W = descent.lower_until_below(lp, start, lp.gamma, lp.cost, time_up=time_up)
        if W is not None:
            candidates.append(W)
    if V is None or not candidates or gap(lp, V, candidates[0]) > tolerance:
        passes = max(LEAST_PASSES, min(MOST_PASSES, MOST_READ // max(len(lp.rows.target), 1)))
        candidates.append(descent.raise_from_zero(lp, lp.gamma, lp.cost, passes, time_up))
    good = [W for W in candidates if check_lower(lp, W)]
    best: Floats = max(good, key=lambda W: weighted(lp, W), default=zero)
    return best


def _guessed(under: StabilizationLP, V: Floats, tolerance: float) -> Floats | None:
    """W = (1 - eps) V with what rounding takes from the policy's own rows, twice; rarely too small.

    Other rows as close to V have about as many entries and as much cost.
    """
    worst, infinite = bounds.worst_excess(under, V)
    eps = 2 * worst + bounds.UNIT
    return None if infinite or not eps < min(tolerance / 4, MOST_GUESSED) else V * (1 - eps)


def _scaled(lp: StabilizationLP, V: Floats) -> Floats | None:
    """W = (1 - eps) V: it serves once r_a <= eps/(1 - eps) G_a for every surviving pair."""
    worst, infinite = bounds.worst_excess(lp, V)
    if infinite or not worst < 1:
        return None
    for margin in (1.0, 2.0, 16.0):
        eps = margin * worst / (1 + worst) + (margin - 1) * 1e-15
        W: Floats = V * (1 - eps)
        if check_lower(lp, W):
            return W
    return None


def _measure_vector(under: StabilizationLP, rows: Peeled, time_up: TimeUp) -> Floats | None:
    def matrix() -> Any:
        return under.gamma * under.rows.matrix()

    # The residual counts in absolute terms where mu is small, summed over all cells.
    flat = 1e-2 * MEASURE_TOLERANCE / under.n
    mu = equations.solve_transposed(rows, under.weight, matrix, flat=flat, time_up=time_up)
    if mu is not None and not check_measure(under, np.arange(under.n), mu)[1]:
        mu = equations.solve_transposed(rows, under.weight, matrix, start=mu, time_up=time_up)
    return mu

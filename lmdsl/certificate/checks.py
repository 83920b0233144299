"""The checks of all claims, fast; what is extreme is judged exactly."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from lmdsl.certificate import bounds, exact_sums, sums
from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.certificate.sums import rounded_up, total_above
from lmdsl.common.types import Floats, Pairs
from lmdsl.machine import threads
from lmdsl.model import algorithm_1
from lmdsl.model.lp import StabilizationLP

MEASURE_TOLERANCE = 1e-9

MOST_EXACT = 200_000
"""Transitions of a policy that are judged exactly where numbers are extreme: 0.5 s a claim."""

MANY = 10_000
"""Cells from which on two claims are judged in two threads."""


def check_stabilizing(lp: StabilizationLP, policy: Pairs, w: Floats) -> float | None:
    """Claim 1: return a proved bound on rho(g P_u), None where the claim does not hold.

    It is 1 - min d/w < 1 rounded up, which may be 1.
    """
    if not len(w):
        return None
    d = bounds.decrease(lp, policy, w, lp.growth)
    if d is not None:
        share = float((d / w).min()) * (1 - 4 * bounds.UNIT)
        contraction = float(np.nextafter(1 - share, 2.0))
        if contraction < 1:
            return max(contraction, 0.0)
    exactly = _extreme(lp, policy, w, lp.growth, None)
    found = None if exactly is None else exact_sums.contraction(lp, _rows(lp, policy), exactly)
    return None if found is None or found >= 1 else rounded_up(found)


def check_upper(lp: StabilizationLP, policy: Pairs, V_up: Floats) -> bool:
    """Claim 2: V_up >= gamma P_u V_up + G_u and V_up >= 0."""
    if not is_sound(lp, V_up):
        return False
    future = bounds.expected_above(lp, policy, V_up, lp.gamma)
    if (V_up >= bounds.add_above(future, lp.cost[policy])).all():
        return True
    V = _extreme(lp, policy, V_up, lp.gamma, lp.cost)
    return V is not None and exact_sums.above_policy(lp, _rows(lp, policy), policy, V)


def check_lower(lp: StabilizationLP, W: Floats) -> bool:
    """Claim 3: W <= gamma P_a W + G_a for every surviving pair."""
    if not is_sound(lp, W):
        return False
    return bounds.holds_for_all(lp, W, lp.gamma, lp.cost)


def check_measure(lp: StabilizationLP, policy: Pairs, mu: Floats) -> tuple[float, bool]:
    """Claim 4: return ||m - mu + gamma P_u'mu||_1 rounded up, and whether the claim holds.

    The residual is infinite where mu is not >= 0. Where rounding alone decides, or a number
    overflows, small models are summed exactly.
    """
    if not is_sound(lp, mu):
        return math.inf, False
    with np.errstate(over="ignore", invalid="ignore"):
        inflow, relative, absolute = bounds.inflow(lp, policy, mu, lp.gamma)
        rounding = relative * (lp.weight + mu + inflow) + absolute
        residual = np.abs((lp.weight - mu) + inflow)
        size = float(mu.sum()) * (1 - 70 * bounds.UNIT)
        bound = total_above(residual + rounding)
    allowed = MEASURE_TOLERANCE * max(1.0, size) * (1 - 4 * bounds.UNIT)
    if bound <= allowed < math.inf:
        return bound, True
    least = bound - 2 * total_above(rounding)
    entries = lp.rows.pointer[policy + 1] - lp.rows.pointer[policy]
    if entries.sum() > MOST_EXACT or allowed < least < math.inf:
        return (bound if math.isfinite(bound) else math.inf), False
    exactly = exact_sums.fractions(mu)
    found = exact_sums.residual(lp, _rows(lp, policy), exactly)
    return rounded_up(found), found <= allowed_residual(exactly)


def allowed_residual(mu: list[Fraction]) -> Fraction:
    """Return the largest residual of claim 4 for a measure, exactly."""
    return Fraction(MEASURE_TOLERANCE) * max(Fraction(1), sum(mu, Fraction(0)))


def check_refusal(lp: StabilizationLP, w: Floats) -> bool:
    """Claim 6: w >= 0, w != 0 and w <= gamma P_a w for every surviving pair."""
    return is_sound(lp, w) and bool(w.any()) and bounds.holds_for_all(lp, w, lp.gamma, None)


def is_sound(lp: StabilizationLP, x: Floats) -> bool:
    """Return whether a vector has a finite number >= 0 for every cell."""
    return x.shape == (lp.n,) and bool((np.isfinite(x) & (x >= 0)).all())


def _extreme(
    lp: StabilizationLP, policy: Pairs, x: Floats, gamma: float, cost: Floats | None
) -> list[Fraction] | None:
    """Return a vector as fractions where the fast check may fail because numbers are extreme.

    None where its word is final, or the rows of the policy are too many.
    """
    entries = lp.rows.pointer[policy + 1] - lp.rows.pointer[policy]
    if not is_sound(lp, x) or bounds.ordinary(lp, x, gamma, cost) or entries.sum() > MOST_EXACT:
        return None
    return exact_sums.fractions(x)


def _rows(lp: StabilizationLP, policy: Pairs) -> list[exact_sums.Row]:
    return [row for _, row in exact_sums.rows(lp, policy)]


def check(lp: StabilizationLP, witness: Witness, tolerance: float) -> Certificate:
    """Check every claim of a witness against the finite model.

    Parameters
    ----------
    lp
        The finite model.
    witness
        Policy and vectors; nothing in it is trusted.
    tolerance
        Largest gap that counts as verified.
    """
    policy = witness.policy
    V_up, W, mu, w = witness.V_up, witness.W, witness.mu, witness.w
    if policy is not None and not is_policy(lp, policy):
        policy = None
    contraction = cost = floor = None
    residual: tuple[float, bool] | None = None
    upper = False
    if policy is not None:
        under, own = lp.under(policy), np.arange(lp.n)

        def of_policy() -> tuple[float | None, bool]:
            proved = None if w is None else check_stabilizing(under, own, w)
            return proved, V_up is not None and check_upper(under, own, V_up)

        def of_measure() -> tuple[float, bool] | None:
            return None if mu is None else check_measure(under, own, mu)

        claims, residual = threads.both(of_policy, of_measure, lp.n >= MANY)
        contraction, upper = claims
    lower = W is not None and check_lower(lp, W)
    if upper and V_up is not None:
        cost = sums.weighted(lp.weight, V_up, math.inf)
        upper = cost < math.inf
    if lower and W is not None:
        floor = sums.weighted(lp.weight, W, -math.inf)
    certificate = Certificate(
        stabilizing=contraction is not None,
        upper_bound=upper,
        lower_bound=lower,
        measure=residual is not None and residual[1],
        refusal=policy is None and w is not None and check_refusal(lp, w),
        contraction=contraction,
        cost=cost if upper else None,
        lower=floor,
        gap=gap(lp, V_up, W) if upper and lower else None,
        measure_residual=None if residual is None else residual[0],
        tolerance=tolerance,
    )
    return explained(lp, policy, with_stated_gap(certificate))


def with_stated_gap(proof: Certificate) -> Certificate:
    """Return a certificate with at least the gap that its rounded cost and lower bound show."""
    if proof.gap is None or proof.cost is None or proof.lower is None:
        return proof
    return replace(proof, gap=sums.stated_gap(proof.gap, proof.cost, proof.lower))


def weighted(lp: StabilizationLP, values: Floats) -> float:
    """Return m'values, rounded to nearest."""
    return sums.total(lp.weight * values)


def is_policy(lp: StabilizationLP, policy: Pairs) -> bool:
    """Return whether an array names one column of every cell's own."""
    if policy.shape != (lp.n,) or not lp.n:
        return False
    return bool((policy >= lp.pair_pointer[:-1]).all() and (policy < lp.pair_pointer[1:]).all())


def explained(lp: StabilizationLP, policy: Pairs | None, certificate: Certificate) -> Certificate:
    """Return the certificate with the reasons why it is not verified."""
    reasons = []
    if certificate.refusal:
        reasons.append(f"proved: no policy has finite cost at gamma = {lp.gamma!r}")
    elif policy is None:
        reasons.append("there is no policy to verify")
    elif not certificate.stabilizing:
        reasons.append(_not_stabilizing(lp, policy))
    if policy is not None:
        if not certificate.upper_bound:
            reasons.append("no upper bound on the cost of the policy could be established")
        if not certificate.lower_bound:
            reasons.append("no lower bound on the optimal cost could be established")
        if not certificate.measure:
            shown = certificate.measure_residual
            reasons.append(
                "the Lyapunov measure could not be established"
                + (
                    ""
                    if shown is None
                    else f": its residual is {shown:.2g}, above 1e-9 of its size; the numbers "
                    "no longer allow it, lower gamma"
                )
            )
        width = certificate.gap
        if width is not None and width > certificate.tolerance:
            reasons.append(
                f"the gap {width:.3g} is above the tolerance {certificate.tolerance:.3g}"
                + _too_small(certificate.cost)
            )
    return replace(certificate, reasons=tuple(reasons))


def _too_small(cost: float | None) -> str:
    if cost is None or not cost < sums.NORMAL:
        return ""
    return (
        f": the cost {cost!r} is below the normal range of doubles, which are coarse there; "
        "multiply stage_cost by a power of ten"
    )


def _not_stabilizing(lp: StabilizationLP, policy: Pairs) -> str:
    lost = int((~algorithm_1.reaches_attractor(lp, policy)).sum())
    if lost and lp.gamma < 1:
        return (
            f"from {lost} of {lp.n} cells the policy never reaches the attractor: at gamma = "
            f"{lp.gamma!r} < 1 staying away can be cheaper than going; raise gamma to 1"
        )
    if lost:
        return f"from {lost} of {lp.n} cells the policy never reaches the attractor"
    return "no contraction of the policy could be proved: the numbers do not allow it"


def gap(lp: StabilizationLP, V_up: Floats | None, W: Floats | None) -> float:
    """Return m'(V_up - W) / m'V_up, rounded up; 0 if m'V_up = 0, infinite if one is missing."""
    if V_up is None or W is None:
        return math.inf
    return sums.gap_above(lp.weight, V_up, W)

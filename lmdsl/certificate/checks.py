"""Every claim checked fast; what is extreme is judged exactly."""

import math
from fractions import Fraction

import numpy as np

from lmdsl.certificate import bounds, exact_sums, sums
from lmdsl.certificate.sums import rounded_up, total_above
from lmdsl.common.types import Floats, Policy
from lmdsl.model.lp import StabilizationLP

MEASURE_TOLERANCE = 1e-9  # residual of mu relative to its size above which it is refused

# Number of transitions of a policy above which none is judged exactly: 0.5 s a claim.
MOST_EXACT = 200_000


def check_stabilizing(lp: StabilizationLP, policy: Policy, w: Floats) -> float | None:
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


def check_upper(lp: StabilizationLP, policy: Policy, V_up: Floats) -> bool:
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


def check_measure(lp: StabilizationLP, policy: Policy, mu: Floats) -> tuple[float, bool]:
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
    """Return the largest residual of claim 4 for mu, exactly."""
    return Fraction(MEASURE_TOLERANCE) * max(Fraction(1), sum(mu, Fraction(0)))


def check_refusal(lp: StabilizationLP, w: Floats) -> bool:
    """Claim 6: w >= 0, w != 0 and w <= gamma P_a w for every surviving pair."""
    return is_sound(lp, w) and bool(w.any()) and bounds.holds_for_all(lp, w, lp.gamma, None)


def is_sound(lp: StabilizationLP, x: Floats) -> bool:
    """Return whether a vector has a finite number >= 0 for every cell."""
    return x.shape == (lp.n,) and bool((np.isfinite(x) & (x >= 0)).all())


def _extreme(
    lp: StabilizationLP, policy: Policy, x: Floats, gamma: float, cost: Floats | None
) -> list[Fraction] | None:
    """Return a vector as fractions where the fast check may fail because numbers are extreme.

    None where its word is final, or the rows of the policy are too many.
    """
    entries = lp.rows.pointer[policy + 1] - lp.rows.pointer[policy]
    if not is_sound(lp, x) or bounds.ordinary(lp, x, gamma, cost) or entries.sum() > MOST_EXACT:
        return None
    return exact_sums.fractions(x)


def _rows(lp: StabilizationLP, policy: Policy) -> list[exact_sums.Row]:
    return [row for _, row in exact_sums.rows(lp, policy)]


def weighted(lp: StabilizationLP, values: Floats) -> float:
    """Return m'values, rounded to nearest."""
    return sums.total(lp.weight * values)


def is_policy(lp: StabilizationLP, policy: Policy) -> bool:
    """Return whether an array names one column of every cell's own."""
    if policy.shape != (lp.n,) or not lp.n:
        return False
    return bool((policy >= lp.pair_pointer[:-1]).all() and (policy < lp.pair_pointer[1:]).all())


def gap(lp: StabilizationLP, V_up: Floats | None, W: Floats | None) -> float:
    """Return m'(V_up - W) / m'V_up, rounded up; 0 if m'V_up = 0, infinite if one is missing."""
    if V_up is None or W is None:
        return math.inf
    return sums.gap_above(lp.weight, V_up, W)

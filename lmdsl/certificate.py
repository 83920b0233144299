"""The certificate: what "verified" means, computed from the finite model and the policy alone.

With u the policy, P_u, G_u its rows, g = max(gamma, 1), five claims, each an inequality between
stored doubles that holds in exact arithmetic (see bounds.py):

1. stabilizing   w > 0, w >= g P_u w + d with d > 0. Then rho(g P_u) <= 1 - min d/w < 1: from every
                 cell of C the chain reaches A almost surely, with geometric decay.
2. upper bound   V_up >= gamma P_u V_up + G_u, V_up >= 0: the policy costs at most m'V_up.
3. lower bound   W <= gamma P_a W + G_a for every surviving pair: no policy that stays in C u A and
                 has finite weighted occupation costs less than m'W.
4. measure       mu >= 0, ||m - mu + gamma P_u'mu||_1 <= 1e-9 max(1, ||mu||_1): Lyapunov measure.
5. gap           m'(V_up - W) / m'V_up.
6. refusal       w >= 0, w != 0, w <= gamma P_a w for every surviving pair: the cells with w > 0
                 have no policy of finite occupation at this gamma.

A solver's status plays no part. A claim that almost holds is repaired or refused, never rounded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lmdsl import bounds, policy, rational, threads
from lmdsl.lp import StabilizationLP

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]

MEASURE_TOLERANCE = 1e-9
MANY = 10_000
"""Cells from which on two claims are judged in two threads."""
CLAIMS = ("stabilizing", "upper_bound", "lower_bound", "measure")


@dataclass(frozen=True)
class Certificate:
    """Proved facts about a policy.

    Attributes
    ----------
    stabilizing, upper_bound, lower_bound, measure
        Which claims hold.
    refusal
        True when it is proved that no policy is stabilizing at this gamma.
    contraction
        Proved bound on rho(g P_u), None where claim 1 does not hold.
    cost, lower, gap
        m'V_up rounded up, m'W rounded down, and the gap; None where not established.
    measure_residual
        ||m - mu + gamma P_u'mu||_1, rounded up; None where there is no mu.
    tolerance
        The gap asked for.
    reasons
        Why it is not verified, one sentence each; empty when verified.
    """

    stabilizing: bool
    upper_bound: bool
    lower_bound: bool
    measure: bool
    refusal: bool
    contraction: float | None
    cost: float | None
    lower: float | None
    gap: float | None
    measure_residual: float | None
    tolerance: float
    reasons: tuple[str, ...] = ()

    @property
    def verified(self) -> bool:
        """Claims 1 to 4 hold and the gap is within the tolerance."""
        claims = all(getattr(self, name) for name in CLAIMS)
        return claims and self.gap is not None and self.gap <= self.tolerance


@dataclass(frozen=True)
class Witness:
    """The vectors behind a certificate, on C, shape (n,) each.

    Attributes
    ----------
    pair
        The policy: a column per cell; None where nothing is claimed of one.
    w
        Vector of claim 1, or of the refusal; None where there is none.
    V_up, W, mu
        Vectors of claims 2 to 4; None where not established (W then counts as 0).
    """

    pair: Pairs | None
    w: Floats | None = None
    V_up: Floats | None = None
    W: Floats | None = None
    mu: Floats | None = None


@dataclass(frozen=True)
class Verified:
    """A certificate with its witness."""

    certificate: Certificate
    witness: Witness = field(repr=False)


# The checks: from vectors to yes or no ------------------------------------------------------


def check_stabilizing(lp: StabilizationLP, pair: Pairs, w: Floats) -> float | None:
    """Claim 1: return the proved contraction 1 - min d/w < 1, None where it does not hold."""
    d = bounds.decrease(lp, pair, w, lp.growth)
    if d is None or not len(w):
        return None
    share = float((d / w).min()) * (1 - 4 * bounds.UNIT)
    contraction = float(np.nextafter(1 - share, 2.0))
    return max(contraction, 0.0) if contraction < 1 else None


def check_upper(lp: StabilizationLP, pair: Pairs, V_up: Floats) -> bool:
    """Claim 2: V_up >= gamma P_u V_up + G_u and V_up >= 0."""
    if V_up.shape != (lp.n,) or not (np.isfinite(V_up).all() and (V_up >= 0).all()):
        return False
    future = bounds.expected_above(lp, pair, V_up, lp.gamma)
    return bool((V_up >= bounds.add_above(future, lp.cost[pair])).all())


def check_lower(lp: StabilizationLP, W: Floats) -> bool:
    """Claim 3: W <= gamma P_a W + G_a for every surviving pair."""
    if W.shape != (lp.n,) or not (np.isfinite(W).all() and (W >= 0).all()):
        return False
    return bounds.holds_for_all(lp, W, lp.gamma, lp.cost)


def check_measure(lp: StabilizationLP, pair: Pairs, mu: Floats) -> tuple[float, bool]:
    """Claim 4: return ||m - mu + gamma P_u'mu||_1 rounded up, and whether the claim holds.

    The residual is infinite where mu is not >= 0. Where rounding alone decides, or a number
    overflows, small models are summed exactly.
    """
    if mu.shape != (lp.n,) or not (np.isfinite(mu).all() and (mu >= 0).all()):
        return math.inf, False
    with np.errstate(over="ignore", invalid="ignore"):
        inflow, relative, absolute = bounds.inflow(lp, pair, mu, lp.gamma)
        rounding = relative * (lp.weight + mu + inflow) + absolute
        residual = np.abs((lp.weight - mu) + inflow)
        size = float(mu.sum()) * (1 - 70 * bounds.UNIT)
    finite = math.isfinite(size) and bool(np.isfinite(residual).all())
    allowed = MEASURE_TOLERANCE * max(1.0, size) * (1 - 4 * bounds.UNIT)
    bound = bounds.total_above(residual + rounding) if finite else math.inf
    if bound <= allowed < math.inf:
        return bound, True
    hopeful = not finite or bound - 2 * bounds.total_above(rounding) <= allowed
    entries = lp.rows.pointer[pair + 1] - lp.rows.pointer[pair]
    if hopeful and entries.sum() <= bounds.MAX_EXACT:
        policy_rows = (row for _, row in rational.rows(lp, pair))
        exactly = [*map(Fraction, mu.tolist())]
        found = rational.residual(lp, policy_rows, exactly)
        return rational.rounded_up(found), found <= allowed_residual(exactly)
    return bound, False


def allowed_residual(mu: list[Fraction]) -> Fraction:
    """Return the largest residual of claim 4 for a measure, exactly."""
    return Fraction(MEASURE_TOLERANCE) * max(Fraction(1), sum(mu, Fraction(0)))


def check_refusal(lp: StabilizationLP, w: Floats) -> bool:
    """Claim 6: w >= 0, w != 0 and w <= gamma P_a w for every surviving pair."""
    if w.shape != (lp.n,) or not (np.isfinite(w).all() and (w >= 0).all() and (w > 0).any()):
        return False
    return bounds.holds_for_all(lp, w, lp.gamma, None)


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
    pair = witness.pair
    V_up, W, mu, w = witness.V_up, witness.W, witness.mu, witness.w
    if pair is not None and not is_policy(lp, pair):
        pair = None
    contraction = cost = floor = None
    residual: tuple[float, bool] | None = None
    upper = False
    if pair is not None:
        under, own = lp.under(pair), np.arange(lp.n)

        def of_policy() -> tuple[float | None, bool]:
            proved = None if w is None else check_stabilizing(under, own, w)
            return proved, V_up is not None and check_upper(under, own, V_up)

        def of_measure() -> tuple[float, bool] | None:
            return None if mu is None else check_measure(under, own, mu)

        claims, residual = threads.both(of_policy, of_measure, lp.n >= MANY)
        contraction, upper = claims
    lower = W is not None and check_lower(lp, W)
    if upper and V_up is not None:
        cost = bounds.weighted(lp.weight, V_up, math.inf)
    if lower and W is not None:
        floor = bounds.weighted(lp.weight, W, -math.inf)
    certificate = Certificate(
        stabilizing=contraction is not None,
        upper_bound=upper,
        lower_bound=lower,
        measure=residual is not None and residual[1],
        refusal=pair is None and w is not None and check_refusal(lp, w),
        contraction=contraction,
        cost=cost,
        lower=floor,
        gap=gap(lp, V_up, W) if upper and lower else None,
        measure_residual=None if residual is None else residual[0],
        tolerance=tolerance,
    )
    return explained(lp, pair, certificate)


def weighted(lp: StabilizationLP, values: Floats) -> float:
    """Return m'values, rounded to nearest."""
    return bounds.total(lp.weight * values)


def is_policy(lp: StabilizationLP, pair: Pairs) -> bool:
    """Return whether an array names one column of every cell's own."""
    if pair.shape != (lp.n,) or not lp.n:
        return False
    return bool((pair >= lp.pair_pointer[:-1]).all() and (pair < lp.pair_pointer[1:]).all())


def explained(lp: StabilizationLP, pair: Pairs | None, certificate: Certificate) -> Certificate:
    """Return the certificate with the reasons why it is not verified."""
    reasons = []
    if certificate.refusal:
        reasons.append(f"proved: no policy has finite cost at gamma = {lp.gamma!r}")
    elif pair is None:
        reasons.append("there is no policy to verify")
    elif not certificate.stabilizing:
        reasons.append(_not_stabilizing(lp, pair))
    if pair is not None:
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
            )
    return replace(certificate, reasons=tuple(reasons))


def _not_stabilizing(lp: StabilizationLP, pair: Pairs) -> str:
    lost = int((~policy.reaches_attractor(lp, pair)).sum())
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
    cost = bounds.weighted(lp.weight, V_up, math.inf)
    if cost == 0:
        return 0.0
    width = bounds.weighted(lp.weight, np.maximum(V_up - W, 0.0), math.inf)
    return width / cost * (1 + 8 * bounds.UNIT)

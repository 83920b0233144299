"""Every claim of a certificate in rational arithmetic, without rounding."""

from __future__ import annotations

from fractions import Fraction

from lmdsl.certificate import exact_sums
from lmdsl.certificate.checks import (
    allowed_residual,
    explained,
    is_policy,
    is_sound,
    with_stated_gap,
)
from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.certificate.sums import LARGEST, rounded_down, rounded_up
from lmdsl.common.types import Check
from lmdsl.model.lp import StabilizationLP


def check_exactly(
    lp: StabilizationLP, witness: Witness, tolerance: float, check: Check | None = None
) -> Certificate:
    """Check every claim of a witness in rational arithmetic.

    Parameters
    ----------
    lp, witness, tolerance
        As for :func:`lmdsl.certificate.claims.check`; a claim that holds only with equality holds.
    check
        Called now and then; it may raise.
    """
    policy = (
        witness.policy if witness.policy is not None and is_policy(lp, witness.policy) else None
    )
    V_up, W, w, mu = (
        exact_sums.fractions(x) if x is not None and is_sound(lp, x) else None
        for x in (witness.V_up, witness.W, witness.w, witness.mu)
    )
    rows = None if policy is None else [row for _, row in exact_sums.rows(lp, policy, check)]
    contraction = cost = floor = residual = gap = None
    if rows is not None and policy is not None:
        if w is not None:
            contraction = exact_sums.contraction(lp, rows, w)
        if V_up is not None and exact_sums.above_policy(lp, rows, policy, V_up):
            cost = _mean(lp, V_up)
        if mu is not None:
            residual = exact_sums.residual(lp, rows, mu)
    if W is not None and exact_sums.below_all(lp, W, lp.cost, check):
        floor = _mean(lp, W)
    if cost is not None and cost > LARGEST:
        cost = None
    if cost is not None and floor is not None:
        gap = max((cost - floor) / cost, Fraction(0)) if cost else Fraction(0)
    certificate = Certificate(
        stabilizing=contraction is not None and contraction < 1,
        upper_bound=cost is not None,
        lower_bound=floor is not None,
        measure=residual is not None and mu is not None and residual <= allowed_residual(mu),
        refusal=policy is None
        and w is not None
        and any(w)
        and exact_sums.below_all(lp, w, None, check),
        contraction=None if contraction is None or contraction >= 1 else rounded_up(contraction),
        cost=None if cost is None else rounded_up(cost),
        lower=None if floor is None else rounded_down(floor),
        gap=None if gap is None else rounded_up(gap),
        measure_residual=None if residual is None else rounded_up(residual),
        tolerance=tolerance,
    )
    return explained(lp, policy, with_stated_gap(certificate))


def _mean(lp: StabilizationLP, values: list[Fraction]) -> Fraction:
    return sum(
        (Fraction(m) * x for m, x in zip(lp.weight.tolist(), values, strict=True)), Fraction(0)
    )

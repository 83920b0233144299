"""Every claim in rational arithmetic, without rounding: whether it holds, and its number.

A claim that holds only with equality holds. Numbers are rounded at the end, costs and residuals up,
the lower bound down.
"""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

from lmdsl.certificate import exact_sums
from lmdsl.certificate.checks import allowed_residual
from lmdsl.certificate.claims import NOTHING, Found
from lmdsl.certificate.sums import LARGEST, rounded_down, rounded_up
from lmdsl.common.types import Guard, Policy
from lmdsl.model.lp import StabilizationLP

Fractions = list[Fraction]


@dataclass(frozen=True, eq=False)
class ExactModel:
    """A model with the rows of a policy read once; ``guard`` is called now and then."""

    lp: StabilizationLP
    policy: Policy
    rows: list[exact_sums.Row]
    guard: Guard | None


ExactCheck = Callable[[ExactModel, Fractions], Found]


def stabilizing(model: ExactModel, w: Fractions) -> Found:
    """Claim 1, and the contraction."""
    found = exact_sums.contraction(model.lp, model.rows, w)
    return NOTHING if found is None or found >= 1 else Found(True, rounded_up(found))


def upper_bound(model: ExactModel, V_up: Fractions) -> Found:
    """Claim 2, and m'V_up."""
    if not exact_sums.above_policy(model.lp, model.rows, model.policy, V_up):
        return NOTHING
    cost = mean(model.lp, V_up)
    return NOTHING if cost > LARGEST else Found(True, rounded_up(cost))


def lower_bound(model: ExactModel, W: Fractions) -> Found:
    """Claim 3, and m'W."""
    if not exact_sums.below_all(model.lp, W, model.lp.cost, model.guard):
        return NOTHING
    return Found(True, rounded_down(mean(model.lp, W)))


def measure(model: ExactModel, mu: Fractions) -> Found:
    """Claim 4, and its residual."""
    residual = exact_sums.residual(model.lp, model.rows, mu)
    return Found(residual <= allowed_residual(mu), rounded_up(residual))


def refusal(model: ExactModel, w: Fractions) -> Found:
    """Claim 6."""
    return Found(any(w) and exact_sums.below_all(model.lp, w, None, model.guard))


def gap(lp: StabilizationLP, V_up: Fractions, W: Fractions) -> float:
    """Return the gap of claim 5, rounded up."""
    cost = mean(lp, V_up)
    return rounded_up(max((cost - mean(lp, W)) / cost, Fraction(0)) if cost else Fraction(0))


def mean(lp: StabilizationLP, values: Fractions) -> Fraction:
    """Return m'values."""
    return sum(
        (Fraction(m) * x for m, x in zip(lp.weight.tolist(), values, strict=True)), Fraction(0)
    )

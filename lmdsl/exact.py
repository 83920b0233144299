"""Every claim in rational arithmetic: no rounding, no tolerance on claims 1 to 3.

A double is an integer times a power of two and a transition is numerator / total, so each
inequality becomes one between integers. Written for clarity: a few microseconds per transition.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl import rational
from lmdsl.certificate import (
    Certificate,
    Witness,
    allowed_residual,
    explained,
    is_policy,
)
from lmdsl.lp import StabilizationLP
from lmdsl.rational import Row, integers, rounded_up

Floats = NDArray[np.float64]


def check_exactly(lp: StabilizationLP, witness: Witness, tolerance: float) -> Certificate:
    """Check every claim of a witness in rational arithmetic.

    Parameters
    ----------
    lp, witness, tolerance
        As for :func:`lmdsl.certificate.check`; a claim that holds only with equality holds.
    """
    pair = witness.pair if witness.pair is not None and is_policy(lp, witness.pair) else None
    V_up, W, w, mu = (_exact(lp, x) for x in (witness.V_up, witness.W, witness.w, witness.mu))
    rows = None if pair is None else [row for _, row in rational.rows(lp, pair)]
    contraction = None if rows is None or w is None else _contraction(lp, rows, w)
    cost = floor = None
    if rows is not None and pair is not None and V_up is not None and _upper(lp, rows, pair, V_up):
        cost = _mean(lp, V_up)
    if W is not None and _below_all(lp, W, lp.cost):
        floor = _mean(lp, W)
    residual = None if rows is None or mu is None else rational.residual(lp, rows, mu)
    gap = None
    if cost is not None and floor is not None:
        gap = (cost - floor) / cost if cost else Fraction(0)
    certificate = Certificate(
        stabilizing=contraction is not None and contraction < 1,
        upper_bound=cost is not None,
        lower_bound=floor is not None,
        measure=residual is not None and mu is not None and residual <= allowed_residual(mu),
        refusal=pair is None and w is not None and any(w) and _below_all(lp, w, None),
        contraction=None if contraction is None or contraction >= 1 else rounded_up(contraction),
        cost=None if cost is None else rounded_up(cost),
        lower=None if floor is None else -rounded_up(-floor),
        gap=None if gap is None else max(rounded_up(gap), 0.0),
        measure_residual=None if residual is None else rounded_up(residual),
        tolerance=tolerance,
    )
    return explained(lp, pair, certificate)


def _exact(lp: StabilizationLP, x: Floats | None) -> list[Fraction] | None:
    """Return the doubles of a vector >= 0 as fractions, None where it is not one."""
    if x is None or x.shape != (lp.n,) or not (np.isfinite(x) & (x >= 0)).all():
        return None
    return [Fraction(value) for value in x.tolist()]


def _mean(lp: StabilizationLP, values: list[Fraction]) -> Fraction:
    return sum(
        (Fraction(m) * x for m, x in zip(lp.weight.tolist(), values, strict=True)), Fraction(0)
    )


def _contraction(lp: StabilizationLP, rows: list[Row], w: list[Fraction]) -> Fraction | None:
    """Return max g (P_u w) / w exactly: below 1 it proves claim 1; None unless w > 0."""
    if not all(w):
        return None
    a, _ = integers(w)
    worst = max(
        (Fraction(sum(a[j] * s for j, s in row), a[i]) for i, row in enumerate(rows)),
        default=Fraction(0),
    )
    return Fraction(lp.growth) * worst / lp.rows.shares.total


def _upper(lp: StabilizationLP, rows: Any, pair: NDArray[np.int64], V_up: Any) -> bool:
    a, shift = integers(V_up)
    scale, total = Fraction(lp.gamma), lp.rows.shares.total
    cost = lp.cost[pair].tolist()
    return all(
        a[i] >= scale * sum(a[j] * s for j, s in row) / total + Fraction(cost[i]) * 2**shift
        for i, row in enumerate(rows)
    )


def _below_all(lp: StabilizationLP, x: list[Fraction], cost: Floats | None) -> bool:
    """Decide x <= gamma P_a x + G_a for every surviving pair."""
    a, shift = integers(x)
    p, q = lp.gamma.as_integer_ratio()
    total = lp.rows.shares.total
    left = [value * q * total for value in a]
    unit = q * total * 2**shift
    for k, row in rational.rows(lp, np.arange(lp.K, dtype=np.int64)):
        lacking = left[lp.cell[k]] - p * sum(a[j] * s for j, s in row)
        if lacking > 0 and (cost is None or lacking > Fraction(float(cost[k])) * unit):
            return False
    return True

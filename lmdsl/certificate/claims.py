"""The certificate: what "verified" means, computed from the finite model and the policy alone.

With u the policy, P_u, G_u its rows, g = max(gamma, 1), claims 1 to 6 are inequalities between
stored doubles that hold in exact arithmetic (see bounds.py):

1. stabilizing   w > 0, w >= g P_u w + d with d > 0. Then rho(g P_u) <= 1 - min d/w < 1: from every
                 cell of C the chain reaches A (or, discounted, ends) almost surely, geometrically.
2. upper bound   V_up >= gamma P_u V_up + G_u, V_up >= 0: the policy costs at most m'V_up.
3. lower bound   W <= gamma P_a W + G_a for every surviving pair: no policy that stays in C u A and
                 has finite weighted occupation costs less than m'W.
4. measure       mu >= 0, ||m - mu + gamma P_u'mu||_1 <= 1e-9 max(1, ||mu||_1): Lyapunov measure.
5. gap           m'(V_up - W) / m'V_up.
6. refusal       w >= 0, w != 0, w <= gamma P_a w for every surviving pair: the cells with w > 0
                 have no policy of finite occupation at this gamma.

7. safe          where successors are enclosed: all that the image of a whole cell can meet under
                 the policy lies in C u A (successors/inclusion.py), so no run of the map is lost.

A solver's status plays no part. A claim that almost holds is repaired or refused, never rounded.
"""

from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple

from lmdsl.common.html import grid
from lmdsl.common.records import jsonable
from lmdsl.common.types import Floats, Policy

# Of claim 7: proved or not, under constants that are only promised, or not claimed (None).
Safe = bool | Literal["assumed"] | None

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
    assumes
        On what every claim rests beside the finite model; empty where on nothing.
    safe
        Claim 7; None where successors are not enclosed, or nothing is claimed of a policy;
        ``"assumed"`` where it rests on Lipschitz constants of a Python function: that is no proof.
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
    assumes: str = ""
    safe: Safe = None

    @property
    def verified(self) -> bool:
        """Claims 1 to 4 hold, and 7 where it is made, and the gap is within the tolerance."""
        claims = self.stabilizing and self.upper_bound and self.lower_bound and self.measure
        claims = claims and self.safe is not False
        return claims and self.gap is not None and self.gap <= self.tolerance

    def __str__(self) -> str:
        if not self.verified:
            return "; ".join(self.reasons)
        rests = f", assuming that {self.assumes}" if self.assumes else ""
        safe = "; that no run is lost is assumed, not proved" * (self.safe == "assumed")
        return f"verified, gap {self.gap:.2g}{rests}{safe}"

    @property
    def claims(self) -> dict[str, Safe]:
        """Which claims hold, by name; None is one that is not made."""
        kinds = (bool, Safe)
        return {f.name: getattr(self, f.name) for f in fields(self) if f.type in kinds}

    def _repr_html_(self) -> str:
        words = {True: "holds", False: "not proved", None: "not made", "assumed": "assumed"}
        numbers = {"stabilizing": ("contraction", self.contraction),
                   "upper_bound": ("cost at most", self.cost),
                   "lower_bound": ("any policy costs at least", self.lower),
                   "measure": ("residual", self.measure_residual)}  # fmt: skip
        rows = []
        for claim, holds in self.claims.items():
            name, value = numbers.get(claim, ("", None))
            holds = holds or (None if claim == "refusal" else holds)  # none is aimed at as a rule
            rows.append((claim, words[holds], "" if value is None else f"{name} {value:.9g}"))
        return grid(("claim", "", ""), rows, "Certificate", str(self))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; ``verified`` first, then the attributes."""
        values: dict[str, Any] = jsonable({**vars(self), "reasons": list(self.reasons)})
        return {"verified": self.verified, **values}


@dataclass(frozen=True, eq=False)
class Witness:
    """The vectors behind a certificate, on C, shape (n,) each.

    Attributes
    ----------
    policy
        The policy: a column per cell; None where nothing is claimed of one.
    w
        Vector of claim 1; None where not established.
    V_up, W, mu
        Vectors of claims 2 to 4; None where not established (W then counts as 0).
    refusal
        Vector of the refusal; None where nothing is refused.
    """

    policy: Policy | None
    w: Floats | None = None
    V_up: Floats | None = None
    W: Floats | None = None
    mu: Floats | None = None
    refusal: Floats | None = None


@dataclass(frozen=True, eq=False)
class Verified:
    """A certificate with its witness."""

    certificate: Certificate
    witness: Witness = field(repr=False)


class Found(NamedTuple):
    """Whether a claim holds, and the number that goes with it."""

    holds: bool
    number: float | None = None


NOTHING = Found(False)

"""The claims, one object each, and the judges: a witness in, a certificate out."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np

from lmdsl.certificate import checks, exact_checks, exact_sums, safety, sums
from lmdsl.certificate.claims import NOTHING, Certificate, Found, Witness
from lmdsl.common.types import Floats, Guard, Policy
from lmdsl.machine import threads
from lmdsl.model.algorithm_1 import reaches_attractor
from lmdsl.model.lp import StabilizationLP

PARALLEL_FROM = 10_000  # number of cells from which on two claims are judged in two threads


class About(Enum):
    """What a claim speaks of."""

    POLICY = "a policy"
    PAIRS = "all surviving pairs"
    NO_POLICY = "all surviving pairs, where there is no policy"


class OnTrial(NamedTuple):
    """What sentences say of a model and a policy that are judged."""

    gamma: float
    cells: int  # of C
    lost: Callable[[], int]  # number of cells from which the policy never reaches the attractor


@dataclass(frozen=True, eq=False)
class Claim:
    """A claim: an inequality between stored doubles (see claims.py)."""

    name: str  # the field of the certificate that says whether it holds
    about: About  # what it speaks of; a claim of a policy is checked on the model under it
    vector: str  # the field of the witness that proves it
    # check, check_exactly: whether a vector proves it, and its number: with bounds of rounding, and
    # in rationals
    check: Callable[[StabilizationLP, Policy, Floats], Found]
    check_exactly: exact_checks.ExactCheck
    # the reason it gives in a certificate: where it does not hold; a refusal, where it does
    sentence: Callable[["OnTrial", float | None], str]
    number: str | None = None  # the field of the certificate for its number


def _stabilizing(lp: StabilizationLP, policy: Policy, w: Floats) -> Found:
    contraction = checks.check_stabilizing(lp, policy, w)
    return Found(contraction is not None, contraction)


def _upper_bound(lp: StabilizationLP, policy: Policy, V_up: Floats) -> Found:
    if not checks.check_upper(lp, policy, V_up):
        return NOTHING
    cost = sums.weighted(lp.weight, V_up, math.inf)
    return Found(True, cost) if cost < math.inf else NOTHING


def _lower_bound(lp: StabilizationLP, policy: Policy, W: Floats) -> Found:
    if not checks.check_lower(lp, W):
        return NOTHING
    return Found(True, sums.weighted(lp.weight, W, -math.inf))


def _measure(lp: StabilizationLP, policy: Policy, mu: Floats) -> Found:
    residual, holds = checks.check_measure(lp, policy, mu)
    return Found(holds, residual)


def _not_stabilizing(judged: OnTrial, number: float | None) -> str:
    lost = judged.lost()
    text = f"from {lost} of {judged.cells} cells the policy never reaches the attractor"
    if lost and judged.gamma < 1:
        return (
            f"{text}: at gamma = {judged.gamma!r} < 1 staying away can be cheaper than going; "
            "raise gamma to 1"
        )
    if lost:
        return text
    return "no contraction of the policy could be proved: the numbers do not allow it"


def _no_measure(judged: OnTrial, residual: float | None) -> str:
    text = "the Lyapunov measure could not be established"
    if residual is None:
        return text
    return (
        f"{text}: its residual is {residual:.2g}, above 1e-9 of its size; the numbers no longer "
        "allow it, lower gamma"
    )


STABILIZING = Claim(
    "stabilizing", About.POLICY, "w", _stabilizing, exact_checks.stabilizing, _not_stabilizing,
    "contraction",
)  # fmt: skip
UPPER_BOUND = Claim(
    "upper_bound", About.POLICY, "V_up", _upper_bound, exact_checks.upper_bound,
    lambda *_: "no upper bound on the cost of the policy could be established", "cost",
)  # fmt: skip
LOWER_BOUND = Claim(
    "lower_bound", About.PAIRS, "W", _lower_bound, exact_checks.lower_bound,
    lambda *_: "no lower bound on the optimal cost could be established", "lower",
)  # fmt: skip
MEASURE = Claim(
    "measure", About.POLICY, "mu", _measure, exact_checks.measure, _no_measure,
    "measure_residual",
)  # fmt: skip
REFUSAL = Claim(
    "refusal", About.NO_POLICY, "refusal",
    lambda lp, _, w: Found(checks.check_refusal(lp, w)), exact_checks.refusal,
    lambda judged, _: f"proved: no policy has finite cost at gamma = {judged.gamma!r}",
)  # fmt: skip
# In the order of certificate.json.
CLAIMS = (STABILIZING, UPPER_BOUND, LOWER_BOUND, MEASURE, REFUSAL)


def verdict(lp: StabilizationLP, witness: Witness, tolerance: float) -> Certificate:
    """Check every claim of a witness, nothing of which is trusted, against the finite model.

    ``tolerance`` is the largest gap that counts as verified.
    """
    policy, own = _policy(lp, witness), np.arange(lp.n)
    under = lp if policy is None else lp.under(policy)

    def judged(*claims: Claim) -> dict[str, Found]:
        return {
            claim.name: claim.check(under if claim.about is About.POLICY else lp, own, x)
            for claim in claims
            if (x := getattr(witness, claim.vector)) is not None
        }

    asked = _asked(policy is None)
    first = [claim for claim in asked if claim.about is About.POLICY]
    half = len(first) - len(first) // 2
    found: dict[str, Found] = {}
    for part in threads.both(
        lambda: judged(*first[:half]), lambda: judged(*first[half:]), lp.n >= PARALLEL_FROM
    ):
        found |= part
    found |= judged(*(claim for claim in asked if claim not in first))
    known = _holds(found, UPPER_BOUND) and _holds(found, LOWER_BOUND)
    gap = checks.gap(lp, witness.V_up, witness.W) if known else None
    unsafe = safety.unproved(lp, policy)
    return certificate(lp, policy is None, found, gap, tolerance, unsafe, _judged(lp, policy))


def exact_verdict(
    lp: StabilizationLP, witness: Witness, tolerance: float, guard: Guard | None = None
) -> Certificate:
    """Check every claim of a witness in rational arithmetic; ``guard`` may raise now and then.

    A claim that holds only with equality holds.
    """
    policy = _policy(lp, witness)
    columns = np.empty(0, dtype=np.int64) if policy is None else policy
    rows = [row for _, row in exact_sums.rows(lp, columns, guard)]
    model = exact_checks.ExactModel(lp, columns, rows, guard)
    vectors = {
        name: exact_sums.fractions(x)
        for name in {claim.vector for claim in CLAIMS}
        if (x := getattr(witness, name)) is not None and checks.is_sound(lp, x)
    }
    found = {
        claim.name: claim.check_exactly(model, vectors[claim.vector])
        for claim in _asked(policy is None)
        if claim.vector in vectors
    }
    known = _holds(found, UPPER_BOUND) and _holds(found, LOWER_BOUND)
    gap = exact_checks.gap(lp, vectors["V_up"], vectors["W"]) if known else None
    unsafe = safety.unproved(lp, policy, guard)
    return certificate(lp, policy is None, found, gap, tolerance, unsafe, _judged(lp, policy))


def _policy(lp: StabilizationLP, witness: Witness) -> Policy | None:
    policy = witness.policy
    return policy if policy is not None and checks.is_policy(lp, policy) else None


def _judged(lp: StabilizationLP, policy: Policy | None) -> OnTrial:
    def lost() -> int:
        return 0 if policy is None else int((~reaches_attractor(lp, policy)).sum())

    return OnTrial(lp.gamma, lp.n, lost)


def _asked(policyless: bool) -> list[Claim]:
    other = About.POLICY if policyless else About.NO_POLICY
    return [claim for claim in CLAIMS if claim.about is not other]


def _holds(found: Mapping[str, Found], claim: Claim) -> bool:
    return found.get(claim.name, NOTHING).holds


def certificate(
    lp: StabilizationLP, policyless: bool, found: Mapping[str, Found], gap: float | None,
    tolerance: float, unsafe: int | None, judged: OnTrial,
) -> Certificate:  # fmt: skip
    """Return what was found, with the reasons why it is not verified.

    ``unsafe`` is the number of cells of which claim 7 is not proved; None where it is not made.
    """
    holds = {claim.name: _holds(found, claim) for claim in CLAIMS}
    numbers = {
        claim.number: found.get(claim.name, NOTHING).number for claim in CLAIMS if claim.number
    }
    cost, lower = numbers["cost"], numbers["lower"]
    if gap is not None and cost is not None and lower is not None:
        gap = sums.stated_gap(gap, cost, lower)
    reasons = []
    if holds["refusal"]:
        reasons.append(REFUSAL.sentence(judged, None))
    elif policyless:
        reasons.append("there is no policy to verify")
    else:
        reasons += [
            claim.sentence(judged, found.get(claim.name, NOTHING).number)
            for claim in _asked(policyless)
            if not holds[claim.name]
        ]
        if gap is not None and gap > tolerance:
            reasons.append(
                f"the gap {gap:.3g} is above the tolerance {tolerance:.3g}" + _too_small(cost)
            )
        if unsafe:
            reasons.append(safety.sentence(judged.cells, unsafe))
    said: dict[str, Any] = {**holds, **numbers}
    assumes = lp.problem.system.assumes
    return Certificate(
        **said, gap=gap, tolerance=tolerance, reasons=tuple(reasons), assumes=assumes,
        safe=safety.claim(lp, unsafe),
    )  # fmt: skip


def _too_small(cost: float | None) -> str:
    if cost is None or not cost < sums.NORMAL:
        return ""
    return (
        f": the cost {cost!r} is below the normal range of doubles, which are coarse there; "
        "multiply stage_cost by a power of ten"
    )

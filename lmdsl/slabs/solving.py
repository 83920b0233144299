"""Policy iteration over ranks: passes by all, evaluation by rank 0, judged by all.

What must hold: with 1, 2 and 4 ranks every pass, and so every policy on the way, is the same to the
bit, because cells see new values within the ranges of the model only; with other numbers of ranks
the last policy is the same, as ties are broken by rule.
"""

import time
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.common.types import Floats, Policy, TimeUp, never
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.checkpoints import Checkpoints, Unfinished
from lmdsl.optimize.policies import ties
from lmdsl.optimize.policies.iteration import TIE
from lmdsl.optimize.policies.screening import Screen
from lmdsl.slabs import beginning, below, judging
from lmdsl.slabs.chains.evaluating import MOST_GATHERED, Evaluator, evaluator
from lmdsl.slabs.chains.first import First
from lmdsl.slabs.gamma import refusing
from lmdsl.slabs.iterating import iterated


@dataclass(frozen=True, eq=False)
class Solved:
    """The answer on own cells: policy and vectors; the certificate is that of all ranks."""

    witness: Witness
    certificate: Certificate
    steps: int  # improvement steps that changed the policy
    judged: float  # seconds that judging took


def solved(
    lp: StabilizationLP, tolerance: float = 1e-6, time_up: TimeUp = never,
    gathered: int = MOST_GATHERED, kept: Unfinished | None = None,
    keeping: Checkpoints | None = None,
) -> Solved | None:  # fmt: skip
    """Solve a model that is spread over ranks; None where it is not decided. Collective.

    Where no first policy is found it is tried to prove that there is none.

    Policies of up to ``gathered`` cells are evaluated by rank 0, others by all ranks.
    The search begins at a policy that was ``kept``, where that serves; ``keeping`` keeps it.
    """
    first = First(lp)
    if not first.mesh.division.cells:
        return None
    time_up = first.mesh.ranks.time_up(time_up)
    by = evaluator(lp, gathered, time_up)
    begun = beginning.continued(first, by, kept) or beginning.soon(first, by)
    if begun is None:
        w = refusing.refusal(lp, time_up)
        if w is not None:
            return _judged(lp, Witness(None, refusal=w), tolerance, 0)
        begun = beginning.raised(lp, by, gathered, time_up)
    if begun is None:
        return None
    keep = None if keeping is None else partial(keeping.keep, lp)
    policy, V, screen, steps = iterated(first, by, *begun, time_up, keep)
    policy, value = _ties_broken(first, by, policy, V, screen, tolerance)
    if keep is not None:
        keep(policy, value, last=True)
    witness = by.witness(policy, value, tolerance)
    found = _judged(lp, witness, tolerance, steps)
    gap = found.certificate.gap
    if gap is None or gap > tolerance:  # the same on every rank
        W = below.lower_vector(lp, value, tolerance, time_up)
        again = _judged(lp, replace(witness, W=W), tolerance, steps)
        found = replace(again, judged=found.judged + again.judged)
    return found


def _judged(lp: StabilizationLP, witness: Witness, tolerance: float, steps: int) -> Solved:
    """Return an answer with the certificate that judging it gives; collective."""
    started = time.perf_counter()
    certificate = judging.verdict(lp, witness, tolerance)
    return Solved(witness, certificate, steps, time.perf_counter() - started)


def _ties_broken(
    first: First, by: Evaluator, policy: Policy, V: Floats, screen: Screen, tolerance: float
) -> tuple[Policy, Floats]:
    """Break ties by the rule of one process, among the tied columns alone, on rank 0."""
    lp, ranks = first.lp, first.mesh.ranks
    tied, chosen, several = screen.tied(V, TIE, policy)
    if ranks.any(several):
        model, value = first.model(np.flatnonzero(tied)), first.gathered(V)
        counts = ranks.collect(int(tied.sum()))
        place = np.searchsorted(np.flatnonzero(tied), [policy, chosen])
        at = first.gathered(place[0] + sum(counts[: ranks.rank]))

        def column() -> Policy:
            assert model is not None
            return ties.canonical(model, at, value, None)

        found = ranks.agreed(lambda: column() if first.here else None)
        chosen = first.chosen(tied, found)
    if not ranks.any(bool((chosen != policy).any())):
        return policy, V
    better = by.bound(chosen, None)
    if better is None:
        return policy, V
    value = by.value(chosen, V)
    cost = [sum(ranks.collect(float((lp.weight * x).sum()))) for x in (value, V)]
    return (chosen, value) if cost[0] <= (1 + tolerance / 4) * cost[1] else (policy, V)

"""Policy iteration over ranks: passes by all, evaluation by rank 0, judged by all.

What must hold: with 1, 2 and 4 ranks every pass, and so every policy on the way, is the same to the
bit, because cells see new values within the ranges of the model only; with other numbers of ranks
the last policy is the same, as ties are broken by rule.
"""

from dataclasses import dataclass, replace

import numpy as np

from lmdsl.certificate.claims import Certificate, Witness
from lmdsl.common.types import Floats, Policy, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.policies import bellman, ties
from lmdsl.optimize.policies.iteration import TIE
from lmdsl.optimize.policies.screening import Screen, _least_ratio
from lmdsl.ranks.verbs import RankError
from lmdsl.slabs import below, judging, refusing
from lmdsl.slabs.chains.evaluating import MOST_GATHERED, ByAll, ByFirst, Evaluator
from lmdsl.slabs.chains.first import First

RISE, TINY = 1e-9, 1e-300  # relative rise of a value up to which it is rounding


@dataclass(frozen=True, eq=False)
class Solved:
    """The answer on own cells: policy and vectors; the certificate is that of all ranks."""

    witness: Witness
    certificate: Certificate
    steps: int  # improvement steps that changed the policy


def solved(
    lp: StabilizationLP, tolerance: float = 1e-6, time_up: TimeUp = never,
    gathered: int = MOST_GATHERED,
) -> Solved | None:  # fmt: skip
    """Solve a model that is spread over ranks; None where it is not decided. Collective.

    Where no first policy is found it is tried to prove that there is none.

    Policies of up to ``gathered`` cells are evaluated by rank 0, others by all ranks.
    """
    first = First(lp)
    if not first.mesh.division.cells:
        return None
    time_up = first.mesh.ranks.time_up(time_up)
    small = first.mesh.division.cells <= gathered
    by: Evaluator = ByFirst(first) if small else ByAll(lp, time_up)
    begun = _begin(first, by)
    if begun is None:
        w = refusing.refusal(lp, time_up)
        witness = Witness(None, refusal=w)
        return None if w is None else Solved(witness, judging.verdict(lp, witness, tolerance), 0)
    policy, V, screen, steps = _iterated(first, by, *begun, time_up)
    policy, value = _ties_broken(first, by, policy, V, screen, tolerance)
    witness = by.witness(policy, value, tolerance)
    certificate = judging.verdict(lp, witness, tolerance)
    if certificate.gap is None or certificate.gap > tolerance:  # the same on every rank
        W = below.lower_vector(lp, value, tolerance, time_up)
        witness = replace(witness, W=W)
        certificate = judging.verdict(lp, witness, tolerance)
    return Solved(witness, certificate, steps)


def _begin(first: First, by: Evaluator) -> tuple[Policy, Floats] | None:
    """Return a g-stabilizing policy and V >= T_u V: greedy in a few passes, or Algorithm 1's."""
    lp, ranks = first.lp, first.mesh.ranks
    level, tree = lp._algorithm_1
    V = level.astype(np.float64)
    few = max(ranks.collect(int(level.max(initial=0)))) <= first_policy.NEAR
    for k in range(4 if few else 0):
        better = bellman.rise(lp, V, lp.growth, k % 2 == 1)
        V = better.value
        found = by.bound(better.policy, V) if k in (0, 3) else None
        if found is not None:
            return better.policy, found
    found = by.bound(tree, None)
    return None if found is None else (tree, found)


def _iterated(
    first: First, by: Evaluator, policy: Policy, V: Floats, time_up: TimeUp
) -> tuple[Policy, Floats, Screen, int]:
    """Improve a policy until no control is better; return the last, its value, and the steps.

    As :func:`lmdsl.optimize.policies.iteration.iterate`: while policies change a lower V >= T_u V
    will do; only one evaluated to the end is returned.
    """
    lp, ranks = first.lp, first.mesh.ranks
    screen, steps = Screen(lp), 0
    last: tuple[Policy, Floats] | None = None
    while True:
        done = screen.improve(V, policy, TIE)
        changed = sum(ranks.collect(done.changed))
        if last is not None and (not changed or time_up()):
            return *last, screen, steps
        steps += changed > 0
        lower = by.lower(done.policy, done.value) if changed and not time_up() else None
        before, last = last, None
        if lower is None:
            try:
                lower = by.value(done.policy, done.value)
            except Stopped:  # on all ranks
                return *(before or (policy, V)), screen, steps
            _require_fallen(first, V, lower)
            if before is not None and not ranks.any(bool((lower < before[1]).any())):
                return *before, screen, steps  # rounding made a change look better than it is
            last = done.policy, lower
        ratio = min(ranks.collect(_least_ratio(V, np.minimum(lower, V))))
        screen.follow(np.ones(1), np.array([ratio]))
        policy, V = done.policy, lower


def _require_fallen(first: First, before: Floats, after: Floats) -> None:
    """Refuse a value that rose: where V >= T_u V that of u is below V, so that a halo was wrong."""
    rose = np.flatnonzero(after > before * (1 + RISE) + TINY)
    if first.mesh.ranks.any(len(rose) > 0):
        raise RankError("a policy that looked better is worse: ranks saw wrong values of others")


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

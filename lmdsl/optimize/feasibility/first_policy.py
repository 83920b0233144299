"""A first stabilizing policy for a gamma, or a proof that there is none."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.common.on_disk import filled
from lmdsl.common.types import Floats, Policy, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.feasibility import spectral_radius
from lmdsl.optimize.feasibility.stopping import optimal_stopping
from lmdsl.optimize.linear import equations
from lmdsl.optimize.linear.gauss_seidel import TOLERANCE
from lmdsl.optimize.policies import bellman
from lmdsl.optimize.policies.evaluation import peeled, stability_vector
from lmdsl.optimize.policies.iteration import iterate

# Number of sweeps after which a proof is given up unless they moved it much less than the ones
# before, and of rounds of them.
SWEEPS, MOST_ROUNDS = 30, 8

NEAR = 64  # largest level above which a few passes from the levels hardly make a stabilizing policy


@dataclass(frozen=True, eq=False)
class Feasible:
    """A g-stabilizing policy, and a proof of it: w > 0 with w > g P_u w; its value if known."""

    policy: Policy
    w: Floats
    value: Floats | None = None


@dataclass(frozen=True, eq=False)
class Refused:
    """A candidate proof that no policy is gamma-stabilizing: w >= 0, w <= gamma P_a w for all a.

    ``best`` is a policy that is stabilizing at ``lower`` < gamma.
    """

    w: Floats
    best: spectral_radius.PolicyClasses
    lower: float


@dataclass(frozen=True, eq=False)
class Undecided:
    """gamma is so close to its limit that doubles decide neither way, or time ran out.

    ``policy`` is a policy that is stabilizing at ``lower`` < gamma.
    """

    policy: Policy
    lower: float


def _proved(lp: StabilizationLP, policy: Policy, w: Floats, time_up: TimeUp) -> Floats | None:
    """Make of a guess a proof that a policy is g-stabilizing; None where it takes too long.

    Where its own value is soon known and every cost positive, it is the proof; else the guess is
    swept towards the unit-cost value, as long as that is in sight. Else 1 serves where all rows
    lose mass.
    """
    rows, cost = peeled(lp, policy, lp.growth), lp.cost[policy]

    def proves(guess: Floats) -> bool:
        return bounds.decrease(lp, policy, guess, lp.growth) is not None

    def even() -> Floats | None:
        ones = np.ones(lp.n)
        return ones if proves(ones) else None

    positive_cost = rows.small and bool((cost > 0).all())
    for used_cost in (cost, np.ones(lp.n)) if positive_cost else (np.ones(lp.n),):
        proof, before = w.copy(), np.inf
        for _ in range(MOST_ROUNDS):
            left = equations.advance(rows, used_cost, proof, SWEEPS, 0.0, 0.25)
            if left == np.inf:
                return even()
            if proves(proof):
                return proof
            if left > 0.3 * before or left <= TOLERANCE:
                break
            if time_up():
                raise Stopped
            before = left
        if left > TOLERANCE and equations.lift(rows, used_cost, proof) and proves(proof):
            return proof
    return even()


def stabilizing(lp: StabilizationLP, time_up: TimeUp = never) -> Feasible | Refused | Undecided:
    """Find a policy that is stabilizing with weight g = max(gamma, 1), or a proof against it.

    Candidates are the greedy policies of value iteration under unit cost from the levels of
    Algorithm 1, which lie below it, where these are few, then optimal policies under unit cost at
    gamma = 1 - 1/h, at which no policy costs more than h. Where none does, gamma is raised in
    steps, each below the limit of the last policy (unit cost, because under a cost with zeros this
    can stall).
    """
    reached: Feasible | Refused | Undecided = Undecided(lp._algorithm_1[1], 0.0)
    try:
        for reached in _raising(lp, time_up):
            if not isinstance(reached, Undecided):
                break
    except Stopped:
        pass
    return reached


def _raising(lp: StabilizationLP, time_up: TimeUp) -> Iterator[Feasible | Refused | Undecided]:
    """Raise gamma step by step; yield what is known after each, the decision last."""
    swept = _swept(lp, time_up)
    if swept is not None:
        yield swept
        return
    level, policy = lp._algorithm_1
    unit, asked = filled(lp.cost, 1.0), lp.growth == 1
    for horizon in (4.0 * level.max(), 64.0 * level.max()):
        at, value = 1 - 1 / horizon, np.full(lp.n, horizon)
        for _ in range(4):
            done = iterate(lp, policy, value, at, unit, time_up=time_up, limit=6)
            policy, value = done.policy, done.value
            w = _proved(lp, policy, value, time_up)
            yield Undecided(policy, at) if w is None else Feasible(policy, w)
            if time_up():
                return
            if not asked:
                asked, decided = True, _decided(lp, time_up)
                yield decided
                if not isinstance(decided, Undecided):
                    return
            if done.converged:
                break
    for _ in range(200):
        done = iterate(lp, policy, value, at, unit, time_up=time_up)
        policy, value = done.policy, done.value
        yield Undecided(policy, at)
        w, _ = stability_vector(lp, policy, time_up=time_up)
        if w is not None:
            yield Feasible(policy, w)
            return
        if time_up():
            return
        at, raised = _raised(lp, policy, at, time_up)
        if raised is None:
            return
        value = raised
        yield Undecided(policy, at)


def _swept(lp: StabilizationLP, time_up: TimeUp) -> Feasible | None:
    """Return a greedy policy of a few passes of value iteration, None where none is proved."""
    level, _ = lp._algorithm_1
    V = level.astype(np.float64)
    for k in range(4 if level.max() <= NEAR else 0):
        better = bellman.rise(lp, V, lp.growth, k % 2 == 1)
        V = better.value
        w = _proved(lp, better.policy, V, time_up) if k in (0, 3) else None
        if w is not None:
            return Feasible(better.policy, w)
    return None


def _raised(
    lp: StabilizationLP, policy: Policy, at: float, time_up: TimeUp
) -> tuple[float, Floats | None]:
    """Raise gamma as far towards g as a policy allows; return it, and a proof if it was raised.

    By bisection from above: of exponents, as long as g is out of sight.
    """
    reach, raised = lp.growth, None
    while raised is None and reach > at * (1 + 1e-13):
        far = reach > 4 * at
        reach = math.sqrt(at) * math.sqrt(reach) if far else at + (reach - at) / 2
        raised, _ = stability_vector(lp, policy, g=reach, time_up=time_up)
    return reach, raised


def _decided(lp: StabilizationLP, time_up: TimeUp) -> Feasible | Refused | Undecided:
    """Decide a gamma > 1 by optimal stopping at gamma' just below gamma, or gamma itself.

    The greatest solution w of w = min(1, gamma' min_a P_a w) is 0 exactly when gamma' < gamma_bar.
    Then the last policy is stabilizing at gamma', and as a rule at gamma too. Else w is the proof
    against gamma; the slack absorbs rounding.
    """
    best = spectral_radius.improved(lp, spectral_radius.short_lived(lp, time_up), time_up, lp.gamma)
    for slack in (1e-6, 1e-9, 1e-12, 0.0):
        if best.limit > lp.gamma:
            w, _ = stability_vector(lp, best.policy, time_up=time_up)
            if w is not None:
                return Feasible(best.policy, w)
        at = lp.gamma * (1 - slack)
        going = best.rate * at < 1 - 1e-12
        reward = np.where(going, 1.0, best.x)
        found = optimal_stopping(lp, at, reward, best.policy, going, time_up)
        if found is None:
            break
        if found.refuses:
            low, _ = spectral_radius.prove_low(lp, best) or (0.0, None)
            # Small entries may be rounding, or what carries a vector that falls over many decades.
            w = found.w if bounds.holds_for_all(lp, found.w, lp.gamma, None) else found.carried
            return Refused(w, best, low)
        if found.going.all():
            better = spectral_radius.of_policy(lp, found.policy, time_up)
            best = better if better.limit > best.limit else best
    return Undecided(best.policy, 0.0)

"""A backend's policy improved until nothing is strictly better, ties broken."""

from dataclasses import dataclass

import numpy as np

from lmdsl.backends import Solution
from lmdsl.certificate import checks
from lmdsl.common.types import Floats, Policy
from lmdsl.machine.deadline import Deadline, Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.policies import bellman, evaluation, ties
from lmdsl.optimize.policies.iteration import Iteration, iterate
from lmdsl.optimize.witness import certify


@dataclass(frozen=True, eq=False)
class _Outcome:
    """A policy after polishing, and what polishing did."""

    policy: Policy
    value: Floats | None
    steps: int
    gap_before: float | None


def _claimed(lp: StabilizationLP, solution: Solution) -> Policy | None:
    """Return the policy of a solution: its own, else greedy in V, else largest occupation."""
    if solution.policy is not None:
        return solution.policy
    if solution.value is not None:
        return bellman.improve(lp, np.maximum(solution.value, 0.0)).policy
    if solution.occupation is not None:
        theta = solution.occupation
        top = np.maximum.reduceat(theta, lp.pair_pointer[:-1])
        return ties.first_column(lp, theta >= top[lp.cell])
    return None


def _polish(
    lp: StabilizationLP,
    solution: Solution,
    iteration: Iteration | None,
    start: Policy,
    tolerance: float,
    deadline: Deadline,
) -> _Outcome:
    """Improve a backend's policy exactly until nothing is strictly better, then break ties.

    A policy that is not g-stabilizing is discarded where gamma >= 1. After a limit the policy is
    left as it is: a limit is not a license to go on.
    """
    if iteration is not None and solution.stop.success:  # it ends where polishing would begin
        return _ties_broken(lp, iteration, tolerance, 0, None, deadline)
    policy = _claimed(lp, solution)
    if policy is not None and not _usable(lp, policy, solution.value):
        policy = None
    if policy is None:
        policy = start
    guess = None if solution.policy is None else solution.value
    try:
        value = evaluation.evaluate(
            lp, policy, start=guess, transient=lp.gamma >= 1, time_up=deadline.again()
        )
    except Stopped:
        value = None
    if value is None or solution.stop.limit:
        return _Outcome(policy, value, 0, None)
    done = iterate(lp, policy, value, time_up=deadline)
    gap_before = None
    if done.steps:
        gap_before = certify(lp, policy, tolerance, value, deadline.again()).certificate.gap
    return _ties_broken(lp, done, tolerance, done.steps, gap_before, deadline)


def _ties_broken(
    lp: StabilizationLP,
    done: Iteration,
    tolerance: float,
    steps: int,
    gap_before: float | None,
    deadline: Deadline,
) -> _Outcome:
    """Break ties; where that costs more than the tolerance the strict minimisers stay."""
    try:
        canonical = ties.canonical(lp, done.policy, done.value, done.screen, deadline)
    except Stopped:
        canonical = done.policy
    if (canonical != done.policy).any() and _usable(lp, canonical, done.value):
        bound = evaluation.evaluate(lp, canonical, start=done.value, transient=lp.gamma >= 1)
        limit = (1 + tolerance / 4) * checks.weighted(lp, done.value)
        if bound is not None and checks.weighted(lp, bound) <= limit:
            return _Outcome(canonical, bound, steps, gap_before)
    value = done.value if done.converged else None  # else perhaps only a bound of it
    return _Outcome(done.policy, value, steps, gap_before)


def _usable(lp: StabilizationLP, policy: Policy, guess: Floats | None) -> bool:
    return lp.gamma < 1 or evaluation.stability_vector(lp, policy, guess)[0] is not None

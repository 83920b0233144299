"""Our own backend: policy iteration on the compact rows.

From a g-stabilizing start each step changes a control only where strictly better, and evaluates the
policy as far as the step was worth. The values fall and the last policy is optimal, for every gamma
and with zeros in the cost; for gamma >= 1 every policy on the way is gamma-stabilizing.
"""

import math
import time
from dataclasses import dataclass

from lmdsl.backends.base import Backend, Capabilities, Options, Solution, Stop
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.feasibility import first_policy
from lmdsl.optimize.policies import evaluation, iteration
from lmdsl.optimize.policies.iteration import Iteration


@dataclass(frozen=True, eq=False)
class Iterated(Solution):
    """A solution with the last step of policy iteration, where polishing would begin.

    It is believed of our own backends only.
    """

    iteration: Iteration | None = None


def solve(lp: StabilizationLP, options: Options) -> Solution:
    """Solve by policy iteration."""
    started = time.monotonic()

    def time_up() -> bool:
        limit = options.time_limit
        return limit is not None and time.monotonic() - started > limit

    def changes(count: int) -> None:
        if options.progress:
            options.progress("solve", elapsed(count, lp.n))

    policy, w, value = options.start, options.proof, options.value
    if policy is None:
        found = first_policy.stabilizing(lp, time_up)
        if isinstance(found, first_policy.Refused):
            return Solution(Stop.INFEASIBLE, "infeasible")
        if isinstance(found, first_policy.Undecided):
            stop = Stop.TIME_LIMIT if time_up() else Stop.FAILED
            return Solution(stop, stop.name.lower())
        policy, w = found.policy, found.w
    try:
        if value is None:
            value = iteration.bound(lp, policy, w)
        if value is None:
            value = evaluation.evaluate(lp, policy, time_up=time_up)
    except Stopped:
        return Solution(Stop.TIME_LIMIT, "time_limit", policy=policy)
    if value is None:
        return Solution(Stop.FAILED, "some cell costs more than 1e305; divide stage_cost")
    done = iteration.iterate(
        lp, policy, value, time_up=time_up, limit=options.max_iterations, changes=changes,
        keep=options.keep,
    )  # fmt: skip
    stop = Stop.OPTIMAL
    if not done.converged:
        stop = Stop.TIME_LIMIT if time_up() else Stop.ITERATION_LIMIT
    word = stop.name.lower()
    return Iterated(stop, word, done.value, None, done.policy, done.steps, iteration=done)


def elapsed(changed: int, n: int) -> float:
    """Return which part of the time is over once a step has changed so many controls of n.

    So it was on the examples, within a fifth: first and second steps change most controls, the last
    ones few, and all take about as long.
    """
    return float((1 - math.log1p(changed) / math.log1p(max(n, 1))) ** (1 / 3))


BACKEND = Backend(
    "policy-iteration",
    solve,
    Capabilities(algorithms=("howard",), vertex=True, rays=True, warm_start=True, silent=True),
)

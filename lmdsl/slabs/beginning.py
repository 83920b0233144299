"""A first policy over ranks: one that is proved to be g-stabilizing."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lmdsl.common.on_disk import filled
from lmdsl.common.types import Floats, Policy, TimeUp
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.checkpoints import Unfinished
from lmdsl.optimize.feasibility import first_policy, lifting
from lmdsl.optimize.policies import bellman
from lmdsl.slabs.chains.evaluating import Evaluator, evaluator
from lmdsl.slabs.chains.first import First
from lmdsl.slabs.iterating import iterated

ROUNDS = 50  # times that gamma is raised
NEAREST = 1e-9  # relative distance up to which it is raised towards the gamma asked for


def continued(first: First, by: Evaluator, kept: Unfinished | None) -> tuple[Policy, Floats] | None:
    """Return the policy of a checkpoint and its value, once it is proved; None where it is not."""
    if kept is None:
        return None
    column = lifting.columns_of(first.lp, kept.control)
    policy = np.where(column >= 0, column, first.lp._algorithm_1[1])
    found = by.bound(policy, kept.value if first.mesh.ranks.all(kept.positive) else None)
    if found is None:
        return None
    try:
        return policy, by.value(policy, found)
    except Stopped:  # on all ranks
        return policy, found


def soon(first: First, by: Evaluator) -> tuple[Policy, Floats] | None:
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


def raised(
    lp: StabilizationLP, by: Evaluator, gathered: int, time_up: TimeUp
) -> tuple[Policy, Floats] | None:
    """Return the same by raising gamma in steps; None where that does not lead there."""
    for _, policy, V in climbing(lp, gathered, time_up):
        found = by.bound(policy, V)
        if found is not None:
            return policy, found
    return None


def climbing(
    lp: StabilizationLP, gathered: int, time_up: TimeUp
) -> Iterator[tuple[float, Policy, Floats]]:
    """Raise gamma in steps, as :func:`first_policy.stabilizing` does.

    From gamma = 1 - 1/h, at which no policy costs more than h under unit cost, each step goes as
    far towards g as the optimal policy of the last one allows. Yields every gamma, a policy that is
    stabilizing there, and its value under unit cost. Collective.
    """
    ranks = First(lp).mesh.ranks
    level, policy = lp._algorithm_1
    horizon = 64.0 * max(ranks.collect(int(level.max(initial=0))))
    at, V = 1 - 1 / horizon, np.full(lp.n, horizon)
    for _ in range(ROUNDS):
        unit = under_unit_cost(lp, at)
        policy, V, _, _ = iterated(First(unit), evaluator(unit, gathered, time_up), policy, V,
                                   time_up)  # fmt: skip
        yield at, policy, V
        if time_up():
            return
        reach, higher = lp.growth, None
        while higher is None and reach > at * (1 + NEAREST):
            reach = at + (reach - at) / 2
            higher = evaluator(under_unit_cost(lp, reach), gathered, time_up).bound(policy, V)
        if higher is None:
            return
        at, V = reach, higher


def under_unit_cost(lp: StabilizationLP, gamma: float) -> StabilizationLP:
    """Return the model under unit cost and another gamma."""
    return replace(lp, gamma=gamma, cost=filled(lp.cost, 1.0), _known=lp._algorithm_1)

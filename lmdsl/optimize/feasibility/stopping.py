"""Optimal stopping: whether going on under weight gamma beats an end, cell by cell."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lmdsl.common.on_disk import filled
from lmdsl.common.types import Bools, Floats, Policy, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.linear import equations
from lmdsl.optimize.policies import bellman

LEAST_UNIT = 1e-140  # least unit of a component: quotients of two stay within doubles


@dataclass(frozen=True, eq=False)
class Stopping:
    """The outcome of optimal stopping."""

    w: Floats  # the greatest solution of w = min(reward, gamma min_a P_a w), shape (n,)
    policy: Policy  # A column for every cell; it counts where ``going``
    going: Bools  # cells that do not stop
    converged: bool  # false where rounding or the limit ended the work

    @property
    def refuses(self) -> bool:
        """True when w is not 0."""
        return float(self.w.max(initial=0.0)) > 1e-9

    @property
    def carried(self) -> Floats:
        """Return w without the cells at rounding level: their own rows then ask 0 <= something."""
        return np.where(self.w > 1e-14 * self.w.max(initial=0.0), self.w, 0.0)


def optimal_stopping(
    lp: StabilizationLP,
    gamma: float,
    reward: Floats,
    policy: Policy | None = None,
    going: Bools | None = None,
    time_up: TimeUp = never,
    limit: int = 1000,
) -> Stopping | None:
    """Stop in a cell for ``reward`` >= 0, or go on under the least favourable control, for ever.

    Howard's policy iteration with "stop" as one more control, as :func:`iterate` makes it. Every
    policy stays transient under gamma P, so a policy that ends with every cell going and w = 0 is
    gamma-stabilizing. The first policy is to be so on the cells that go; by default all stop. None
    where ``time_up`` ended the work.
    """
    policy = lp.pair_pointer[:-1].copy() if policy is None else policy
    going = np.zeros(lp.n, dtype=np.bool_) if going is None else going
    try:
        return _stopping(_Asked(lp, gamma, reward, time_up), policy, going, limit)
    except Stopped:
        return None


class _Asked(NamedTuple):
    lp: StabilizationLP
    gamma: float
    reward: Floats
    time_up: TimeUp


def _stopping(asked: _Asked, policy: Policy, going: Bools, limit: int) -> Stopping:
    lp, gamma, reward, time_up = asked
    zero = filled(lp.cost, 0.0)
    w = _stopped(asked, policy, going, reward)
    if w is None:
        going = np.zeros(lp.n, dtype=np.bool_)
        w = reward
    for step in range(limit):
        if time_up():
            raise Stopped
        lowered, new_pair, new_going = w, policy, going
        for _ in range(step + 1):
            better = bellman.improve(lp, lowered, gamma, zero)
            least = np.minimum(better.value, reward)
            same = np.where(better.value <= reward, new_going & (better.policy == new_pair), False)
            change = (least < lowered * (1 - 1e-13)) & ~same
            if not change.any():
                break
            lowered = np.where(change, least, lowered)
            new_pair = np.where(change, better.policy, new_pair)
            new_going = np.where(change, better.value <= reward, new_going)
        if lowered is w:
            return Stopping(np.minimum(w, reward), policy, going, True)
        new = _stopped(asked, new_pair, new_going, w)
        if new is None or not (new < w).any():
            break  # rounding made a change look better than it is
        w, policy, going = new, new_pair, new_going
    return Stopping(np.minimum(w, reward), policy, going, False)


def _stopped(asked: _Asked, policy: Policy, going: Bools, before: Floats) -> Floats | None:
    """Return the reward of a stopping policy: w = gamma P w where it goes, the reward elsewhere.

    It is solved in units of ``before``, as w may fall over many decades.
    """
    lp, gamma, reward, time_up = asked
    w = reward.copy()
    if going.any():
        unit = np.maximum(before, LEAST_UNIT)
        P = gamma * lp.rows.matrix(policy[going])
        P.data *= unit[P.indices] / np.repeat(unit[going], np.diff(P.indptr))
        new = equations.solve(P[:, going], P[:, ~going] @ (reward / unit)[~going], time_up)
        if new is None:
            return None
        w[going] = unit[going] * new
    return w

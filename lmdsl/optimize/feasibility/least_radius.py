"""Howard's iteration for the policy of least spectral radius."""

import math
from contextlib import suppress

import numpy as np

from lmdsl.common.types import Bools, Floats, TimeUp, never
from lmdsl.machine.deadline import Stopped
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.feasibility.perron import FINE
from lmdsl.optimize.feasibility.spectral_radius import (
    COARSE,
    ROUNDS,
    SLIGHT,
    TIED,
    PolicyClasses,
    lifted,
    of_policy,
)
from lmdsl.optimize.policies import bellman


def improved(
    lp: StabilizationLP,
    found: PolicyClasses,
    time_up: TimeUp = never,
    until: float = math.inf,
    least: float = 1e-2 * TIED,
    inside: Bools | None = None,
) -> PolicyClasses:
    """Raise the limit of a policy by Howard's policy iteration.

    A control a with (P_a w)_i < (P_u w)_i keeps P_u w <= lam w, w > 0 being the vector that proves
    the limit 1/lam: no step lowers it. While the limit still rises fast, the rates need not be
    known well.

    Parameters
    ----------
    lp, found, time_up
        The model, a policy, and what ends the work.
    until, least
        A limit that is enough, and the relative gain of a step below which it is the last.
    inside
        As in :func:`of_policy`, of which ``found`` then comes.
    """
    enough = COARSE
    with suppress(Stopped):
        for _ in range(ROUNDS):
            w = lifted(found)
            if w is None or time_up() or found.limit > until:
                break
            new = _greedy(lp, found, w, enough, time_up, inside)
            gain = 0.0 if new is None else new.limit / found.limit - 1
            if new is not None and gain > 0:
                found, enough = new, min(enough, max(FINE, 1e-2 * gain))
            elif found.known <= FINE:
                break
            if gain < least and found.known > FINE:
                found = of_policy(lp, found.policy, time_up, found.x, FINE, inside)
            if 0 < gain < least:
                break
    return found


def _greedy(
    lp: StabilizationLP,
    found: PolicyClasses,
    w: Floats,
    enough: float,
    time_up: TimeUp,
    inside: Bools | None,
) -> PolicyClasses | None:
    """Return the policy that is better for the w of another, None where none is."""
    w = w if inside is None else np.where(inside, w, 0.0)
    best = bellman.improve(lp, w, 1.0, np.zeros(lp.K))
    change = best.value < (found.P @ w) * (1 - SLIGHT)
    if not change.any():
        return None
    policy = np.where(change, best.policy, found.policy)
    new = of_policy(lp, policy, time_up, found.x, enough, inside)
    if new.limit <= found.limit * (1 + enough):
        return of_policy(lp, policy, time_up, new.x, FINE, inside)
    return new

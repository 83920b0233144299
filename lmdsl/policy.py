"""Policies of the finite model: evaluate, improve, break ties, and find a first stabilizing one.

A policy is an array of columns, one per cell of C (``pair``). P_u, G_u are its rows. It is
*gamma-stabilizing* when the spectral radius of gamma P_u is below 1; then its value
V = G_u + gamma P_u V is finite. Write g = max(gamma, 1).

For gamma >= 1, Howard's policy iteration from a gamma-stabilizing policy that changes a control
only where strictly better keeps every policy gamma-stabilizing, zeros in the cost included: on a
recurrent class of a bad new policy, V >= gamma P V + G forces equality everywhere, so nothing
there was changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lmdsl import bellman, bounds, graph, linear
from lmdsl.linear import Stop as Stop
from lmdsl.linear import Stopped, never
from lmdsl.lp import StabilizationLP

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]
Bools = NDArray[np.bool_]

TIE = 1e-12
"""Relative difference in Q up to which two controls count as tied."""


def evaluate(
    lp: StabilizationLP,
    pair: Pairs,
    gamma: float | None = None,
    cost: Floats | None = None,
    start: Floats | None = None,
    stop: Stop = never,
) -> Floats | None:
    """Return V = G_u + gamma P_u V, shape (n,); None where the policy has no finite value.

    Parameters
    ----------
    lp, pair
        The model, and one column per cell.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    start
        A guess of V.
    stop
        Ends the work, with :class:`lmdsl.linear.Stopped`.
    """
    gamma = lp.gamma if gamma is None else gamma
    cost = lp.cost if cost is None else cost
    P = lp.rows.matrix(pair)
    if gamma >= 1 and not reaches_attractor(lp, pair, P).all():
        return None
    return linear.solve(gamma * P, cost[pair], start, stop)


def reaches_attractor(lp: StabilizationLP, pair: Pairs, P: object | None = None) -> Bools:
    """Return the cells from which the policy can reach A, shape (n,)."""
    level, _ = graph.tree(np.arange(lp.n + 1, dtype=np.int64), lp.rows.take(pair))
    return level >= 0


@dataclass(frozen=True)
class Iteration:
    """The outcome of policy iteration.

    Attributes
    ----------
    pair, value
        The last policy and its value.
    steps
        Improvement steps that changed the policy.
    converged
        False when stopped early.
    """

    pair: Pairs
    value: Floats
    steps: int
    converged: bool


def iterate(
    lp: StabilizationLP,
    pair: Pairs,
    value: Floats,
    gamma: float | None = None,
    cost: Floats | None = None,
    stop: Stop = never,
    limit: int | None = None,
) -> Iteration:
    """Howard's policy iteration from a policy and its value.

    The k-th step makes k improvement sweeps before it evaluates, so that news from A travels
    further than one cell a step. Each sweep lowers V where a control is strictly better and keeps
    that control: T_u V <= V stays true, with equality on no recurrent class that was changed. The
    proof that this is safe from any V >= T_u V and ends is in docs/mathematics.md.
    """
    step = 0
    while True:
        if stop() or step == limit:
            return Iteration(pair, value, step, False)
        new, lowered = pair, value
        for _ in range(step + 1):
            better = bellman.improve(lp, lowered, gamma, cost)
            change = (better.value < lowered - TIE * np.abs(lowered)) & (better.pair != new)
            if not change.any():
                break
            new = np.where(change, better.pair, new)
            lowered = np.where(change, better.value, lowered)
        if new is pair:
            return Iteration(pair, value, step, True)
        try:
            new_value = evaluate(lp, new, gamma, cost, lowered, stop)
        except Stopped:
            return Iteration(pair, value, step, False)
        if new_value is None or not (new_value < value).any():
            # Rounding made a change look better than it is.
            return Iteration(pair, value, step, True)
        pair, value = new, new_value
        step += 1


def canonical(lp: StabilizationLP, pair: Pairs, value: Floats) -> Pairs:
    """Break ties so that the policy reaches A: the policy that every backend ends with.

    Tied are the columns with Q <= Q_min + 1e-12 |Q_min|. Among them take those optimal for unit
    cost weighted with g, then the smallest control index; cells from which that cost is infinite
    take the smallest tied index.

    Parameters
    ----------
    lp, pair, value
        The model, an optimal policy and its value.
    """
    best = bellman.improve(lp, value).value
    ties = bellman.tied(lp, value, best, TIE)
    ties[pair] = True
    choices = np.add.reduceat(ties, lp.pair_pointer[:-1], dtype=np.int64)
    first = first_column(lp, ties)
    if (choices == 1).all():
        return first
    found = graph.stabilizable(*_columns(lp, ties))
    if not found.inside.any():
        return first
    columns = np.flatnonzero(ties)[found.surviving]
    inside = np.flatnonzero(found.inside)
    sub = lp.part(columns, inside)
    unit = np.ones(sub.K)
    start = np.searchsorted(columns, pair[inside])
    start = np.minimum(start, len(columns) - 1)
    owned = columns[start] == pair[inside]
    if not owned.all():
        start = np.where(owned, start, sub.tree[1])
    w = evaluate(sub, start, lp.growth, unit)
    if w is None:
        start = sub.tree[1]
        w = evaluate(sub, start, lp.growth, unit)
    if w is None:
        return pair
    done = iterate(sub, start, w, lp.growth, unit)
    least = bellman.improve(sub, done.value, lp.growth, unit).value
    equal = bellman.tied(replace(sub, gamma=lp.growth, cost=unit), done.value, least, TIE)
    chosen = first.copy()
    chosen[inside] = columns[first_column(sub, equal)]
    return chosen


def first_column(lp: StabilizationLP, allowed: Bools) -> Pairs:
    """Return the first allowed column of every cell (each cell must have one)."""
    position = np.where(allowed, np.arange(lp.K), lp.K)
    return np.minimum.reduceat(position, lp.pair_pointer[:-1]).astype(np.int64)


def _columns(lp: StabilizationLP, allowed: Bools):  # type: ignore[no-untyped-def]
    count = np.add.reduceat(allowed, lp.pair_pointer[:-1], dtype=np.int64)
    pointer = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    return pointer, lp.rows.take(np.flatnonzero(allowed))


def stability_vector(
    lp: StabilizationLP,
    pair: Pairs,
    guess: Floats | None = None,
    g: float | None = None,
    stop: Stop = never,
) -> tuple[Floats, Floats] | tuple[None, None]:
    """Return w > 0, d > 0 with w >= g P_u w + d: a proof that the policy is g-stabilizing.

    w is the unit-cost value. Where it spans so many decades that 1 is lost in rounding, the value
    at a slightly larger weight leaves a relative slack instead.
    """
    g = lp.growth if g is None else g
    unit = np.ones(lp.K)
    if guess is not None and (d := bounds.decrease(lp, pair, guess, g)) is not None:
        return guess, d
    for inflation in (0.0, 5e-7, 1e-10):
        w = evaluate(lp, pair, g * (1 + inflation), unit, guess, stop)
        if w is not None and (d := bounds.decrease(lp, pair, w, g)) is not None:
            return w, d
    return None, None


@dataclass(frozen=True)
class Feasible:
    """A gamma-stabilizing policy, with its unit-cost value w = 1 + g P_u w."""

    pair: Pairs
    w: Floats


@dataclass(frozen=True)
class Refused:
    """A candidate proof that no policy is gamma-stabilizing: w >= 0, w <= gamma P_a w for all a.

    ``pair`` is a policy that is stabilizing at ``lower`` < gamma.
    """

    w: Floats
    pair: Pairs
    lower: float


@dataclass(frozen=True)
class Undecided:
    """gamma is so close to its limit that doubles decide neither way, or time ran out.

    ``pair`` is a policy that is stabilizing at ``lower`` < gamma.
    """

    pair: Pairs
    lower: float


def stabilizing(lp: StabilizationLP, stop: Stop = never) -> Feasible | Refused | Undecided:
    """Find a policy that is stabilizing with weight g = max(gamma, 1), or a proof against it.

    Algorithm 1 gives the first policy. Where it does not do, gamma is raised from 1/2 in steps,
    each below the limit of the last policy, under unit cost (under a cost with zeros this can
    stall).
    """
    reached: Feasible | Refused | Undecided = Undecided(lp.tree[1], 0.0)
    try:
        for reached in _raising(lp, stop):
            if not isinstance(reached, Undecided):
                break
    except Stopped:
        pass
    return reached


def _raising(lp: StabilizationLP, stop: Stop) -> Iterator[Feasible | Refused | Undecided]:
    """Raise gamma step by step; yield what is known after each, the decision last."""
    g, unit = lp.growth, np.ones(lp.K)
    pair = lp.tree[1]
    w, _ = stability_vector(lp, pair, stop=stop)
    if w is not None:
        yield Feasible(pair, w)
        return
    # The tree can be exponentially slow; at gamma = 1/2 every policy has a value, at most 2.
    at, value = 0.5, evaluate(lp, pair, 0.5, unit, stop=stop)
    if value is None:
        return
    refuse_at = 0
    for step in range(200):
        done = iterate(lp, pair, value, at, unit, stop=stop)
        pair, value = done.pair, done.value
        yield Undecided(pair, at)
        w, _ = stability_vector(lp, pair, stop=stop)
        if w is not None:
            yield Feasible(pair, w)
            return
        if stop():
            return
        if g > 1 and at >= 1 and step >= refuse_at:
            refuse_at = 2 * step + 4
            proof = refusal(lp, stop)
            if proof is not None:
                yield Refused(proof, pair, at)
                return
        # Raise gamma as far towards g as this policy allows, by bisection from above.
        reach, raised = g, None
        while raised is None and reach > at * (1 + 1e-13):
            reach = at + (reach - at) / 2
            raised, _ = stability_vector(lp, pair, g=reach, stop=stop)
        if raised is None:
            return
        at, value = reach, raised
        yield Undecided(pair, at)


def refusal(lp: StabilizationLP, stop: Stop = never) -> Floats | None:
    """Return w >= 0, w != 0 that should satisfy w <= gamma P_a w for every pair, or None.

    w is the greatest solution of w = min(1, gamma' min_a P_a w) with gamma' just below gamma (the
    slack absorbs rounding) or gamma itself. It is 0 exactly when gamma' < gamma_bar.
    """
    for slack in (1e-6, 1e-9, 1e-12, 0.0):
        found = optimal_stopping(lp, lp.gamma * (1 - slack), np.ones(lp.n), stop=stop)
        if found is None:
            return None
        if found.refuses:
            return found.carried
    return None


@dataclass(frozen=True)
class Stopping:
    """The outcome of optimal stopping.

    Attributes
    ----------
    w
        The greatest solution of w = min(reward, gamma min_a P_a w), shape (n,).
    pair
        A column for every cell; it counts where ``going``.
    going
        Cells that do not stop.
    converged
        False where rounding or the limit ended the work.
    """

    w: Floats
    pair: Pairs
    going: Bools
    converged: bool

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
    pair: Pairs | None = None,
    going: Bools | None = None,
    stop: Stop = never,
    limit: int = 1000,
) -> Stopping | None:
    """Stop in a cell for ``reward``, or go on under the least favourable control, for ever.

    Howard's policy iteration with "stop" as one more control, as :func:`iterate` makes it. Every
    policy stays transient under gamma P, so a policy that ends with every cell going and w = 0
    is gamma-stabilizing.

    Parameters
    ----------
    lp, gamma
        The model and the weight.
    reward
        Shape (n,), >= 0.
    pair, going
        A first policy, transient under gamma P on the cells that go; default: stop everywhere.
    stop, limit
        End the work, with None; largest number of steps.
    """
    pair = lp.pair_pointer[:-1].copy() if pair is None else pair
    going = np.zeros(lp.n, dtype=np.bool_) if going is None else going
    try:
        return _stopping(lp, gamma, reward, pair, going, stop, limit)
    except Stopped:
        return None


def _stopping(
    lp: StabilizationLP,
    gamma: float,
    reward: Floats,
    pair: Pairs,
    going: Bools,
    stop: Stop,
    limit: int,
) -> Stopping:
    zero = np.zeros(lp.K)
    w = _stopped(lp, gamma, reward, pair, going, stop)
    if w is None:
        going = np.zeros(lp.n, dtype=np.bool_)
        w = reward
    for step in range(limit):
        if stop():
            raise Stopped
        lowered, new_pair, new_going = w, pair, going
        for _ in range(step + 1):
            better = bellman.improve(lp, lowered, gamma, zero)
            least = np.minimum(better.value, reward)
            same = np.where(better.value <= reward, new_going & (better.pair == new_pair), False)
            change = (least < lowered * (1 - 1e-13)) & ~same
            if not change.any():
                break
            lowered = np.where(change, least, lowered)
            new_pair = np.where(change, better.pair, new_pair)
            new_going = np.where(change, better.value <= reward, new_going)
        if lowered is w:
            return Stopping(np.minimum(w, reward), pair, going, True)
        new = _stopped(lp, gamma, reward, new_pair, new_going, stop)
        if new is None or not (new < w).any():
            break  # rounding made a change look better than it is
        w, pair, going = new, new_pair, new_going
    return Stopping(np.minimum(w, reward), pair, going, False)


def _stopped(
    lp: StabilizationLP, gamma: float, reward: Floats, pair: Pairs, going: Bools, stop: Stop
) -> Floats | None:
    """Return what a stopping policy is paid: w = gamma P w where it goes, the reward elsewhere."""
    w = reward.copy()
    if going.any():
        P = gamma * lp.rows.matrix(pair[going])
        new = linear.solve(P[:, going], P[:, ~going] @ reward[~going], stop=stop)
        if new is None:
            return None
        w[going] = new
    return w

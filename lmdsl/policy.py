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

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lmdsl import bellman, bounds, graph, linear
from lmdsl.lp import StabilizationLP
from lmdsl.screening import Pass, Screen

Floats = NDArray[np.float64]
Pairs = NDArray[np.int64]
Bools = NDArray[np.bool_]
Stop = Callable[[], bool]

TIE = 1e-12
"""Relative difference in Q up to which two controls count as tied."""

LEAST_SWEEPS, MOST_SWEEPS = 4, 60


def evaluate(
    lp: StabilizationLP,
    pair: Pairs,
    gamma: float | None = None,
    cost: Floats | None = None,
    start: Floats | None = None,
    transient: bool = False,
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
    transient
        The policy is known to be gamma-stabilizing, which saves looking whether it reaches A.
    """
    gamma = lp.gamma if gamma is None else gamma
    b = (lp.cost if cost is None else cost)[pair]
    if gamma >= 1 and not transient and not reaches_attractor(lp, pair).all():
        return None
    if (b == 0).any():
        return linear.solve(gamma * lp.rows.matrix(pair), b, start)
    x = np.array(b if start is None else start, dtype=np.float64)
    system = lp.rows.system(pair, gamma, b)
    return linear.solve_from(system, x, lambda: gamma * lp.rows.matrix(pair))


def reaches_attractor(lp: StabilizationLP, pair: Pairs) -> Bools:
    """Return the cells from which the policy can reach A, shape (n,)."""
    reaches = np.zeros(lp.n + 1, dtype=np.bool_)
    reaches[-1] = True
    if not _reach(pair, lp.rows.pointer, lp.rows.target, reaches, 64):
        level, _ = graph.tree(np.arange(lp.n + 1, dtype=np.int64), lp.rows.take(pair))
        return level >= 0
    return reaches[:-1]


@njit(cache=True, nogil=True)
def _reach(pair, pointer, target, reaches, sweeps):  # type: ignore[no-untyped-def]
    """Mark cells with a marked successor until nothing changes; False where sweeps run out."""
    n = len(pair)
    for sweep in range(sweeps):
        changed = False
        for t in range(n):
            i = t if sweep % 2 == 0 else n - 1 - t
            if reaches[i]:
                continue
            for e in range(pointer[pair[i]], pointer[pair[i] + 1]):
                if reaches[target[e]]:
                    reaches[i] = changed = True
                    break
        if not changed:
            return True
    return False


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
    screen
        Lower bounds of every Q at the value.
    """

    pair: Pairs
    value: Floats
    steps: int
    converged: bool
    screen: Screen


def iterate(
    lp: StabilizationLP,
    pair: Pairs,
    value: Floats,
    gamma: float | None = None,
    cost: Floats | None = None,
    stop: Stop = lambda: False,
    limit: int | None = None,
) -> Iteration:
    """Policy iteration from a gamma-stabilizing policy until no control is better.

    Parameters
    ----------
    lp, pair
        The model and the first policy.
    value
        Its value, or any V >= T_u V, such as :func:`bound` gives.
    gamma, cost
        Other than the LP's own; ``cost`` has shape (K,).
    stop, limit
        Asked before every step; largest number of steps.

    Notes
    -----
    Each step changes every control for which another one is better by a relative 1e-12, then sweeps
    V <- T_u V for the new policy u, about as long as the improvement took; only a policy that seems
    final is evaluated to the end. V >= T_u V stays true whatever the number of sweeps, so V falls
    and every policy on the way is gamma-stabilizing (docs/mathematics.md, Policy iteration).
    """
    screen = Screen(lp, gamma, cost)
    gamma, cost = screen.gamma, screen.cost
    V, last, step = value, None, 0  # last: the policy evaluated to the end, and its value
    while True:
        out = stop() or step == limit
        done = screen.improve(V, pair, TIE) if not out else Pass(V, pair, 0, 0)
        if done.changed:
            x = done.value.copy()
            sweeps = min(max(done.looked // lp.n, LEAST_SWEEPS), MOST_SWEEPS)
            enough = 0.1 * _fall(V, x)
            lp.rows.system(done.pair, gamma, cost[done.pair]).sweep(x, sweeps, enough)
            x = np.minimum(x, done.value)
            screen.follow(V, x)
            pair, V = done.pair, x
            step += 1
            continue
        if last is not None and last[0] is pair:
            return Iteration(*last, step, not out, screen)
        exact = evaluate(lp, pair, gamma, cost, done.value, transient=True)
        if exact is None:
            exact = evaluate(lp, pair, gamma, cost)
        if exact is None or (last is not None and not (exact < last[1]).any()):
            # Rounding made a change look better than it is.
            return Iteration(*(last or (pair, V)), step, last is not None and not out, screen)
        screen.follow(V, np.minimum(exact, V))
        last, V = (pair, exact), exact
        if out:
            return Iteration(*last, step, False, screen)


def _fall(before: Floats, after: Floats) -> float:
    """Return the largest relative decrease."""
    ratio = np.divide(after, before, out=np.ones(len(before)), where=before > 0)
    return 1.0 - float(ratio.min(initial=1.0))


def bound(lp: StabilizationLP, pair: Pairs, w: Floats | None = None) -> Floats | None:
    """Return V >= T_u V of a g-stabilizing policy, None where none is found quickly.

    With w >= g P_u w + d, c w serves as soon as c d >= G_u.
    """
    w, d = stability_vector(lp, pair, w)
    if w is None or d is None:
        return None
    with np.errstate(over="ignore"):
        V: Floats = w * (float((lp.cost[pair] / d).max()) * (1 + 1e-12))
    return V if (V < linear.CEILING).all() else None


def canonical(
    lp: StabilizationLP, pair: Pairs, value: Floats, screen: Screen | None = None
) -> Pairs:
    """Break ties so that the policy reaches A: the policy that every backend ends with.

    Tied are the columns with Q <= Q_min + 1e-12 |Q_min|. Among them take those optimal for unit
    cost weighted with g, then the smallest control index; cells from which that cost is infinite
    take the smallest tied index.

    Parameters
    ----------
    lp, pair, value
        The model, an optimal policy and its value.
    screen
        Lower bounds of every Q at this value, where they are known.
    """
    if screen is None:
        screen = Screen(lp)
    ties = screen.tied(value, TIE)
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
    sharp: bool = False,
) -> tuple[Floats, Floats] | tuple[None, None]:
    """Return w > 0, d > 0 with w >= g P_u w + d: a proof that the policy is g-stabilizing.

    w is close to the unit-cost value, closer where ``sharp``. Where that spans so many decades that
    1 is lost in rounding, the value at a slightly larger weight leaves a relative slack instead.
    """
    g = lp.growth if g is None else g
    if guess is not None and (d := bounds.decrease(lp, pair, guess, g)) is not None:
        return guess, d
    unit = np.ones(lp.n)
    w = unit.copy()
    # Sweeps from below leave 1 + g P w - w at most what they still move.
    if lp.rows.system(pair, g, unit).sweep(w, 128, 0.0, 1e-6 if sharp else 0.25)[1] < np.inf:
        d = bounds.decrease(lp, pair, w, g)
        if d is not None:
            return w, d
    for inflation in (0.0, 5e-7, 1e-10):
        w_more = evaluate(lp, pair, g * (1 + inflation), np.ones(lp.K), guess)
        if w_more is not None and (d := bounds.decrease(lp, pair, w_more, g)) is not None:
            return w_more, d
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


def _proved(lp: StabilizationLP, pair: Pairs, w: Floats) -> Floats | None:
    """Sweep a guess of the unit-cost value until it proves a policy g-stabilizing, a while."""
    w = w.copy()
    lp.rows.system(pair, lp.growth, np.ones(lp.n)).sweep(w, MOST_SWEEPS, 0.0, 0.25)
    return w if bounds.decrease(lp, pair, w, lp.growth) is not None else None


def stabilizing(lp: StabilizationLP, stop: Stop = lambda: False) -> Feasible | Refused | Undecided:
    """Find a policy that is stabilizing with weight g = max(gamma, 1), or a proof against it.

    Candidates are the greedy policies of value iteration under unit cost from the levels of
    Algorithm 1, which lie below it, then optimal policies under unit cost at gamma = 1 - 1/h, at
    which no policy costs more than h. Where none does, gamma is raised in steps, each below the
    limit of the last policy (unit cost, because under a cost with zeros this can stall).
    """
    g, unit = lp.growth, np.ones(lp.K)
    level, pair = lp.tree
    V = level.astype(np.float64)
    for k in range(4):
        better = bellman.rise(lp, V, g, k % 2 == 1)
        V = better.value
        w = _proved(lp, better.pair, V) if k in (0, 3) else None
        if w is not None:
            return Feasible(better.pair, w)
    for horizon in (4.0 * level.max(), 64.0 * level.max()):
        at, value = 1 - 1 / horizon, np.full(lp.n, horizon)
        for _ in range(4):
            done = iterate(lp, pair, value, at, unit, stop=stop, limit=6)
            pair, value = done.pair, done.value
            w = _proved(lp, pair, value)
            if w is not None:
                return Feasible(pair, w)
            if stop():
                return Undecided(pair, at)
            if done.converged:
                break
    refuse_at = 0
    for step in range(200):
        done = iterate(lp, pair, value, at, unit, stop=stop)
        pair, value = done.pair, done.value
        w, _ = stability_vector(lp, pair)
        if w is not None:
            return Feasible(pair, w)
        if stop():
            break
        if g > 1 and at >= 1 and step >= refuse_at:
            refuse_at = 2 * step + 4
            proof = refusal(lp, stop)
            if proof is not None:
                return Refused(proof, pair, at)
        # Raise gamma as far towards g as this policy allows, by bisection from above.
        reach, raised = g, None
        while raised is None and reach > at * (1 + 1e-13):
            reach = at + (reach - at) / 2
            raised, _ = stability_vector(lp, pair, g=reach)
        if raised is None:
            break
        at, value = reach, raised
    return Undecided(pair, at)


def refusal(lp: StabilizationLP, stop: Stop = lambda: False) -> Floats | None:
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
    stop: Stop = lambda: False,
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
    zero = np.zeros(lp.K)
    pair = lp.pair_pointer[:-1].copy() if pair is None else pair
    going = np.zeros(lp.n, dtype=np.bool_) if going is None else going
    w = _stopped(lp, gamma, reward, pair, going)
    if w is None:
        going = np.zeros(lp.n, dtype=np.bool_)
        w = reward
    for step in range(limit):
        if stop():
            return None
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
        new = _stopped(lp, gamma, reward, new_pair, new_going)
        if new is None or not (new < w).any():
            break  # rounding made a change look better than it is
        w, pair, going = new, new_pair, new_going
    return Stopping(np.minimum(w, reward), pair, going, False)


def _stopped(
    lp: StabilizationLP, gamma: float, reward: Floats, pair: Pairs, going: Bools
) -> Floats | None:
    """Return what a stopping policy is paid: w = gamma P w where it goes, the reward elsewhere."""
    w = reward.copy()
    if going.any():
        P = gamma * lp.rows.matrix(pair[going])
        new = linear.solve(P[:, going], P[:, ~going] @ reward[~going])
        if new is None:
            return None
        w[going] = new
    return w

"""Inequalities that survive rounding: each yes holds in exact arithmetic.

All quantities are nonnegative, so a sum of L products has a relative rounding error of at most
(L + 1) u, u = 2^-53, whatever its order; with gamma, the cost and the correction itself counted,
(L + 8) u with a factor 1.1 to spare bounds everything. Products and shares below the normal range
of doubles lose up to L * 2^-1074 times the largest factor, which is added apart. A sum above
2^1000 bounds nothing. A row that the fast bound leaves open is decided with exact rationals: the
doubles G, gamma, V are read as they stand and a transition is numerator / total.
"""

from fractions import Fraction

import numpy as np

from lmdsl.certificate.sums import LEAST as LEAST
from lmdsl.certificate.sums import UNIT as UNIT
from lmdsl.certificate.vectors import over_cells, padded
from lmdsl.common.types import Floats, Indices, Policy
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.lp import StabilizationLP

# Size of a sum above which it is not believed: one that rounds to infinity exceeds everything.
LARGEST = 2.0**1000
# Factor with which a row holds whatever rounding does; number of entries from which on it may not:
# 4,016 u < 1e-12.
CLEAR, LONG = 1.0 - 1e-12, 4_000
# Number of rows above which none is decided with exact rationals: they take about 0.4 s.
MAX_EXACT = 20_000
# In place of arrays for results that are not asked for.
NO_BOUNDS, NO_PAIRS = np.empty(0), np.empty(0, dtype=np.int64)


def expected_above(lp: StabilizationLP, policy: Policy, x: Floats, gamma: float) -> Floats:
    """Return an upper bound of gamma P_u x for a policy, shape (n,)."""
    upper, V = np.empty(lp.n), padded(lp, x)
    above = _above if never_underflows(lp, V, gamma) else _carefully_above
    over_cells(lp, above, policy.view(np.uint64), lp.rows.kernel, gamma, V, upper)
    return upper


def inflow(
    lp: StabilizationLP, policy: Policy, mu: Floats, gamma: float
) -> tuple[Floats, Floats, Floats]:
    """Return gamma P_u'mu as summed in doubles, and its rounding error: relative and absolute.

    The relative error also covers two more operations with the sum. Each of shape (n,).
    """
    total, entries = np.zeros(lp.rows.columns + 1), np.zeros(lp.rows.columns + 1)
    _inflow(policy.view(np.uint64), lp.rows.kernel, gamma, mu, total, entries)
    terms = entries[:-1] + 8
    absolute = (1 + gamma) * terms * LEAST * (1 + mu.max(initial=0.0))
    return total[:-1], terms * UNIT, absolute


def decrease(lp: StabilizationLP, policy: Policy, w: Floats, g: float) -> Floats | None:
    """Return d > 0 with w >= g P_u w + d, rounded down; None where w > 0 has no such d.

    It proves that the spectral radius of g P_u is at most 1 - min d/w < 1.
    """
    if w.shape != (lp.n,) or not (np.isfinite(w).all() and (w > 0).all()):
        return None
    d = (w - expected_above(lp, policy, w, g)) * (1 - 4 * UNIT)
    return d if (d > 0).all() else None


def add_above(a: Floats, b: Floats) -> Floats:
    """Return an upper bound of a + b for nonnegative a, b; exact where one is 0."""
    with np.errstate(over="ignore"):
        total = a + b
        return np.where((a == 0) | (b == 0), total, total * (1 + 4 * UNIT))


def holds_for_all(lp: StabilizationLP, x: Floats, gamma: float, cost: Floats | None) -> bool:
    """Decide x <= gamma P_a x + G_a for every pair; False also where it cannot be decided."""
    V = padded(lp, x)
    open_pairs = _undecided(lp, V, gamma, cost)
    if open_pairs is None:
        return False
    return all(exactly_below(lp, int(k), V, gamma, cost) for k in open_pairs)


def undecided(lp: StabilizationLP, x: Floats, gamma: float, cost: Floats | None) -> Indices | None:
    """Return the pairs for which x <= gamma P_a x + G_a is not clear; None if too many."""
    V = padded(lp, x)
    return _undecided(lp, V, gamma, cost)


def _undecided(lp: StabilizationLP, V: Floats, gamma: float, cost: Floats | None) -> Indices | None:
    cost, plain = np.empty(0) if cost is None else cost, never_underflows(lp, V, gamma)

    def part(first: int, last: int) -> tuple[int, Indices]:
        found = np.empty(MAX_EXACT, dtype=np.int64)
        given = (first, last, *lp._kernel, gamma, cost, V)
        count, _, _ = _open(*given, found) if plain else _carefully(*given, NO_BOUNDS, found)
        return int(count), found[:count].copy()

    parts = over_cells(lp, part)
    if sum(count for count, _ in parts) > MAX_EXACT:
        return None
    return np.concatenate([found for _, found in parts])


def exact_backup(
    lp: StabilizationLP, k: int, x: Floats, gamma: float, cost: Floats | None
) -> Fraction:
    """Return gamma P_a x + G_a of one pair exactly."""
    end = lp.rows.columns
    total = sum(
        (Fraction(float(x[j])) * share for j, share in lp.rows.exact(k) if j < end), Fraction(0)
    )
    fixed = Fraction(0) if cost is None else Fraction(float(cost[k]))
    return Fraction(gamma) * total / lp.rows.total(k) + fixed


def exactly_below(
    lp: StabilizationLP, k: int, x: Floats, gamma: float, cost: Floats | None
) -> bool:
    """Decide x <= gamma P_a x + G_a of one pair in exact arithmetic."""
    return Fraction(float(x[lp.cell[k]])) <= exact_backup(lp, k, x, gamma, cost)


def ordinary(lp: StabilizationLP, x: Floats, gamma: float, cost: Floats | None) -> bool:
    """Return whether the fast bounds of gamma P x + G are sharp: no overflow, no underflow."""
    top = max(x.max(initial=0.0), 0.0 if cost is None else cost.max(initial=0.0))
    return never_underflows(lp, x, gamma) and bool(top <= LARGEST / max(gamma, 1.0))


def never_underflows(lp: StabilizationLP, V: Floats, gamma: float) -> bool:
    """Return whether every product gamma share V is 0 or a normal double: none underflows."""
    positive = V[V > 0]
    if not len(positive):
        return True
    share = lp.rows.shares.value
    return float(positive.min()) * float(share.min()) * min(gamma, 1.0) > 1e-290


def worst_excess(lp: StabilizationLP, V: Floats) -> tuple[float, bool]:
    """Return max r_a / G_a over pairs with G_a > 0, and whether r_a > 0 where G_a = 0.

    r_a = max(0, V - lower bound of gamma P_a V - G_a), rounded up.
    """
    x = padded(lp, V)
    plain = never_underflows(lp, x, lp.gamma)
    loop, unused = (_open, (NO_PAIRS,)) if plain else (_carefully, (NO_BOUNDS, NO_PAIRS))
    found = over_cells(lp, loop, *lp._kernel, lp.gamma, lp.cost, x, *unused)
    return float(max(worst for _, worst, _ in found)), any(infinite for *_, infinite in found)


@kernel
def _product(k, rows, V):  # type: ignore[no-untyped-def]
    """The sum (P V)_k, its relative and its absolute rounding error.

    The absolute part covers shares and products below the normal range of doubles; it is 0 only
    where every term is 0.
    """
    pointer, target, code, share = rows
    q, top = 0.0, 0.0
    for e in range(pointer[k], pointer[k + ONE]):
        v = V[target[e]]
        if v != 0.0:
            top = v if v > top else top
            q += share[code[e]] * v
    entries = np.float64(pointer[k + ONE] - pointer[k])
    absolute = entries * LEAST * (1.0 + top) if top > 0.0 else 0.0
    return q, (entries + 8.0) * UNIT, absolute


@kernel
def _careful(k, rows, gamma, g, V):  # type: ignore[no-untyped-def]
    """A lower bound of gamma (P V)_k + g that minds underflow."""
    q, relative, absolute = _product(k, rows, V)
    if absolute == 0.0:
        return g
    future = q * (1.0 - relative) - absolute
    future = gamma * (0.0 if future < 0.0 else future)
    if not future <= LARGEST:
        return g
    below = (future + g) * (1.0 - 4.0 * UNIT) - 2.0 * LEAST
    return g if g > below else below


@kernel
def _plain(entries, q, gamma, g):  # type: ignore[no-untyped-def]
    """A lower bound of gamma (P V)_k + g where q is (P V)_k and no product underflows."""
    relative = (np.float64(entries) + 8.0) * UNIT
    future = gamma * (q * (1.0 - relative))
    below = (future + g) * (1.0 - 4.0 * UNIT) if future <= LARGEST else g
    return g if g > below else below


@kernel
def _inflow(policy, rows, gamma, mu, total, entries):  # type: ignore[no-untyped-def]
    pointer, target, code, share = rows
    for i in range(np.uint64(len(policy))):
        k = policy[i]
        for e in range(pointer[k], pointer[k + ONE]):
            total[target[e]] += gamma * (share[code[e]] * mu[i])
            entries[target[e]] += 1.0


@kernel
def _above(first, last, policy, rows, gamma, V, upper):  # type: ignore[no-untyped-def]
    pointer, target, code, share = rows
    for i in range(np.uint64(first), np.uint64(last)):
        k = policy[i]
        q = 0.0
        for e in range(pointer[k], pointer[k + ONE]):
            q += share[code[e]] * V[target[e]]
        relative = (np.float64(pointer[k + ONE] - pointer[k]) + 8.0) * UNIT
        upper[i] = gamma * (q * (1.0 + relative)) * (1.0 + 4.0 * UNIT)


@kernel
def _carefully_above(first, last, policy, rows, gamma, V, upper):  # type: ignore[no-untyped-def]
    for i in range(np.uint64(first), np.uint64(last)):
        q, relative, absolute = _product(policy[i], rows, V)
        future = gamma * (q * (1.0 + relative) + absolute)
        upper[i] = 0.0 if absolute == 0.0 else future * (1.0 + 4.0 * UNIT) + 2.0 * LEAST


@kernel
def _open(first, last, pair_pointer, rows, gamma, cost, V, found):  # type: ignore[no-untyped-def]
    """Find pairs whose bound is below V, the largest excess / cost, and if it is infinite."""
    pointer, target, code, share = rows
    count, worst, infinite = 0, 0.0, False
    for i in range(np.uint64(first), np.uint64(last)):
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            g = cost[k] if len(cost) else 0.0
            q = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q += share[code[e]] * V[target[e]]
            # Most rows hold by far more than rounding: no bound of their own for them.
            sure, entries = (gamma * q + g) * CLEAR, pointer[k + ONE] - pointer[k]
            if V[i] <= sure <= LARGEST and entries < LONG:
                continue
            excess = V[i] - _plain(entries, q, gamma, g)
            if excess > 0.0:
                if count < len(found):
                    found[count] = k
                count += 1
                if g > 0.0:
                    ratio = excess / g * (1.0 + 4.0 * UNIT)
                    worst = ratio if ratio > worst else worst
                else:
                    infinite = True
    return count, worst, infinite


@kernel
def _carefully(first, last, pair_pointer, rows, gamma, cost, V, lower, found):  # type: ignore[no-untyped-def]
    """All that :func:`_below` and :func:`_open` find out, minding underflow."""
    count, worst, infinite = 0, 0.0, False
    for i in range(np.uint64(first), np.uint64(last)):
        best = np.inf
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            g = cost[k] if len(cost) else 0.0
            below = _careful(k, rows, gamma, g, V)
            best = below if below < best else best
            excess = V[i] - below
            if excess > 0.0:
                if count < len(found):
                    found[count] = k
                count += 1
                if g > 0.0:
                    ratio = excess / g * (1.0 + 4.0 * UNIT)
                    worst = ratio if ratio > worst else worst
                else:
                    infinite = True
        if len(lower):
            lower[i] = best
    return count, worst, infinite

"""Vectors below the cost of every policy: value iterates, rounded down."""

from fractions import Fraction

import numpy as np

from lmdsl.certificate.bounds import (
    NO_PAIRS,
    _carefully,
    _plain,
    exact_backup,
    never_underflows,
    ordinary,
    undecided,
)
from lmdsl.certificate.sums import UNIT as UNIT
from lmdsl.certificate.sums import rounded_down
from lmdsl.certificate.vectors import over_cells, padded
from lmdsl.common.on_disk import filled
from lmdsl.common.types import Floats, TimeUp, never
from lmdsl.machine.kernels import ONE, kernel
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.policies.bellman import improve

MOST_LOWERED = 60  # number of sweeps over the pairs that are open, after which lowering is given up


def backup_below(lp: StabilizationLP, x: Floats, gamma: float, cost: Floats | None) -> Floats:
    """Return a lower bound of min_a gamma P_a x + G_a, shape (n,); ``cost`` None means 0."""
    if cost is None and ordinary(lp, x, gamma, None):  # the margin of the longest row for all
        terms = int(np.diff(lp.rows.pointer).max(initial=0)) + 8
        least: Floats = improve(lp, x, gamma, filled(lp.cost, 0.0)).value
        return least * (1 - terms * UNIT) * (1 - 4 * UNIT)
    lower, V = np.empty(lp.n), padded(lp, x)
    cost, plain = np.empty(0) if cost is None else cost, never_underflows(lp, V, gamma)
    loop, unused = (_below, ()) if plain else (_carefully, (NO_PAIRS,))
    over_cells(lp, loop, *lp._kernel, gamma, cost, V, lower, *unused)
    return lower


def lower_until_below(
    lp: StabilizationLP, x: Floats, gamma: float, cost: Floats | None, time_up: TimeUp = never
) -> Floats | None:
    """Lower x until x <= gamma P_a x + G_a holds for every pair; None where it does not settle.

    Only components that break the inequality move, each to a rounded-down right-hand side. The
    right-hand side is monotone in x, so nothing that holds is broken by more than it is lowered.
    """
    x = x.copy()
    for _ in range(MOST_LOWERED):
        if time_up():
            break
        open_pairs = undecided(lp, x, gamma, cost)
        if open_pairs is None:
            x = np.minimum(x, backup_below(lp, x, gamma, cost))
            continue
        lowered = False
        for k in open_pairs:
            i = int(lp.cell[k])
            bound = exact_backup(lp, int(k), x, gamma, cost)
            if Fraction(float(x[i])) > bound:
                x[i] = rounded_down(bound)
                lowered = True
        if not lowered:
            return x
    return None


def raise_from_zero(
    lp: StabilizationLP, gamma: float, cost: Floats, sweeps: int, time_up: TimeUp = never
) -> Floats:
    """Return value iterates from 0, rounded down: x <= T x holds along the whole way.

    x_{k+1} = max(x_k, rounded-down T x_k) <= T x_k <= T x_{k+1}, as T is monotone.
    """
    x = np.zeros(lp.n)
    for _ in range(sweeps):
        y = np.maximum(x, backup_below(lp, x, gamma, cost))
        if time_up() or np.all(y - x <= 1e-12 * y):
            return y
        x = y
    return x


@kernel
def _below(first, last, pair_pointer, rows, gamma, cost, V, lower):  # type: ignore[no-untyped-def]
    pointer, target, code, share = rows
    for i in range(np.uint64(first), np.uint64(last)):
        best = np.inf
        for k in range(pair_pointer[i], pair_pointer[i + ONE]):
            g = cost[k] if len(cost) else 0.0
            q = 0.0
            for e in range(pointer[k], pointer[k + ONE]):
                q += share[code[e]] * V[target[e]]
            below = _plain(pointer[k + ONE] - pointer[k], q, gamma, g)
            best = below if below < best else best
        lower[i] = best

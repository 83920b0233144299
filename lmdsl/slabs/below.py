"""Vectors below the cost of every policy over ranks: as ``optimize/descent.py`` makes them.

All ranks go on, and stop, together; whether a vector serves is for the judge to say.
"""

from fractions import Fraction

import numpy as np

from lmdsl.certificate import bounds
from lmdsl.certificate.sums import rounded_down
from lmdsl.certificate.vectors import padded
from lmdsl.common.types import Floats, TimeUp
from lmdsl.model.lp import StabilizationLP
from lmdsl.optimize.descent import MOST_LOWERED, backup_below
from lmdsl.optimize.witness import LEAST_PASSES, MOST_PASSES, MOST_READ
from lmdsl.ranks.verbs import Ranks

NEAR = 1e-11  # relative distance from V at which a vector below it is looked for first


def lower_vector(lp: StabilizationLP, V: Floats, tolerance: float, time_up: TimeUp) -> Floats:
    """Return W of claim 3 on own cells, as large as can be made from the value V; collective."""
    assert lp.mesh is not None
    ranks = lp.mesh.ranks
    found = _scaled(ranks, lp, V)
    for margin in (NEAR, min(tolerance, 1e-6) / 4):
        if found is None:
            found = _lowered(ranks, lp, V * (1 - margin), time_up)
    raised = None
    if found is None or _above(ranks, lp, V, found, tolerance):
        raised = _raised(ranks, lp, time_up)
    both = [x for x in (found, raised) if x is not None]
    return max(both, key=lambda x: sum(ranks.collect(float((lp.weight * x).sum()))))


def _above(ranks: Ranks, lp: StabilizationLP, V: Floats, W: Floats, tolerance: float) -> bool:
    """Return whether the gap is above the tolerance, about."""
    total = ranks.collect((float((lp.weight * (V - W)).sum()), float((lp.weight * V).sum())))
    return sum(a for a, _ in total) > tolerance * sum(b for _, b in total)


def _scaled(ranks: Ranks, lp: StabilizationLP, V: Floats) -> Floats | None:
    """Return (1 - eps) V where that serves, as one process does."""
    every = ranks.collect(bounds.worst_excess(lp, V))
    worst = max(w for w, _ in every)
    if any(infinite for _, infinite in every) or not worst < 1:
        return None
    for margin in (1.0, 2.0, 16.0):
        W: Floats = V * (1 - margin * worst / (1 + worst) - (margin - 1) * 1e-15)
        if ranks.all(bounds.holds_for_all(lp, W, lp.gamma, lp.cost)):
            return W
    return None


def _lowered(ranks: Ranks, lp: StabilizationLP, x: Floats, time_up: TimeUp) -> Floats | None:
    """Lower x until the inequality of claim 3 holds for every pair; None if it does not settle."""
    for _ in range(MOST_LOWERED):
        if time_up():
            break
        V = padded(lp, x)
        pairs = bounds._undecided(lp, V, lp.gamma, lp.cost)
        if ranks.any(pairs is None):
            x = np.minimum(x, backup_below(lp, x, lp.gamma, lp.cost))
            continue
        lowered = False
        for k in pairs if pairs is not None else ():
            i, bound = int(lp.cell[k]), bounds.exact_backup(lp, int(k), V, lp.gamma, lp.cost)
            if Fraction(float(V[i])) > bound:
                V[i], lowered = rounded_down(bound), True
        x = V[: lp.n].copy()
        if not ranks.any(lowered):
            return x
    return None


def _raised(ranks: Ranks, lp: StabilizationLP, time_up: TimeUp) -> Floats:
    """Return value iterates from 0, rounded down."""
    x = np.zeros(lp.n)
    entries = sum(ranks.collect(len(lp.rows.target)))
    for _ in range(max(LEAST_PASSES, min(MOST_PASSES, MOST_READ // max(entries, 1)))):
        y = np.maximum(x, backup_below(lp, x, lp.gamma, lp.cost))
        settled = ranks.all(bool((y - x <= 1e-12 * y).all()))
        x = y
        if settled or time_up():
            break
    return x

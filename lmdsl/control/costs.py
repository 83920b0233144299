"""What runs paid in the mean, and a bound of what those pay later that have not ended."""

from fractions import Fraction

import numpy as np

from lmdsl.common.types import Bools
from lmdsl.control.after_arrival import quantiles
from lmdsl.control.loop import CYCLING, LOST, REACHED, ClosedLoop, Runs
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem

MeanCost = dict[str, float | None]


def counted(problem: Problem, runs: Runs) -> Bools:
    """Return which runs have a cost, shape (r,): a lost run has none, however early it was lost.

    Where gamma times the discount is below 1 staying away for ever has a finite cost as well.
    """
    if problem.ends_in_time:
        return np.asarray(runs.outcome != LOST)
    return np.asarray(runs.outcome == REACHED)


def mean_cost(loop: ClosedLoop, runs: Runs) -> MeanCost | None:
    """Return the mean cost of runs, its standard error, what it lacks, and quantiles.

    None if it is not known.
    """
    on = counted(loop.problem, runs)
    cost = runs.cost[on]
    if not len(cost) or np.isnan(cost).any():
        return None
    with np.errstate(all="ignore"):
        error = float(cost.std(ddof=1) / np.sqrt(len(cost))) if len(cost) > 1 else None
        return {
            "mean": float(cost.mean()),
            "standard_error": error,
            "runs": len(cost),
            "cut_off": _cut_off(loop, runs, float((runs.outcome[on] == CYCLING).mean())),
            **quantiles(cost),
        }


def _cut_off(loop: ClosedLoop, runs: Runs, share: float) -> float:
    """Return a bound of what the mean lacks, as a share of the runs goes on.

    After n steps a run costs (gamma b)^n (G/(1 - gamma b) + t) more at most, if no step costs more
    than the dearest of all runs, G, and no end more than the dearest of the cells of A, t.
    """
    if not share or not runs.power:
        return 0.0
    problem = loop.problem
    left = 1 - Fraction(problem.gamma) * Fraction(problem.discount or 1.0)
    attractor = np.flatnonzero(loop.status == CellStatus.ATTRACTOR)
    end = float(loop.paid(loop.partition.centres(attractor)).max(initial=0.0))
    return share * runs.power * (runs.dearest / float(left) + end)

"""What looks wrong with recorded data: pairs without any, and too few to say what a pair may do."""

import math
from collections.abc import Iterator

import numpy as np

from lmdsl.advice.report import Finding
from lmdsl.data.intervals import Family, unseen_of
from lmdsl.data.report import UNSEEN_LEVEL
from lmdsl.model.discretization import control_count
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.systems import DataSystem

MANY = 10**6  # draws of a pair, from which the number wanted is worked out
MISSING, HIDDEN, AIM = 0.1, 0.5, 0.1
"""Share of pairs without data, and median of the unseen mass, above which they are named; the mass
that the remedy aims at."""


def few(problem: Problem) -> Iterator[Finding]:
    """Find that many pairs of cells outside A and Z have no data, or hardly any."""
    system = problem.system
    if not isinstance(system, DataSystem):
        return
    free = CellSets.of(problem, Partition.of(problem)).free
    family = Family(len(free) * control_count(problem), len(free) + 2)
    rows = system.rows
    kept = np.flatnonzero(np.isin(rows.cell, free))
    if not family.pairs or not len(kept):
        return
    successors = np.minimum(np.diff(rows.pointer)[kept], family.outcomes)
    total = system.totals()[kept]
    limit = float(np.median(unseen_of(successors, total, family, UNSEEN_LEVEL)))
    missing = 1 - len(kept) / family.pairs
    if missing <= MISSING and limit <= HIDDEN:
        return
    typical = int(np.median(total))
    of_many = unseen_of(np.median(successors), np.array(MANY), family, UNSEEN_LEVEL)
    wanted = math.ceil(MANY * math.log1p(-float(of_many)) / math.log1p(-AIM))
    yield Finding(
        "few_data",
        "x",
        f"{100 * missing:.3g} % of the pairs of a free cell and a control were not recorded, the "
        f"others {typical} times (median): what such a pair was not seen to do may have a "
        f"probability of {limit:.2g} (upper limit at {100 * UNSEEN_LEVEL:.0f} %)",
        f"record more transitions (about {wanted} of each pair make it {AIM:g}), or take fewer "
        "cells and controls",
        {"missing": missing, "median": typical, "unseen": limit, "wanted": wanted},
    )

"""Which cells can be stabilized, and why others cannot."""

from collections.abc import Iterable

from reference.model import (
    ATTRACTOR,
    AVOID,
    ESCAPES,
    LEADS,
    STABILIZED,
    TRAPPED,
    Pair,
    ReferenceModel,
    Row,
)
from reference.sets import measure_cells


def can_reach(model: ReferenceModel, pairs: Iterable[Pair]) -> set[int]:
    """Cells from which A is reached with positive probability through the given pairs.

    Where runs end by discount in time, their end is as good as A.
    """
    pairs = list(pairs)
    if model.ends:
        return {cell for cell, _ in pairs}
    reached: set[int] = set()
    while True:
        more = {
            cell
            for cell, control in pairs
            if cell not in reached and reaches_in_one(model.rows[cell, control], reached)
        }
        if not more:
            return reached
        reached |= more


def reaches_in_one(row: Row, reached: set[int]) -> bool:
    targets, absorbed, _ = row
    return absorbed > 0 or any(t in reached for t in targets)


def surely_reaching(model: ReferenceModel, pairs: Iterable[Pair]) -> tuple[set[int], set[Pair]]:
    """Greatest set of cells that can stay in it until A, from all of which A is reached.

    Returned with the given pairs of its cells whose successors are all in the set or in A.
    """
    keep = set(pairs)
    cells = {cell for cell, _ in keep}
    while True:
        keep = {p for p in keep if p[0] in cells and all(t in cells for t in model.rows[p][0])}
        good = can_reach(model, keep)
        if good == cells:
            return cells, keep
        cells = good


def classify(model: ReferenceModel) -> None:
    """Fill in cell_status, surviving and m."""
    C, surviving = surely_reaching(model, model.admissible)
    reach = can_reach(model, model.admissible)
    some_pair = {cell for cell, _ in model.admissible}
    nothing_to_reach = not (model.attractor or "discount" in model.problem)
    for cell in range(model.N):
        if cell in model.attractor:
            status = ATTRACTOR
        elif cell in model.avoid:
            status = AVOID
        elif cell in C:
            status = STABILIZED
        elif cell not in some_pair and not nothing_to_reach:
            status = ESCAPES
        elif cell not in reach or nothing_to_reach:
            status = TRAPPED
        else:
            status = LEADS
        model.cell_status.append(status)
    model.surviving = sorted(surviving)
    wanted = measure_cells(model.problem)
    support = sorted(C if wanted is None else C & wanted)
    model.m = {c: 1.0 / len(support) for c in support}

"""Checking upper bounds on parts of cells: nothing of how they were found is used.

A bound is at least that of the boxes that its part meets, or what following the part anew makes of
the other bounds. As runs that arrive do so in finitely many steps, induction over these makes it a
bound (docs/mathematics.md).
"""

import numpy as np

from lmdsl.common.types import Bools, Guard, Indices
from lmdsl.model.grid.boxes import named
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.proof.bounds.flights.following import Flights, Upper
from lmdsl.proof.bounds.flights.refining import DEEPEST, Above, begun
from lmdsl.proof.bounds.optimum.averages import Arrays
from lmdsl.proof.bounds.optimum.parts import Parts
from lmdsl.proof.loop import Loop

CUTS = 3  # times that parts are cut once more where their bound does not follow
SOME = 2**18  # parts checked between two looks at the clock


def checked_above(loop: Loop, arrays: Arrays, guard: Guard) -> tuple[Above | None, list[str]]:
    """Return the upper bounds among the arrays of a proof, and what does not hold of them.

    They are None where they are no bounds at all.
    """
    above = Above(arrays["above_split"], arrays["above"])
    small = bool((above.split <= DEEPEST).all())
    parts = Parts.of(loop.partition, above.split.astype(np.int64)) if small else None
    if parts is None or parts.size != len(above.bound):
        return None, ["proof.npz: above_split does not fit the number of parts in above"]
    flights = Flights(loop)
    if not flights.able:
        return None, ["proof.npz: above bounds runs with noise, which cannot be followed"]
    part = fault(flights, arrays, above, guard)
    if part < 0:
        return above, []
    cell = named(loop.partition, int(parts.cell(loop.partition, np.array([part]))[0]))
    said = float(above.bound[part])
    return above, [
        f"proof.npz: above says that runs from part {part}, in {cell}, cost at most {said!r}, but "
        "some may cost more"
    ]


def fault(flights: Flights, boxes: Arrays, above: Above, guard: Guard) -> int:
    """Return a part whose bound does not follow from others and from boxes; -1 where all do."""
    parts = Parts.of(flights.loop.partition, above.split.astype(np.int64))
    doubted = np.flatnonzero(~(above.bound >= begun(flights, boxes, parts)))
    cell = parts.cell(flights.loop.partition, doubted)
    outside = flights.loop.status[cell] != CellStatus.STABILIZED
    if outside.any():
        return int(doubted[np.argmax(outside)])
    for start in range(0, len(doubted), 2**18):
        guard()
        some = doubted[start : start + 2**18]
        wrong = ~_follows(flights, parts, some, above.bound, CUTS)
        if wrong.any():
            return int(some[np.argmax(wrong)])
    return -1


def _follows(flights: Flights, parts: Parts, some: Indices, known: Upper, cuts: int) -> Bools:
    """Return whether bounds follow: from whole parts, or else from pieces of them, cut again."""
    fine, found = parts, known[some] >= flights.bounds(parts, some, known, parts)[0]
    left, owner = some[~found], np.flatnonzero(~found)
    for _ in range(cuts):
        if not len(left):
            break
        left, fine = halves(flights.loop, fine, left)
        owner = np.repeat(owner, 2 ** len(fine.split))
        found[owner] = True
        bad = ~(known[some[owner]] >= flights.bounds(fine, left, known, parts)[0])
        left, owner = left[bad], owner[bad]
        found[owner] = False
    return np.asarray(found)


def halves(loop: Loop, parts: Parts, some: Indices) -> tuple[Indices, Parts]:
    """Return the pieces of parts, cut once along every axis, those of each together."""
    fine = Parts.of(loop.partition, parts.split + 1)
    index, d = 2 * parts.by_axis(some), len(parts.split)
    corners = np.stack(np.meshgrid(*[np.arange(2)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    found = ((index[:, None] + corners) * fine.stride).sum(axis=-1)
    return np.asarray(found.ravel()), fine

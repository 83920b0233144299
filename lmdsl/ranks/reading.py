"""Values read by global number: what claims rest on.

A claim is not to believe the plan by which the answer was made. So every value that it reads comes
with the number of its cell, from the rank that owns it, and is compared; nothing is kept from
before. It costs twice the bytes of a halo, a few times in a solve.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats
from lmdsl.ranks.mesh import Halo, Mesh
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import RankError, Ranks

NUMBERED = 2.0**53  # above which a number is no double


def read(ranks: Ranks, division: Division, cells: NDArray[np.integer], own: Floats) -> Floats:
    """Return the values of cells of any rank, by global numbers; collective.

    ``own`` are those of the own cells.
    """
    first, last = division.own(ranks.rank)
    if len(own) != last - first or division.cells >= NUMBERED:
        raise RankError(f"rank {ranks.rank} has {len(own)} values for {last - first} cells")
    cells = np.asarray(cells, dtype=np.int64)
    answers: dict[int, NDArray[Any]] = {}
    owned = division.by_owner(cells)
    asked = {k: cells[own] for k, own in owned.items()}
    for other, wanted in ranks.exchange(asked).items():
        if len(wanted) and not (first <= wanted.min() and wanted.max() < last):
            raise RankError(f"rank {other} asks rank {ranks.rank} for cells that it has not")
        answers[other] = np.concatenate([wanted.astype(np.float64), own[wanted - first]])
    came = ranks.exchange(answers)
    if [*came] != [*asked]:
        raise RankError(f"rank {ranks.rank} got no answer from some of the ranks {[*asked]}")
    found = np.empty(len(cells))
    for other, answer in came.items():
        numbers, values = np.split(answer, 2)
        if not np.array_equal(numbers, asked[other]):
            raise RankError(f"rank {other} answers rank {ranks.rank} for other cells than asked")
        found[owned[other]] = values
    return found


def added(
    ranks: Ranks, division: Division, cells: NDArray[np.integer], values: Floats, own: Floats
) -> Floats:
    """Return own values with what other ranks add to them, in the order of ranks; collective."""
    first, last = division.own(ranks.rank)
    parcels = {
        k: np.concatenate([cells[own].astype(np.float64), values[own]])
        for k, own in division.by_owner(np.asarray(cells, dtype=np.int64)).items()
    }
    total = own.copy()
    for other, came in ranks.exchange(parcels).items():
        numbers, more = np.split(came, 2)
        at = numbers.astype(np.int64) - first
        if len(at) and not (at.min() >= 0 and at.max() < last - first):
            raise RankError(f"rank {other} adds to cells that rank {ranks.rank} has not")
        np.add.at(total, at, more)
    return total


class Read(Mesh):
    """A mesh whose ghosts are read by global number, not by the plans of another."""

    @classmethod
    def again(cls, mesh: Mesh) -> "Read":
        """Return the same cells, of whose plans nothing is used."""
        return cls(mesh.ranks, mesh.division, mesh.ghosts.copy())

    def spread(
        self, own: NDArray[Any], attractor: Any = 0.0, halo: Halo | None = None
    ) -> NDArray[Any]:
        """Return own values, those of the ghosts and the attractor's; collective."""
        values = read(self.ranks, self.division, self.ghosts, np.asarray(own, dtype=np.float64))
        return np.concatenate([own, values, [attractor]])

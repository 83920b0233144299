"""The chain of a policy on rank 0: what is a small part of the model, and needs all cells at once.

A policy has one row for each cell, where the model has one for every control. So the rows of all
pairs stay where they are, and rank 0 evaluates the policy with the code of one process: to the same
bits, whatever the number of ranks. (Up to about 10^6 cells; beyond, the core of the chain has to be
swept over ranks.)
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Bools, Indices, Policy
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.lp import StabilizationLP
from lmdsl.ranks.mesh import Mesh


@dataclass(frozen=True)
class First:
    """Rank 0, and what the others send it; every method is collective."""

    lp: StabilizationLP  # of own cells

    @property
    def mesh(self) -> Mesh:
        """The own cells and ghosts of this rank."""
        assert self.lp.mesh is not None
        return self.lp.mesh

    @property
    def here(self) -> bool:
        """Whether this is rank 0."""
        return self.mesh.ranks.rank == 0

    def gathered(self, own: NDArray[Any]) -> NDArray[Any]:
        """Return the values of all cells on rank 0, nothing on the others."""
        found = self.mesh.ranks.gathered(own)
        return own[:0] if found is None else found

    def scattered(self, values: NDArray[Any] | None) -> NDArray[Any]:
        """Return the own part of what rank 0 has for all cells."""
        starts = self.mesh.division.starts
        parts = None if values is None else np.split(values, starts[1:-1])
        return self.mesh.ranks.scatter(parts)

    def told(self, values: NDArray[Any] | None) -> NDArray[Any] | None:
        """Return the own part of what rank 0 has for all cells; None where it has nothing."""
        if not self.mesh.ranks.share(values is not None):
            return None
        return self.scattered(values)

    def model(self, columns: Indices) -> StabilizationLP | None:
        """Return the model of some own columns of every rank, on rank 0; None on the others.

        ``columns`` ascend; every cell has one.
        """
        lp, mesh = self.lp, self.mesh
        own = lp.rows.take(columns)
        cell = owner(lp.pair_pointer)[columns]
        length = self.gathered(np.diff(own.pointer))
        pairs = self.gathered(np.bincount(cell, minlength=lp.n).astype(np.int64))
        target, code = self.gathered(mesh.numbers[own.target]), self.gathered(own.code)
        control, cost = self.gathered(lp.control[columns]), self.gathered(lp.cost[columns])
        cells, weight = self.gathered(lp.cells), self.gathered(lp.weight)
        if not self.here:
            return None
        rows = replace(
            own, pointer=np.append(0, np.cumsum(length)).astype(np.int64),
            target=target.astype(np.int32), code=code, columns=mesh.division.cells,
        )  # fmt: skip
        return replace(
            lp, cells=cells, pair_pointer=np.append(0, np.cumsum(pairs)).astype(np.int64),
            control=control, rows=rows, cost=cost, weight=weight, mesh=None,
        )  # fmt: skip

    def chosen(self, allowed: Bools, column: Policy | None) -> Policy:
        """Return the own columns that rank 0 chose in the model of those that are allowed."""
        columns = np.flatnonzero(allowed)
        counts = self.mesh.ranks.collect(len(columns))
        mine = self.scattered(column) - sum(counts[: self.mesh.ranks.rank])
        policy: Policy = columns[mine]
        return policy

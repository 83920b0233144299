"""The phase-one LP: how much mass of which cells cannot be stabilized, in the l1 norm.

Over all F cells outside A and Z and all their admissible pairs, with m the weight that ``measure``
gives to these cells (uniform by default), total 1, and g = max(gamma, 1):

    min  sum_i |r_i|   s.t.   r = m - (E - g P)'theta,   theta >= 0.

Nothing is renormalised. Mass that starts in, or is sent to, a cell without admissible pairs has no
theta to take it away and stays in r; a trap cannot get rid of its mass either. g stands for gamma,
as everywhere where stability is meant: with a discount, staying for ever has a finite occupation.

The dual is  max m'y  s.t.  y_i <= g (P_a y)_i for every admissible pair of cell i, |y| <= 1, and
its greatest solution is y = min(1, g min_a P_a y): the share of the mass started in cell i that is
lost whatever is done. The two answers differ in whom they name. r says where the mass is in the
end, and is not unique: within a trap it may rest in any cell. m_i y_i says whose mass it was, and
is unique; both sum to the optimum. For gamma <= 1, 1 - y_i is the greatest probability of reaching
A from cell i through admissible pairs, and with m > 0 everywhere the optimum is 0 exactly if every
cell is stabilizable. For gamma > 1 it is positive also where gamma is too large.
"""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from lmdsl.common.records import Frozen, jsonable
from lmdsl.common.types import Floats, Indices, Statuses
from lmdsl.errors import LmdslError, shown
from lmdsl.explanation.one_cell import NAMES
from lmdsl.machine import apart, linprog, memory
from lmdsl.machine.deadline import Deadline
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid import boxes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus

SMALL = 1e-6  # share of the mass up to which a loss counts as none
MOST_CELLS = 100  # number of cells above which only the largest losses are listed
BYTES = 150  # bytes per entry of the LP: SciPy's copies and the factors of HiGHS, roughly


@dataclass(frozen=True, repr=False, eq=False)
class PhaseOne(Frozen):
    """The solution of the phase-one LP.

    Attributes
    ----------
    partition
        Geometry of the cells.
    cells
        The cells outside A and Z, by index in the box, shape (F,).
    cause
        Their codes of :class:`lmdsl.model.stabilizable_set.CellStatus`, shape (F,).
    weight
        m, shape (F,), sum 1.
    residual
        r, computed from theta, shape (F,): the mass that is left in each cell.
    lost
        m_i y_i, shape (F,): the mass started in each cell that cannot be stabilized.
    total
        The sum of the absolute values of r.
    """

    partition: Partition
    cells: Indices
    cause: Statuses
    weight: Floats
    residual: Floats
    lost: Floats
    total: float

    @classmethod
    def of(
        cls,
        partition: Partition,
        transitions: Transitions,
        status: Statuses,
        gamma: float,
        deadline: Deadline | None = None,
    ) -> Self:
        """Solve the LP with HiGHS (interior point, then crossover).

        Raises
        ------
        TimeLimitReached
            The deadline has passed.
        LmdslError
            HiGHS does not solve it.
        """
        from scipy.sparse import csr_array, eye_array, hstack

        rows, pointer = transitions.rows, transitions.pair_pointer
        F, K = rows.columns, rows.count
        cells = transitions.sets.free
        weight = transitions.sets.weight(cells)
        if not F:
            return cls(partition, cells, status[cells], weight, np.zeros(0), np.zeros(0), 0.0)
        entries = K + len(rows.target) + 2 * F
        memory.require(BYTES * entries, f"phase-one LP of {entries} entries")
        E = csr_array((np.ones(K), owner(pointer), np.arange(K + 1)), shape=(K, F))
        B = (E - max(gamma, 1.0) * rows.matrix()).T.tocsc()
        price = np.concatenate([np.zeros(K), np.ones(2 * F)])
        # The weights are scaled to 1 so that the solver's tolerances mean the same for every F.
        scale = max(int((weight > 0).sum()), 1)
        deadline, doing = Deadline.of(deadline), "solving the phase-one LP"
        deadline.raise_if_over(doing)
        matrix = hstack([B, eye_array(F), -eye_array(F)], format="csc")
        x, marginals, failed = apart.call(
            linprog.solved, price, matrix, weight * scale, deadline.left,
            deadline=deadline, doing=doing,
        )  # fmt: skip
        if failed:
            deadline.raise_if_over(doing)
            raise LmdslError(f"the phase-one LP was not solved: {shown(failed, 200)}")
        theta = np.maximum(x[:K], 0.0) / scale
        residual = weight - B @ theta
        residual[np.abs(residual) <= SMALL / scale] = 0.0
        share = np.clip(marginals, 0.0, 1.0)
        share[share <= SMALL] = 0.0
        total = float(np.abs(residual).sum())
        return cls(partition, cells, status[cells], weight, residual, weight * share, total)

    def by_cause(self) -> dict[str, dict[str, float]]:
        """Return by cause the mass that starts there, the part of it lost, and what rests there."""
        found = {}
        for code in np.unique(self.cause):
            of = self.cause == code
            found[NAMES[CellStatus(code)]] = {
                "mass": float(self.weight[of].sum()),
                "lost": float(self.lost[of].sum()),
                "residual": float(np.abs(self.residual[of]).sum()),
            }
        return found

    def largest(self) -> Indices:
        """Return the positions of the cells that lose most, at most 100, largest first."""
        order = np.argsort(-self.lost, kind="stable")[:MOST_CELLS]
        return order[self.lost[order] > 0]

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data; the cells that lose most, at most 100 of them."""
        listed = [
            {
                "cell": int(self.cells[i]),
                "box": jsonable(boxes.of_cell(self.partition, int(self.cells[i]))),
                "mass": float(self.weight[i]),
                "lost": float(self.lost[i]),
            }
            for i in self.largest()
        ]
        return {
            "total": self.total,
            "lost": float(self.lost.sum()),
            "cells_losing": int((self.lost > 0).sum()),
            "by_cause": self.by_cause(),
            "cells": listed,
        }

    def text(self) -> str:
        """Return a summary for people."""
        lines = [
            f"phase one: {100 * self.total:.4g} % of the mass cannot be stabilized "
            f"(l1 residual {self.total:.6g}; {int((self.lost > 0).sum())} cells lose mass)"
        ]
        for name, entry in self.by_cause().items():
            lines.append(
                f"  {name}: loses {entry['lost']:.6g} of its {entry['mass']:.6g}; "
                f"{entry['residual']:.6g} rests there"
            )
        return "\n".join(lines)

    __str__ = text

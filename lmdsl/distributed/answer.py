"""What a solve over ranks returns on every rank."""

from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate.claims import Certificate
from lmdsl.common.types import Floats, Indices, Statuses
from lmdsl.control.simulation import Simulation
from lmdsl.model.grid.boxes import Area
from lmdsl.model.grid.partition import Partition
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.results.result import missed_rewards
from lmdsl.results.status import Cause
from lmdsl.results.summary import Coverage, Summary


@dataclass(frozen=True, kw_only=True, eq=False)
class Answer(Summary):
    """The answer to a problem over ranks; see :class:`Summary` for the scalars.

    All but the arrays by cell is the same on every rank. These hold the cells of the own part of
    the box, ``starts[rank]`` to ``starts[rank + 1] - 1`` in C order; one after the other they are
    those of a :class:`lmdsl.Result`.

    Attributes
    ----------
    problem, partition, certificate, cause, iterations, control_vectors
        As of a Result.
    starts
        The first cell of the part of every rank, then N, shape (ranks + 1,). All 0 where there was
        no time to compile: then there are no arrays.
    counted
        Number of all cells by :class:`CellStatus`.
    sure
        Number of cells from which some controller surely enters A; None: not known.
    area
        The cells proved infeasible at this gamma, by region; None where none is.
    control_index, value, lower, measure, cell_status, witness, sure_levels
        As of a Result, of own cells.
    dropped
        Pairs (cell, control) left out, (D, 2), of all cells; or None.
    ended_by_discount
        As of a Result.
    model_sha256, digest
        Version 2 of the digest of the model: the same for every number of ranks.
    ghosts
        Number of cells of others that ranks keep values of, for each cell of C: what talking costs.
        None where nothing was compiled.
    ghosts_by_axis
        About how many they would be, were the box cut along each axis, by name, as some cells tell:
        what declaring it first would change. Of more than 16 ranks, what 16 would know; axes with
        fewer cells are left out. None with one rank, of one axis, of finite models and recorded
        data.
    lp
        The model of own cells, as :func:`lmdsl.slabs.compiling.compiled` returns it.
    """

    problem: Problem
    partition: Partition
    certificate: Certificate
    cause: Cause | None = None
    iterations: int | None = None
    control_vectors: Floats
    starts: Indices
    counted: tuple[int, ...]
    sure: int | None = None
    area: Area | None = None
    control_index: NDArray[np.int32]
    value: Floats
    lower: Floats
    measure: Floats
    cell_status: Statuses
    witness: Floats
    sure_levels: NDArray[np.int32] | None = None
    dropped: NDArray[np.int64] | None = None
    ended_by_discount: float | None = None
    model_sha256: str = ""
    digest: int = 2
    gap_before_polish: None = None
    proof: None = None
    ghosts: float | None = None
    ghosts_by_axis: dict[str, float] | None = None
    lp: StabilizationLP | None = field(default=None, compare=False)

    @property
    def verified(self) -> bool:
        """True when the certificate is complete and the gap within the tolerance."""
        return self.certificate.verified

    @property
    def reward(self) -> float | None:
        """The mean reward by m that the policy earns at least; None where costs are minimised."""
        missed = missed_rewards(self.problem)
        return None if missed is None or self.cost is None else missed - self.cost

    @property
    def coverage(self) -> Coverage | None:
        """How much of what is neither attractor nor avoided is stabilizable; None if unknown."""
        if not any(self.counted):
            return None
        given = self.counted[CellStatus.ATTRACTOR] + self.counted[CellStatus.AVOID]
        inside, free = self.counted[CellStatus.STABILIZED], sum(self.counted) - given
        return Coverage(inside, free, inside / free if free else None)

    @property
    def sure_cells(self) -> int | None:
        """Number of cells from all of which some controller surely enters A; None: not known."""
        return self.sure

    @property
    def beyond_gamma(self) -> Area | None:
        """The cells proved infeasible at this gamma, by region; None where none is."""
        return self.area

    def with_runs(self, simulation: Simulation | None) -> Self:
        """Return the same with runs of the true map."""
        return replace(self, simulation=simulation)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of own cells by name, as a result directory names them."""
        names = ("control_index", "value", "lower", "measure", "cell_status", "witness")
        found: dict[str, NDArray[Any]] = {name: getattr(self, name) for name in names}
        if self.sure_levels is not None:
            found["sure_levels"] = self.sure_levels
        return found

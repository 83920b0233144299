"""What a solve returns: status, certificate, controller, and the arrays over all cells."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate import sums
from lmdsl.certificate.claims import Certificate
from lmdsl.common import inputs
from lmdsl.common.records import Later, freeze
from lmdsl.common.types import Bools, Floats, Progress, Statuses, told
from lmdsl.control.questions import InUse
from lmdsl.errors import BadInput, shown
from lmdsl.machine.forking import cached_property
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.boxes import Area
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.results.status import Cause, Status
from lmdsl.results.summary import Carried, CostFrom, Coverage, Paged, Summary
from lmdsl.systems import MatrixSystem

if TYPE_CHECKING:
    import os

    from lmdsl.model.lp import StabilizationLP
    from lmdsl.proof.record import Proof

_LATER: Any = Later()


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Result(Paged, Carried, Summary, InUse):
    """The answer to a problem; see :class:`Summary` for the scalars.

    Attributes
    ----------
    problem
        The problem solved, overrides included.
    certificate
        The proved claims; ``certificate.verified`` and ``certificate.reasons``.
    control_index
        Shape (N,), int32: index into ``control_vectors``, -1 where there is none.
    value, lower
        Shape (N,): V_up and W, 0 on A, infinity off C (V_up also where not established).
    measure
        Shape (N,): the Lyapunov measure mu, 0 off C.
    cell_status
        Shape (N,), uint8: the codes of :class:`lmdsl.model.stabilizable_set.CellStatus`.
    witness
        Shape (N,): ``stability_vector`` and ``refusal_vector``, as they are saved.
    control_vectors
        Shape (M, p).
    sure_levels
        Shape (N,), int32, or None: in how many steps some controller surely enters A, -1: unknown.
    dropped, declared_lower
        Pairs (cell, control) dropped by repair, (D, 2), and W of the model with all, (N,); or None.
    proof
        What becomes of C: of a problem solved with ``proved``, or of a directory that holds a
        proof, read unchecked when it is first asked for; else None.
    iterations
        Iterations in the backend's own sense.
    log
        What the backend printed, its last 64 KiB; it is printed nowhere and not saved.
    gap_before_polish
        Gap of the backend's own policy, None where nothing could be certified of it.
    lp
        The compiled model; None for a result read from a directory.
    model_sha256, digest
        Digest of the compiled model, as read from a directory, and its version: 1, or 2 of a model
        that was compiled over ranks.
    cause
        Why it is not stabilizable: ``empty``, ``measure``, ``gamma``, ``require_all``, ``hold``.
    """

    problem: Problem
    partition: Partition
    certificate: Certificate
    control_index: NDArray[np.int32]
    value: Floats
    lower: Floats
    measure: Floats
    cell_status: Statuses
    witness: Floats
    control_vectors: Floats
    sure_levels: NDArray[np.int32] | None = None
    dropped: NDArray[np.int64] | None = None
    declared_lower: Floats | None = None
    proof: Proof | None = _LATER
    iterations: int | None = None
    log: str = ""
    gap_before_polish: float | None = None
    cause: Cause | None = None
    lp: StabilizationLP | None = None
    model_sha256: str = ""
    digest: int = 1

    @property
    def verified(self) -> bool:
        """True when the certificate is complete and the gap within the tolerance."""
        return self.certificate.verified

    @property
    def coverage(self) -> Coverage | None:
        """How much of what is neither attractor nor avoided is stabilizable; None if unknown."""
        return None if self.attractor_cells is None else Coverage.of(self.cell_status)

    @property
    def reward(self) -> float | None:
        """The mean reward by m that the policy earns at least; None where costs are minimised."""
        missed = missed_rewards(self.problem)
        return None if missed is None or self.cost is None else missed - self.cost

    @property
    def rewards(self) -> Floats | None:
        """What the policy earns at least from each cell, shape (N,): 0 on A, minus infinity off C.

        None where costs are minimised.
        """
        missed = missed_rewards(self.problem)
        if missed is None:
            return None
        attractor = self.cell_status == CellStatus.ATTRACTOR
        return np.where(attractor, 0.0, missed - self.value)

    @property
    def ended_by_discount(self) -> float | None:
        """The share of runs that the discount ends before they reach A; None unless gamma is 1.

        It is (1 - b) sum(mu): mu counts visits, each the last one with probability 1 - b.
        """
        if self.problem.discount is None or self.gamma != 1 or not self.certificate.measure:
            return None
        return min(1.0, (1 - self.problem.discount) * math.fsum(self.measure))

    @property
    def counted(self) -> tuple[int, ...]:
        """Number of cells by :class:`CellStatus`; of a result without a model nothing is known."""
        found = np.bincount(self.cell_status, minlength=len(CellStatus))
        return tuple(found[: len(CellStatus)].tolist())

    @property
    def stability_vector(self) -> Floats:
        """The vector w of claim 1, shape (N,): 0 where there is none."""
        return np.where(self._refused, 0.0, self.witness)

    @property
    def refusal_vector(self) -> Floats:
        """The vector that proves gamma infeasible, shape (N,): 0 where it is not proved."""
        return np.where(self._refused, self.witness, 0.0)

    @property
    def _refused(self) -> Bools:
        beyond: Bools = self.cell_status == CellStatus.BEYOND_GAMMA
        return beyond | np.bool_(self.status == Status.NOT_STABILIZABLE)

    @cached_property
    def beyond_gamma(self) -> Area | None:
        """The cells proved infeasible at this gamma, by region; None where none is."""
        mask = self.cell_status == CellStatus.BEYOND_GAMMA
        if self.cause == Cause.GAMMA:
            mask = mask | (self.refusal_vector > 0)
        return Area.of(self.partition, np.flatnonzero(mask)) if mask.any() else None

    @cached_property
    def weight(self) -> Floats:
        """The user's m over all cells, shape (N,), sum 1 (all zero where none lies in C)."""
        weight = np.zeros(self.partition.size)
        on = np.flatnonzero(self.cell_status == CellStatus.STABILIZED)
        weight[on] = CellSets.of(self.problem, self.partition).weight(on)
        freeze(weight)
        return weight

    @own_arithmetic
    def cost_from(self, *boxes: Mapping[str, tuple[float, float]]) -> CostFrom:
        """Return the conditional cost of starting in a region: sum over B of m V / m(B).

        Parameters
        ----------
        boxes
            Axis name to ``(a, b)``; the region is the cells of C inside their union.

        Raises
        ------
        BadInput
            No cell of the region carries weight.
        """
        blocks = []
        for i, box in enumerate(boxes):
            inputs.kind(box, Mapping, f"boxes[{i}]", "a box; write {axis: (a, b)}")
            for name in box:
                if name not in self.partition.names:
                    raise BadInput(f"{shown(name)} is not an axis", f"boxes[{i}]")
            box = {name: inputs.interval(ends, f"boxes[{i}].{name}") for name, ends in box.items()}
            blocks.append(self.partition.inside_box(box, f"boxes[{i}]"))
        weight = np.where(self.partition.mask(blocks), self.weight, 0.0)
        if not weight.any():
            raise BadInput("no cell of C inside the boxes carries weight; enlarge them", "boxes")
        upper = sums.mean(weight, self.value, math.inf)
        return CostFrom(upper, sums.mean(weight, self.lower, -math.inf), math.fsum(weight))

    @own_arithmetic
    def prove(
        self, target: float = 0.999, time_limit: float | None = None, *, bracket: bool = False,
        progress: Progress | bool | None = None,
    ) -> Proof:  # fmt: skip
        """Prove what becomes of C under the controller: of the true map, by volume.

        Parameters
        ----------
        target
            Share of the volume of C that is to be proved to arrive.
        time_limit
            Seconds after which what is proved so far is the answer.
        bracket
            Whether to bound what any control law costs, too.
        progress
            Called with (stage, fraction done); True shows it on stderr.

        Raises
        ------
        BadInput
            The system is no formula, or there is no controller.
        """
        from lmdsl.results.directory.proved import prove

        return prove(self, target, time_limit, told(progress), bracket)

    @own_arithmetic
    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as a directory that appears whole or not at all."""
        from lmdsl.results.directory.archive import save

        save(self, inputs.path(path))

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Result:
        """Read a result directory. Nothing is re-verified; see :func:`lmdsl.verify`."""
        from lmdsl.results.directory.archive import load

        return load(inputs.path(path))

    def __repr__(self) -> str:
        parts = [f"status={self.status!r}", f"backend={self.backend!r}", f"gamma={self.gamma!r}"]
        if self.cost is not None:
            parts.append(f"cost={self.cost:.9g}")
        if self.gap is not None:
            parts.append(f"gap={self.gap:.2g}")
        parts.append(str(self.coverage or f"{self.cells} cells"))
        return f"Result({', '.join(parts)})"


def missed_rewards(problem: Problem) -> float | None:
    """Return what rewards lack of the costs that stand for them; None where costs are minimised."""
    system = problem.system
    if not isinstance(system, MatrixSystem) or system.best_reward is None:
        return None
    return system.missed(problem.gamma, problem.discount)

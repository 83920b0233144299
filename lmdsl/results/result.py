"""What a solve returns: status, certificate, controller, and the arrays over all cells."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.certificate import sums
from lmdsl.certificate.claims import Certificate
from lmdsl.common import inputs
from lmdsl.common.frozen import Frozen, freeze
from lmdsl.common.json_values import jsonable
from lmdsl.common.types import Floats
from lmdsl.control.controller import ClosedLoop, Controller, Simulation, simulate
from lmdsl.control.invariance import LocalCheck
from lmdsl.errors import BadInput, shown
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model.grid.boxes import Area
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local_controller import LocalController
from lmdsl.model.sets import Regions
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.systems.base import NotStored

if TYPE_CHECKING:
    import os

    from lmdsl.model.lp import StabilizationLP

EXIT = {"verified": 0, "unverified": 1, "bad_input": 2, "not_stabilizable": 3, "solver_failed": 4}
ARRAYS = ("control_index", "value", "lower", "measure", "cell_status")


@dataclass(frozen=True)
class Seconds:
    """Wall-clock seconds of the three stages."""

    compile: float | None = None
    solve: float | None = None
    verify: float | None = None


@dataclass(frozen=True)
class Coverage:
    """How much of the box the controller serves; cells are equal shares of its volume.

    Attributes
    ----------
    stabilizable, free
        Number of cells of C, and of cells outside A and Z.
    share
        The one of the other; None where no cell is free.
    """

    stabilizable: int
    free: int
    share: float | None

    @classmethod
    def of(cls, cell_status: NDArray[np.uint8]) -> Coverage:
        """Count the cells."""
        free = int((~np.isin(cell_status, (CellStatus.ATTRACTOR, CellStatus.AVOID))).sum())
        stabilizable = int((cell_status == CellStatus.STABILIZED).sum())
        return cls(stabilizable, free, stabilizable / free if free else None)

    def __str__(self) -> str:
        text = f"{self.stabilizable} of {self.free} free cells stabilizable"
        if self.share is None:
            return text
        percent = 100 * self.share if self.share == 1 else min(100 * self.share, 99.99)
        return f"{text} ({percent:.4g} %)"


@dataclass(frozen=True, kw_only=True, eq=False)
class Report(Frozen):
    """The scalar part of a result: the keys of ``lmdsl solve --json``, in order.

    Attributes
    ----------
    status
        ``verified``, ``unverified``, ``not_stabilizable``, ``solver_failed``, ``bad_input``.
    backend, solver_status
        Who solved it, and the solver's own word.
    gamma
        Geometric weight of the cost.
    cost, lower_bound, gap, tolerance
        m'V_up, m'W, their relative difference, and the largest gap that counts as verified.
    contraction
        Proved bound on the spectral radius of max(gamma, 1) P_u.
    gamma_bar
        None or (low, high): proved bracket of the largest feasible gamma.
    cells, controls, pairs
        N, M and the number of surviving pairs.
    attractor_cells, stabilizable_cells
        Number of cells of A and C.
    polish_steps
        Improvement steps made on the backend's policy.
    seconds
        Wall-clock time per stage.
    message
        One sentence for people.
    local_controller
        Whether the problem's local controller keeps the attractor cells; None without one.
    simulation
        Runs of the true map that ``lmdsl solve`` made; None where none was asked for.
    """

    status: str
    backend: str | None = None
    solver_status: str | None = None
    gamma: float | None = None
    cost: float | None = None
    lower_bound: float | None = None
    gap: float | None = None
    tolerance: float | None = None
    contraction: float | None = None
    gamma_bar: tuple[float, float] | None = None
    cells: int | None = None
    controls: int | None = None
    pairs: int | None = None
    attractor_cells: int | None = None
    stabilizable_cells: int | None = None
    polish_steps: int | None = None
    seconds: Seconds = field(default_factory=Seconds)
    message: str = ""
    local_controller: LocalCheck | None = None
    simulation: Simulation | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data: infinity is ``"inf"``, unknown is None, never NaN."""
        covered, runs = self.coverage, self.simulation
        return {
            **self.stored(),
            "coverage": covered and asdict(covered),
            "simulation": runs and jsonable(runs.to_dict()),
        }

    def stored(self) -> dict[str, Any]:
        """Return the part of the data that certificate.json keeps."""
        names = [f.name for f in fields(Report) if f.name != "simulation"]
        cells = self.beyond_gamma
        return {
            **{name: jsonable(getattr(self, name)) for name in names},
            "beyond_gamma": cells and cells.to_dict(),
        }

    @property
    def coverage(self) -> Coverage | None:
        """How much of what is neither attractor nor avoided is stabilizable; None if unknown."""
        return None

    @property
    def beyond_gamma(self) -> Area | None:
        """The cells proved infeasible at this gamma, by region; None where none is."""
        return None

    @property
    def exit_status(self) -> int:
        """Exit status of the command line."""
        return EXIT[self.status]


@dataclass(frozen=True)
class CostFrom:
    """The conditional cost of a starting region.

    Attributes
    ----------
    upper, lower
        The policy's cost is at most ``upper``; no policy costs less than ``lower``.
    mass
        Share m(B) of the weight that starts there.
    """

    upper: float
    lower: float
    mass: float


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Result(Report):
    """The answer to a problem; see :class:`Report` for the scalars.

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
        Shape (N,), uint8: 0 attractor, 1 stabilized, 2 escapes, 3 trapped, 4 leads to these, 5
        avoid.
    witness
        Shape (N,): w of claim 1, or of the refusal when not stabilizable; 0 elsewhere.
    control_vectors
        Shape (M, p).
    iterations
        Iterations in the backend's own sense.
    log
        What the backend printed, its last 64 KiB; it is printed nowhere and not saved.
    gap_before_polish
        Gap of the backend's own policy, None where nothing could be certified of it.
    lp
        The compiled model; None for a result read from a directory.
    model_sha256
        Digest of the compiled model, as read from a directory.
    cause
        Why it is not stabilizable: ``empty``, ``measure``, ``gamma`` or ``require_all``.
    """

    problem: Problem
    partition: Partition
    certificate: Certificate
    control_index: NDArray[np.int32]
    value: Floats
    lower: Floats
    measure: Floats
    cell_status: NDArray[np.uint8]
    witness: Floats
    control_vectors: Floats
    iterations: int | None = None
    log: str = ""
    gap_before_polish: float | None = None
    cause: str | None = None
    lp: StabilizationLP | None = None
    model_sha256: str = ""

    @property
    def verified(self) -> bool:
        """True when the certificate is complete and the gap within the tolerance."""
        return self.certificate.verified

    @property
    def coverage(self) -> Coverage | None:
        """How much of what is neither attractor nor avoided is stabilizable; None if unknown."""
        return None if self.attractor_cells is None else Coverage.of(self.cell_status)

    @cached_property
    def controller(self) -> Controller:
        """The feedback law, ``u = result.controller(x)``: the paper's C1, and C0 in A if any."""
        attractor = self.cell_status == CellStatus.ATTRACTOR
        try:
            local = LocalController.of(self.problem, self.partition, attractor)
        except NotStored:  # its linearisation needs the function; C1 does not
            local = None
        return Controller(self.partition, self.control_vectors, self.control_index, local)

    @cached_property
    def closed_loop(self) -> ClosedLoop:
        """The true map under the controller."""
        return ClosedLoop(self.problem, self.controller, self.cell_status)

    @cached_property
    def beyond_gamma(self) -> Area | None:
        """The cells proved infeasible at this gamma, by region; None where none is."""
        mask = self.cell_status == CellStatus.BEYOND_GAMMA
        if self.cause == "gamma":
            mask = mask | (self.witness > 0)
        return Area.of(self.partition, np.flatnonzero(mask)) if mask.any() else None

    @cached_property
    def weight(self) -> Floats:
        """The user's m over all cells, shape (N,), sum 1 (all zero where none lies in C)."""
        weight = np.zeros(self.partition.size)
        on = np.flatnonzero(self.cell_status == CellStatus.STABILIZED)
        weight[on] = Regions.of(self.problem, self.partition).weight(on)
        freeze(weight)
        return weight

    @own_arithmetic
    def cost_from(self, *boxes: Mapping[str, tuple[float, float]]) -> CostFrom:
        """Return the conditional cost of starting in a region: sum over B of m V / m(B).

        Parameters
        ----------
        boxes
            Axis name to ``(a, b)``; the region is the cells of C inside their union.

        Returns
        -------
        CostFrom
            Proved bounds, and the share m(B) of the weight.

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
    def simulate(
        self,
        starts: int = 10_000,
        steps: int = 10_000,
        seed: int = 0,
        hold: int = 1_000,
        time_limit: float | None = None,
    ) -> Simulation:
        """Run the true map under the controller from fresh random starts drawn by m.

        Parameters
        ----------
        starts, steps, seed
            Number of runs, step limit of each, seed of starts and noise.
        hold
            With a local controller, steps to run on after the first entry into A.
        time_limit
            Seconds; runs that have not ended by then count as cycling.

        Raises
        ------
        BadInput
            There is no controller, or a count or the limit is not positive.
        """
        starts, steps = inputs.whole(starts, "starts"), inputs.whole(steps, "steps")
        hold, seed = inputs.whole(hold, "hold"), inputs.seed(seed)
        if (self.control_index < 0).all():
            raise BadInput("there is no controller to simulate: " + self.message)
        cells = np.flatnonzero(self.cell_status == CellStatus.STABILIZED)
        weight = self.weight[cells]
        late = Deadline.of(time_limit)
        return simulate(self.closed_loop, cells, weight, starts, steps, seed, hold, late)

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

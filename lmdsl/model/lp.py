"""The stabilization LP: the finite model on C, and A, b, c made on demand.

Primal (the paper's equation for theta):  min G'theta  s.t.  (E - gamma P)'theta = m, theta >= 0.
Dual:  max m'V  s.t.  V[cell(k)] <= gamma (P V)[k] + G[k] for every surviving pair k.
So ``A = (E - gamma P)'`` is (n, K), ``b = m``, ``c = G``; columns go by cell, then control.
"""

import os
from dataclasses import InitVar, dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lmdsl.common import inputs
from lmdsl.common.on_disk import Disk
from lmdsl.common.records import Frozen, freeze
from lmdsl.common.types import FilePath, Floats, Indices, Progress, Statuses, told
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.machine.kernels import fixed
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model import algorithm_1, stabilizable_set
from lmdsl.model.assembly.estimates import require_least, unless_short
from lmdsl.model.assembly.substeps import settled
from lmdsl.model.assembly.transitions import assemble
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.directions import Directions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.local.controller import LocalController
from lmdsl.model.rows import RowArrays, Rows, digest_of
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.model.successors.left_out.dropping import left_out
from lmdsl.model.successors.survival import Successors
from lmdsl.problem import Problem, given
from lmdsl.problem.whole.changing import with_gamma_alone
from lmdsl.ranks.mesh import Mesh


@dataclass(frozen=True, eq=False)
class StabilizationLP(Frozen):
    """The finite model of a problem on its stabilizable set, and its linear program.

    Attributes
    ----------
    problem, partition
        What was compiled.
    controls
        Control vectors, shape (M, p).
    cell_status
        Shape (N,), codes of :class:`lmdsl.model.stabilizable_set.CellStatus`.
    cells
        The cells of C by their index in the state box, ascending, shape (n,).
    pair_pointer
        Shape (n + 1,): the columns of the i-th cell of C are ``pair_pointer[i]:pair_pointer[i+1]``.
    control, cost
        Control index of every column, int32, and its stage cost G, shape (K,) each.
    rows
        Compact transition rows P, one per column; target n is the attractor.
    gamma
        Geometric weight of the cost.
    weight
        The user's m on C, shape (n,), sum 1 (all zero where no cell of ``measure`` lies in C).
    sure_levels
        See :meth:`Successors.sure_levels`; None where successors are not enclosed.
    hold
        Control index of the attractor cells that hold, else -1, shape (N,); None if not asked for.
    dropped, mesh
        Pairs (cell, control) left out, in order, (D, 2); own cells and ghosts of a rank. Else None.
    """

    problem: Problem
    partition: Partition
    controls: Floats
    cell_status: Statuses
    cells: Indices
    pair_pointer: Indices
    control: NDArray[np.int32]
    rows: Rows
    cost: Floats
    gamma: float
    weight: Floats
    sure_levels: NDArray[np.int32] | None = None
    hold: holding.Controls | None = None
    dropped: NDArray[np.int64] | None = None
    mesh: Mesh | None = None
    _known: InitVar[algorithm_1.Levels | None] = None
    _levels: ClassVar[algorithm_1.Levels | None] = None

    def __post_init__(self, _known: algorithm_1.Levels | None) -> None:
        super().__post_init__()
        object.__setattr__(self, "_levels", _known)  # of these pairs: no copy takes it over

    @property
    def n(self) -> int:
        """Number of cells of C: rows of the LP."""
        return len(self.cells)

    @property
    def K(self) -> int:
        """Number of surviving pairs: columns of the LP."""
        return len(self.control)

    @cached_property
    def cell(self) -> NDArray[np.int32]:
        """The cell of every column as a position in ``cells``, shape (K,)."""
        return fixed(algorithm_1.owner(self.pair_pointer))

    @property
    def A(self) -> Any:
        """(E - gamma P)', shape (n, K), a SciPy CSC array made anew on each call."""
        from scipy.sparse import csr_array

        E = csr_array((np.ones(self.K), self.cell, np.arange(self.K + 1)), shape=(self.K, self.n))
        return (E - self.gamma * self.P).T.tocsc()

    @property
    def b(self) -> Floats:
        """The user's m, shape (n,)."""
        return self.weight

    @property
    def c(self) -> Floats:
        """The stage costs, shape (K,)."""
        return self.cost

    @property
    def P(self) -> Any:
        """Transition rows of every column, shape (K, n), a SciPy CSR array made anew."""
        return self.rows.matrix()

    @property
    def solve_weight(self) -> Floats:
        """What backends solve with: 1/n on C. V depends on no weight that is positive."""
        return np.full(self.n, 1.0 / max(self.n, 1))

    @property
    def growth(self) -> float:
        """The weight g = max(gamma, 1) under which a policy must be stabilizing."""
        return max(self.gamma, 1.0)

    def column(self, cell: int, control: int) -> int | None:
        """Return the column of (cell index in the box, control index), None if not surviving."""
        i = int(np.searchsorted(self.cells, cell))
        if i >= self.n or self.cells[i] != cell:
            return None
        first, last = self.pair_pointer[i], self.pair_pointer[i + 1]
        k = first + int(np.searchsorted(self.control[first:last], control))
        return int(k) if k < last and self.control[k] == control else None

    def part(self, columns: Indices, inside: Indices) -> "StabilizationLP":
        """Return the model on some cells and columns; every successor must lie inside or in A.

        ``columns`` and ``inside``, the positions of the cells, are ascending; each of these cells
        must keep a column.
        """
        columns = inputs.indices(columns, self.K, "columns", "columns")
        inside = inputs.indices(inside, self.n, "inside", "positions")
        renumber = np.full(self.n + 1, -1, dtype=np.int32)
        renumber[inside] = np.arange(len(inside), dtype=np.int32)
        renumber[self.n] = len(inside)
        taken = self.rows.take(columns)
        own, reached = renumber[self.cell[columns]], renumber[taken.target]
        if len(own) and min(own.min(), reached.min(initial=0)) < 0:
            raise BadInput("a column belongs or leads to a cell that is left out", "inside")
        return replace(
            self,
            cells=self.cells[inside],
            pair_pointer=np.append(0, np.cumsum(np.bincount(own, minlength=len(inside)))),
            control=self.control[columns],
            rows=replace(taken, target=reached, columns=len(inside)),
            cost=self.cost[columns],
            weight=self.weight[inside],
        )

    def under(self, policy: Indices) -> "StabilizationLP":
        """Return the model under a policy, a column per cell: its only policy is ``arange(n)``."""
        policy = algorithm_1.own_columns(policy, self.pair_pointer)
        return replace(
            self,
            pair_pointer=np.arange(self.n + 1, dtype=np.int64),
            control=self.control[policy],
            rows=self.rows.take(policy),
            cost=self.cost[policy],
        )

    def with_gamma(self, gamma: float) -> "StabilizationLP":
        """Return the same model with another gamma; BadInput where more depends on it."""
        problem = with_gamma_alone(self.problem, gamma)
        return replace(self, problem=problem, gamma=problem.gamma, _known=self._algorithm_1)

    @property
    def tree(self) -> tuple[NDArray[np.int32], Indices]:
        """Algorithm 1 on the surviving pairs: level and first stabilizing column of every cell."""
        level, policy = self._algorithm_1
        return fixed(level), fixed(policy)

    @cached_property
    def _algorithm_1(self) -> algorithm_1.Levels:
        """The same as our own code reads it: compiled loops tell read-only arrays from others."""
        return self._levels or algorithm_1.tree(self.pair_pointer, self.rows)

    @property
    def _kernel(self) -> tuple[NDArray[np.uint64], RowArrays]:
        """The pairs of every cell and their rows as compiled loops read them."""
        return self.pair_pointer.view(np.uint64), self.rows.kernel

    @cached_property
    def _directions(self) -> Directions:
        """Orders in which sweeps visit the cells."""
        return Directions(self.cells, self.partition.shape)

    @cached_property
    def _predecessors(self) -> algorithm_1.Predecessors:
        """Columns that can reach each cell."""
        return algorithm_1.Predecessors.of(self.rows)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the compiled model: statuses, pairs, exact transitions, costs, gamma, m."""
        before = (self.cell_status, "<u1"), (self.pair_pointer, "<i8"), (self.control, "<i4")
        after = (self.cost, "<f8"), (self.weight, "<f8"), (self.controls, "<f8")
        hold = () if self.hold is None else ((self.hold, "<i4"),)
        left = () if self.dropped is None else ((np.append(-1, self.dropped), "<i8"),)
        return digest_of(self.rows, self.gamma, before, (*after, *hold, *left))

    def expand(self, values: NDArray[Any], attractor: Any, outside: Any) -> NDArray[Any]:
        """Spread values on C over all N cells."""
        values = np.asarray(values)
        if values.shape != (self.n,):
            raise BadInput(f"values on C have shape ({self.n},), not {values.shape}", "values")
        full = np.full(self.partition.size, outside, dtype=values.dtype)
        full[self.cell_status == CellStatus.ATTRACTOR] = attractor
        full[self.cells] = values
        return full

    def write_mps(self, path: str | os.PathLike[str]) -> None:
        """Write the LP in free MPS format, every double with all its digits.

        Row ``d<cell>`` is the balance of a cell, column ``t<cell>_<control>`` its occupation.
        """
        from lmdsl.results.exports.mps import export_mps

        export_mps(self, inputs.path(path))

    def __repr__(self) -> str:
        sizes = f"{self.n} rows, {self.K} columns, {len(self.rows.target)} transitions"
        return f"StabilizationLP({sizes}, gamma={self.gamma!r})"

    _repr_html_ = stabilizable_set.html


@own_arithmetic
def compile(  # noqa: A001
    problem: Problem | FilePath, progress: Progress | bool | None = None,
    time_limit: float | Deadline | None = None, *, dropped: Any = None,
    rows_on_disk: FilePath | None = None,
) -> StabilizationLP:  # fmt: skip
    """Compile a problem: transitions, stabilizable set and the LP on it.

    Parameters
    ----------
    problem
        The declared problem, or the path of its file.
    progress
        Called with (stage, fraction done) during long work; True shows it on stderr.
    time_limit
        Seconds. What takes a moment is compiled whatever the limit.
    dropped
        Pairs (cell, control) to leave out, shape (D, 2).
    rows_on_disk
        A folder: the rows lie there, in files that vanish with the LP, instead of in memory.

    Raises
    ------
    TimeLimitReached
        The time limit was reached.
    BadInput
        A set has no cells, a cost is negative or not finite, or memory does not suffice.
    """
    progress, deadline = told(progress), Deadline.of(time_limit)
    problem = settled(given(problem), deadline)
    partition = Partition.of(problem)
    require_least(problem, disk := Disk.of(rows_on_disk))
    limit = unless_short(problem, deadline)
    declared = CellSets.of(problem, partition, limit)
    if problem.local_controller is not None:  # refuse a wrong one before the work
        LocalController.of(problem, partition, declared.attractor, limit)
    hold = holding.held(problem, partition, declared, limit)
    sets, empty = holding.within(declared, problem, hold), holding.leaves_nothing(problem, hold)
    make = holding.no_pairs if empty else assemble
    transitions = make(problem, partition, progress, deadline, sets, disk=disk)
    successors = Successors.asked_for(problem, partition, transitions, deadline, progress)
    controls = control_vectors(problem)
    pairs, left = left_out(dropped, transitions, len(controls))
    found = stabilizable_set.of_problem(problem, transitions, deadline, successors, left)
    own, cells = stabilizable_set.restrict(transitions, found), sets.free[found.inside]
    lp = StabilizationLP(
        problem=problem,
        partition=partition,
        controls=controls,
        cell_status=stabilizable_set.statuses(transitions, found, empty),
        cells=cells,
        pair_pointer=own.pair_pointer,
        control=own.control,
        rows=own.rows,
        cost=own.cost,
        gamma=problem.gamma,
        weight=sets.weight(cells),
        sure_levels=None if successors is None else successors.sure_levels(),
        hold=hold,
        dropped=pairs,
        _known=(found.level[found.inside], own.first),
    )
    freeze(*(x.base for x in (lp.controls, lp.control, lp.cost) if isinstance(x.base, np.ndarray)))
    return lp

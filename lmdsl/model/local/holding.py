"""The cells that hold: the greatest set of attractor cells that controls of the grid can keep.

A cell of A holds if some control keeps all its successors in cells that hold: samples, and, where
successors are enclosed, all that the image of the whole cell can meet; its way stays in the box and
outside avoid. Of these controls each cell takes the one of least mean stage cost, the first of
those that cost the same. A run of the map that is in enclosed cells that hold stays in them for
ever (docs/mathematics.md). The set is found before anything is compiled: A becomes it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, Floats, Indices, Progress, Statuses
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline, TimeLimitReached
from lmdsl.model.algorithm_1 import owner
from lmdsl.model.assembly.transitions import Transitions, assemble, shares_of
from lmdsl.model.discretization import control_vectors, noise_nodes, sample_points
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows
from lmdsl.model.sets import CellSets
from lmdsl.model.stabilizable_set import CellStatus, keeping
from lmdsl.model.successors.survival import Successors
from lmdsl.problem.local_control import HoldControl
from lmdsl.problem.problem import Problem
from lmdsl.systems import FunctionSystem, OdeSystem
from lmdsl.systems.named import NamedOde

Controls = NDArray[np.int32]  # by cell, shape (N,): index of its control; -1 where none holds


@dataclass(frozen=True, eq=False)
class HoldingLaw(Frozen):
    """The controls of the cells that hold, as a local controller.

    Attributes
    ----------
    partition, attractor
        The cells, and which of them hold, shape (N,).
    vectors
        Control vectors, shape (M, p).
    index
        See ``Controls``.
    multiplier
        None: there is no orbit.
    """

    partition: Partition
    attractor: Bools
    vectors: Floats
    index: Controls
    multiplier: None = None

    @classmethod
    def of(cls, problem: Problem, partition: Partition, index: Controls) -> Self:
        """Return the law of controls by cell, or the cells that have one."""
        return cls(partition, index >= 0, control_vectors(problem), index)

    def __call__(self, x: Floats, cell: Indices) -> Floats:
        """Return the control of cells that hold, shape (r, p)."""
        return self.vectors[self.index[cell]]

    def law(
        self, x: Sequence[Any], cell: Indices, apply: Callable[..., Any] | None = None
    ) -> list[Any]:
        """Return the controls of cells that hold, axis by axis: numbers for every state."""
        return list(self(np.zeros(0), cell).T)


def held(
    problem: Problem, partition: Partition, sets: CellSets, deadline: Deadline | None = None
) -> Controls | None:
    """Return the controls of the cells that hold; None where the problem does not ask for them.

    ``sets`` are those that the problem declares.

    Raises
    ------
    TimeLimitReached
        The deadline has passed.
    BadInput
        The stage cost of a pair is negative or not finite, or memory does not suffice.
    """
    if not isinstance(problem.local_controller, HoldControl):
        return None
    nothing = np.zeros(partition.size, dtype=np.bool_)
    inner = CellSets.made(nothing, ~sets.attractor, sets.mass)
    way = CellSets.made(nothing, sets.avoid, sets.mass)
    index = np.full(partition.size, -1, dtype=np.int32)
    cells, controls = kept(problem, partition, inner, way, Deadline.of(deadline))
    index[cells] = controls
    return index


def kept(
    problem: Problem, partition: Partition, inner: CellSets, way: CellSets, deadline: Deadline,
    part: bool = False,
) -> tuple[Indices, Controls]:  # fmt: skip
    """Return the cells that hold, ascending, and the control of each.

    Of ``inner`` the free cells are those that may hold, all others are avoided; ``way`` avoids what
    ways must not meet. ``part`` says that these are known of some cells only.
    """
    span = (0, len(inner.free)) if part else None
    transitions = assemble(problem, partition, None, deadline, inner, way, span)
    if not len(transitions.control):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int32)
    cells = inner.free[:]
    successors = Successors.asked_for(
        problem, partition, transitions, deadline, way=way, cells=cells, windowed=part
    )
    inside, alive = keeping(transitions.pair_pointer, transitions.rows, successors)
    return cells[inside], _cheapest(transitions, alive)


def within(sets: CellSets, problem: Problem, index: Controls | None) -> CellSets:
    """Return the sets that are compiled: of the attractor the cells that hold, unless partial."""
    local = problem.local_controller
    if index is None or not isinstance(local, HoldControl) or local.partial:
        return sets
    return CellSets.made(index >= 0, sets.avoid, sets.mass)


def assembled(
    problem: Problem,
    partition: Partition,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
) -> Transitions:
    """Return the transitions as they are compiled: of the attractor, the cells that hold."""
    sets = None
    if isinstance(problem.local_controller, HoldControl):
        declared = CellSets.of(problem, partition, deadline)
        sets = within(declared, problem, held(problem, partition, declared, deadline))
    return assemble(problem, partition, progress, deadline, sets)


def stored(problem: Problem, status: Statuses, index: Controls) -> Controls | None:
    """Return the controls of cells that hold of a solution, which could not be compiled anew."""
    if not isinstance(problem.local_controller, HoldControl):
        return None
    return np.where(status == CellStatus.ATTRACTOR, index, -1).astype(np.int32)


def none_holds(index: Controls | None) -> bool:
    """Return whether cells that hold were asked for, and there is none."""
    return index is not None and not (index >= 0).any()


def leaves_nothing(problem: Problem, index: Controls | None) -> bool:
    """Return whether no cell holds, and so there is nothing to compile: A is empty, and so is C."""
    local = problem.local_controller
    whole = isinstance(local, HoldControl) and not local.partial
    return whole and problem.discount is None and none_holds(index)


def no_pairs(
    problem: Problem, partition: Partition, progress: Progress | None, deadline: Deadline | None,
    sets: CellSets, disk: Any = None, cells: int | None = None,
) -> Transitions:  # fmt: skip
    """Return transitions of all free cells, or so many, without a pair: no room on a disk."""
    F, nothing = len(sets.free), np.zeros(0, dtype=np.int32)
    cells = F if cells is None else cells
    shares = shares_of(problem, sample_points(problem), noise_nodes(problem))
    rows = Rows(np.zeros(1, dtype=np.int64), nothing, nothing.astype(np.uint8), shares, F)
    return Transitions(sets, np.zeros(cells + 1, dtype=np.int64), nothing, rows, np.zeros(0))


def note(problem: Problem, partition: Partition, index: Controls | None) -> str:
    """Return how many declared attractor cells hold, what of the others; empty where not asked."""
    local = problem.local_controller
    if index is None or none_holds(index) or not isinstance(local, HoldControl):
        return ""
    held, every = int((index >= 0).sum()), int(CellSets.of(problem, partition).attractor.sum())
    how = "proved of whole cells" if problem.successors == "enclosed" else "by their samples"
    if isinstance(problem.system, FunctionSystem):
        how = how.replace("proved of whole cells", "assuming the Lipschitz constants")
    rest = "are a goal that may be left again" if local.partial else "became ordinary cells"
    others = f"; the others {rest}" * (held < every)
    return f"{held} of {every} declared attractor cells hold ({how}){others}"


def _cheapest(transitions: Transitions, alive: Bools) -> Controls:
    """Return the cheapest control of each cell that keeps some, the first of equals."""
    pairs = np.flatnonzero(alive)
    cell = owner(transitions.pair_pointer)[pairs]
    order = pairs[np.lexsort((pairs, transitions.cost[pairs], cell))]
    _, first = np.unique(owner(transitions.pair_pointer)[order], return_index=True)
    cheapest: Controls = transitions.control[order[first]]
    return cheapest


def unheld(problem: Problem, partition: Partition, deadline: Deadline | None = None) -> str | None:
    """Return why no attractor cell holds; None where some does, or none is asked to."""
    if not isinstance(problem.local_controller, HoldControl):
        return None
    index = held(problem, partition, CellSets.of(problem, partition, deadline), deadline)
    return why_none(problem, partition, deadline) if none_holds(index) else None


def why_none(problem: Problem, partition: Partition, deadline: Deadline | None = None) -> str:
    """Return why no attractor cell holds, and what to do, as far as a look at the middles tells."""
    said = "no attractor cell holds: under every control some successors leave the set; "
    middles = problem.replaced(sampling={"kind": "grid", "per_axis": 1}, successors="sampled")
    try:
        found = held(middles, partition, CellSets.of(problem, partition, deadline), deadline)
    except (BadInput, TimeLimitReached):  # a cost that is refused there, or no time to look
        return said + "use more cells, a larger attractor, or a shorter step"
    kept = 0 if found is None else int((found >= 0).sum())
    if kept:
        return said + (
            f"the cells are too coarse (the middles of {kept} of them can be kept, whole cells "
            "cannot): use more cells, or a larger attractor"
        )
    remedy = "no control of the grid holds the middle of a cell: "
    if isinstance(problem.system, OdeSystem | NamedOde):
        return said + remedy + "shorten the step, enlarge the attractor, or refine control_grid"
    return said + remedy + "enlarge the attractor, or refine control_grid"

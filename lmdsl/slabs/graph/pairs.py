"""The admissible pairs of own cells, as every rank assembles them.

What must hold: the rows of all ranks, one after the other, are those of one process, to the bit,
whatever their number; targets in local numbers stand for the same cells, in the same order.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.on_disk import Disk
from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.estimates import unless_short
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.assembly.transitions import Transitions, assemble
from lmdsl.model.discretization import control_count
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.local.controller import LocalController
from lmdsl.model.rows import Rows
from lmdsl.model.sets import CellSets, always_whole
from lmdsl.model.successors.left_out.dropping import listed, others
from lmdsl.model.successors.survival import Successors
from lmdsl.problem import Problem
from lmdsl.ranks.mesh import Mesh
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import Ranks
from lmdsl.ranks.watching import Watched
from lmdsl.slabs.graph.holding import HeldCells
from lmdsl.slabs.graph.meeting import OwnSuccessors
from lmdsl.slabs.graph.pieces import PieceSets
from lmdsl.systems import MatrixSystem

LOOKED_AT = 64  # cells of which the admissible pairs are counted, to share pairs equally


@dataclass(frozen=True, eq=False)
class OwnPairs:
    """The pairs of a rank's own free cells, ordered by cell, then control.

    Attributes
    ----------
    sets
        The cells of the box by what they are.
    mesh
        Own free cells and ghosts, numbered among the free cells of the box.
    pair_pointer
        Shape (own + 1,): pairs by own cell.
    control, cost
        Control index and stage cost of each pair.
    rows
        One row per pair, in local numbers.
    empty
        Whether no attractor cell holds, so that there is no pair and A is empty.
    hold
        The cells of the attractor that hold; None if not asked for.
    successors
        What own pairs can meet; None where successors are not enclosed.
    dropped, left
        Pairs (cell, control) of all cells that are left out, (D, 2), and which own pairs are not
        among them; None where all are.
    """

    sets: CellSets
    mesh: Mesh
    pair_pointer: Indices
    control: NDArray[np.int32]
    cost: Floats
    rows: Rows
    empty: bool
    hold: HeldCells | None
    successors: OwnSuccessors | None
    dropped: NDArray[np.int64] | None
    left: Bools | None


def assembled(
    ranks: Ranks, problem: Problem, partition: Partition, deadline: Deadline | None = None,
    disk: Disk | None = None, dropped: Any = None,
) -> OwnPairs:  # fmt: skip
    """Return the own pairs of this rank; collective. Raises what :func:`assemble` does."""
    from lmdsl import __version__

    deadline = Watched(ranks, Deadline.of(deadline))
    ranks.alike((__version__, np.__version__), "versions of lmdsl and NumPy")
    ranks.alike(problem.model_dump_json(), "problems")
    sets, hold, empty = _sets(ranks, problem, partition, deadline)
    division = divided(ranks, problem, partition, sets, deadline)
    span = division.own(ranks.rank)
    cells = sets.free[slice(*span)]
    own = ranks.agreed(
        lambda: (
            holding.no_pairs(problem, partition, None, deadline, sets, cells=span[1] - span[0])
            if empty
            else assemble(problem, partition, deadline=deadline, sets=sets, span=span, disk=disk)
        )
    )
    met = ranks.agreed(
        lambda: Successors.asked_for(problem, partition, own, deadline, None, None, cells, True)
    )
    pairs = ranks.agreed(lambda: listed(dropped, len(sets.number), control_count(problem)))
    left = ranks.agreed(lambda: _left(pairs, own, span, ranks.rank == 0))
    mesh = Mesh.of(ranks, division, own.rows.target)
    given = isinstance(problem.system, MatrixSystem)
    rows = replace(own.rows, target=_localised(mesh, own.rows, given), columns=mesh.columns)
    successors = None if met is None else OwnSuccessors.of(ranks, division, sets, met)
    return OwnPairs(sets, mesh, own.pair_pointer, own.control, own.cost, rows, empty, hold,
                    successors, pairs, left)  # fmt: skip


def _sets(
    ranks: Ranks, problem: Problem, partition: Partition, deadline: Deadline
) -> tuple[CellSets, HeldCells | None, bool]:
    """Return the sets that are compiled, the cells that hold, and if none does.

    Collective. Where every rank has the whole model anyway, each makes all sets.
    """
    limit = unless_short(problem, deadline)
    local = problem.local_controller
    if ranks.count == 1 or always_whole(problem):
        sets = ranks.agreed(lambda: CellSets.of(problem, partition, limit))
    else:
        sets = PieceSets.over(ranks, problem, partition, limit)
    # Refuse a wrong one before the work.
    if local is not None:
        ranks.agreed(lambda: LocalController.of(problem, partition, sets.attractor, limit))
    hold = HeldCells.of(ranks, problem, partition, sets, limit)
    if hold is None:
        return sets, None, False
    empty = holding.leaves_nothing(problem, hold.control)
    return hold.within(ranks, problem, partition, sets), hold, empty


def _left(
    pairs: Indices | None, own: Transitions, span: tuple[int, int], first: bool
) -> Bools | None:
    """Return which own pairs are not among those of all cells that are left out; None: all are.

    Of cells that are not free the first rank says that they have no pair.
    """
    if pairs is None:
        return None
    sets = own.sets
    sets.meet(pairs[:, 0])
    number = sets.number[pairs[:, 0]]
    strange = (number < 0) | (number >= len(sets.free))
    mine = (number >= span[0]) & (number < span[1]) & ~strange
    controls = int(max(pairs[:, 1].max(), own.control.max(initial=0))) + 1
    return others(pairs[mine | (strange & first)], own, controls, sets.free[slice(*span)])


def _localised(mesh: Mesh, rows: Rows, given: bool) -> NDArray[np.int32]:
    """Return targets in local numbers, in the memory of the others unless these are ``given``."""
    if given:  # by the problem, which others read
        return mesh.local(rows.target)
    target = rows.target
    target.setflags(write=True)
    found = mesh.local(target, target)
    found.setflags(write=False)
    return found


def divided(
    ranks: Ranks, problem: Problem, partition: Partition, sets: CellSets, deadline: Deadline
) -> Division:
    """Divide the free cells into ranges of about as many admissible pairs each; collective.

    These are counted in a few cells that depend on the problem alone, and taken to be the same in
    the cells around each of them. Each rank counts in some that lie side by side.
    """
    F, count = len(sets.free), ranks.count
    if isinstance(problem.system, MatrixSystem) or not F:
        return Division.cut(np.ones(1, dtype=np.int64), count, np.array([F]))
    some = np.unique(np.linspace(0, F - 1, min(F, LOOKED_AT)).astype(np.int64))
    own = some[len(some) * ranks.rank // count : len(some) * (ranks.rank + 1) // count]
    every = ranks.told(lambda: _counted(problem, partition, sets, own, deadline))
    found = np.concatenate(every)
    ends = np.concatenate([(some[1:] + some[:-1]) // 2 + 1, [F]])  # of the cells around each
    return Division.cut(found, count, np.diff(ends, prepend=0))


def _counted(
    problem: Problem, partition: Partition, sets: CellSets, some: Indices, deadline: Deadline
) -> Indices:
    """Return how many pairs of some free cells are admissible, of all controls or of some."""
    sampler = Sampler(problem, partition, deadline, sets=sets)
    M = len(sampler.controls)
    width = max(1, min(M, sampler.chunk // sampler.samples))
    found = np.zeros(len(some), dtype=np.int64)
    for at, cell in enumerate(sets.free[some]):
        for a in range(0, M, max(width, M // 4)):  # all controls, or some of each quarter
            block = Block(0, np.array([cell]), (a, min(a + width, M)))
            index = sampler.images(block, sampler.values(block))
            sets.meet(index)
            target = sets.number[np.where(np.isnan(index), 0.0, index).astype(np.int64)]
            target[np.isnan(index)] = -1
            found[at] += int((target >= 0).all(axis=1).sum())
    return found

"""The admissible pairs of own cells, as every rank assembles them.

What must hold: the rows of all ranks, one after the other, are those of one process, to the bit,
whatever their number; targets in local numbers stand for the same cells, in the same order.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.on_disk import Disk
from lmdsl.common.types import Floats, Indices
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.sampler import Block, Sampler
from lmdsl.model.assembly.transitions import assemble
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local.controller import LocalController
from lmdsl.model.rows import Rows
from lmdsl.model.sets import CellSets
from lmdsl.problem import Problem
from lmdsl.ranks.mesh import Mesh
from lmdsl.ranks.ranges import Division
from lmdsl.ranks.verbs import Ranks
from lmdsl.ranks.watching import Watched
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
    """

    sets: CellSets
    mesh: Mesh
    pair_pointer: Indices
    control: NDArray[np.int32]
    cost: Floats
    rows: Rows


def require_supported(problem: Problem) -> None:
    """Refuse what does not run over ranks."""
    local = problem.local_controller
    faults = (
        (problem.successors == "enclosed", "successors", '"enclosed" successors'),
        (local is not None and local.kind == "hold", "local_controller", 'the kind "hold"'),
    )
    for asked, where, what in faults:
        if asked:
            raise BadInput(f"{what} does not run over several ranks; start one process", where)


def assembled(
    ranks: Ranks,
    problem: Problem,
    partition: Partition,
    deadline: Deadline | None = None,
    disk: Disk | None = None,
) -> OwnPairs:
    """Return the own pairs of this rank; collective. Raises what :func:`assemble` does."""
    from lmdsl import __version__

    deadline = Watched(ranks, Deadline.of(deadline))
    ranks.agreed(lambda: require_supported(problem))
    ranks.alike((__version__, np.__version__), "versions of lmdsl and NumPy")
    ranks.alike(problem.model_dump_json(), "problems")
    sets = ranks.agreed(lambda: CellSets.of(problem, partition, deadline))
    if problem.local_controller is not None:  # refuse a wrong one before the work
        ranks.agreed(lambda: LocalController.of(problem, partition, sets.attractor, deadline))
    division = ranks.agreed(lambda: divided(problem, partition, sets, ranks.count, deadline))
    span = division.own(ranks.rank)
    own = ranks.agreed(
        lambda: assemble(problem, partition, deadline=deadline, sets=sets, span=span, disk=disk)
    )
    mesh = Mesh.of(ranks, division, own.rows.target)
    given = isinstance(problem.system, MatrixSystem)
    rows = replace(own.rows, target=_localised(mesh, own.rows, given), columns=mesh.columns)
    return OwnPairs(sets, mesh, own.pair_pointer, own.control, own.cost, rows)


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
    problem: Problem, partition: Partition, sets: CellSets, count: int, deadline: Deadline
) -> Division:
    """Divide the free cells into ranges of about as many admissible pairs each.

    These are counted in a few cells that depend on the problem alone, and taken to be the same in
    the cells around each of them.
    """
    F = len(sets.free)
    if isinstance(problem.system, MatrixSystem) or not F:
        return Division.cut(np.ones(F, dtype=np.int64), count)
    some = np.unique(np.linspace(0, F - 1, min(F, LOOKED_AT)).astype(np.int64))
    sampler = Sampler(problem, partition, deadline, sets=sets)
    M = len(sampler.controls)
    width = max(1, min(M, sampler.chunk // sampler.samples))
    found = np.zeros(len(some), dtype=np.int64)
    for at, cell in enumerate(sets.free[some]):
        for a in range(0, M, max(width, M // 4)):  # all controls, or some of each quarter
            block = Block(0, np.array([cell]), (a, min(a + width, M)))
            index = sampler.images(block, sampler.values(block))
            target = sets.number[np.where(np.isnan(index), 0.0, index).astype(np.int64)]
            target[np.isnan(index)] = -1
            found[at] += int((target >= 0).all(axis=1).sum())
    near = np.searchsorted((some[1:] + some[:-1]) // 2, np.arange(F))
    return Division.cut(found[near], count)

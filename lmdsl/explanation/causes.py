"""Infeasibility explained: by cause and region, cell by cell, in mass, and what would help."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lmdsl.common import inputs
from lmdsl.common.records import Frozen
from lmdsl.common.types import Bools, FilePath, Progress, Statuses, told
from lmdsl.errors import BadInput, shown
from lmdsl.explanation import finite, one_cell, whole_cell
from lmdsl.explanation.changes import every_hint
from lmdsl.explanation.hints import Hint
from lmdsl.explanation.lost_mass import PhaseOne
from lmdsl.explanation.meanings import LostCells, meanings, unheld
from lmdsl.explanation.one_cell import NAMES, Why
from lmdsl.explanation.whole_cell import WholeCells
from lmdsl.machine.deadline import Deadline
from lmdsl.machine.forking import cached_property
from lmdsl.machine.surroundings import own_arithmetic
from lmdsl.model import stabilizable_set
from lmdsl.model.assembly.sampler import Sampler
from lmdsl.model.assembly.substeps import settled
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.discretization import control_count
from lmdsl.model.grid import boxes
from lmdsl.model.grid.boxes import Area
from lmdsl.model.grid.partition import Partition
from lmdsl.model.local import holding
from lmdsl.model.lp import StabilizationLP
from lmdsl.model.stabilizable_set import LOST, CellStatus
from lmdsl.problem import Problem, given
from lmdsl.systems import MatrixSystem


@dataclass(frozen=True, repr=False, eq=False)
class Explanation(Frozen):
    """Why cells lie outside the stabilizable set C.

    Attributes
    ----------
    problem, partition
        What was explained, and the geometry of its cells.
    cell_status
        Codes of :class:`lmdsl.model.stabilizable_set.CellStatus`, shape (N,).
    causes
        One entry for each cause that occurs.
    hints
        What trials with the true map show would help.
    phase_one
        The phase-one LP, None where it was not asked for.
    assembled
        The transitions of all admissible pairs, if they are at hand.
    """

    problem: Problem
    partition: Partition
    cell_status: Statuses
    causes: tuple[LostCells, ...]
    hints: tuple[Hint, ...]
    phase_one: PhaseOne | None = None
    assembled: Transitions | None = field(default=None, compare=False)

    @property
    def lost(self) -> int:
        """Number of cells outside C, A and avoid."""
        return sum(cause.cells for cause in self.causes)

    @cached_property
    def unheld(self) -> str | None:
        """Why no attractor cell holds, where the problem asks that some do; None else."""
        return unheld(self.problem, self.partition, self.cell_status)

    @cached_property
    def transitions(self) -> Transitions:
        """The transitions of all admissible pairs."""
        return self.assembled or holding.assembled(self.problem, self.partition)

    @cached_property
    def sampler(self) -> Sampler:
        """The map at the samples of cells."""
        return Sampler(self.problem, self.partition)

    @cached_property
    def whole_cells(self) -> WholeCells | None:
        """The enclosures of whole cells; None where pairs survive by their samples."""
        if self.problem.successors != "enclosed":
            return None
        return WholeCells(self.problem, self.partition, self.cell_status)

    @cached_property
    def _admissible(self) -> Bools | None:
        """Which of the pairs enclosures leave, shape (pairs,); None: all."""
        return whole_cell.admissible(self.problem, self.partition, self.transitions)

    def why(self, cell: int | Mapping[str, float]) -> Why:
        """Return the cause of a cell and its blocking facts.

        Parameters
        ----------
        cell
            The index of a cell in the box, or a state by name.

        Raises
        ------
        BadInput
            There is no such cell.
        """
        i = self._cell(cell)
        status = CellStatus(self.cell_status[i])
        p = self.partition
        index = tuple(int(k) for k in np.unravel_index(i, p.shape))
        known: dict[str, Any] = {
            "cell": i, "index": index, "box": boxes.of_cell(p, i), "cause": NAMES[status],
            "controls": control_count(self.problem),
        }  # fmt: skip
        if status in (CellStatus.ESCAPES, CellStatus.LEADS_TO_THESE):
            if isinstance(self.problem.system, MatrixSystem):
                moves = finite.moves(self.problem, self.partition, self.cell_status, i)
            else:
                moves = one_cell.moves(self.sampler, self.cell_status, i, self.whole_cells)
            return Why(moves=moves, **known)
        if status != CellStatus.TRAPPED:
            return Why(**known)
        free = self.transitions.sets.free
        start = int(np.searchsorted(free, i))
        pair_pointer, rows = self.transitions.pair_pointer, self.transitions.rows
        reached = free[one_cell.reachable(pair_pointer, rows, start, self._admissible)]
        mask = np.zeros(p.size, dtype=np.bool_)
        mask[reached] = True
        return Why(
            trap=boxes.regions(p, mask, one_cell.MOST_BOXES),
            trap_cells=len(reached),
            trap_lost=int((self.cell_status[reached] == CellStatus.ESCAPES).sum()),
            **known,
        )

    def _cell(self, cell: int | Mapping[str, float]) -> int:
        p = self.partition
        if isinstance(cell, Mapping):
            if set(cell) != set(p.names):
                raise BadInput(f"a state names every axis once: {', '.join(p.names)}", "cell")
            (i,) = p.locate([np.array([float(cell[name])]) for name in p.names], clip=False)
            if i < 0:
                raise BadInput(f"{shown(dict(cell))} lies outside the state box", "cell")
            return int(i)
        if (
            isinstance(cell, bool)
            or not isinstance(cell, int | np.integer)
            or not (0 <= cell < p.size)
        ):
            raise BadInput(f"{shown(cell)} is not a cell; cells are 0..{p.size - 1}", "cell")
        return int(cell)

    def to_dict(self) -> dict[str, Any]:
        """Return strict JSON data; each region has the first blocking fact of its middle cell."""
        causes = {}
        for cause in self.causes:
            listed = [
                {**region.to_dict(), "cell": region.cell, "why": self.why(region.cell).first}
                for region in cause.regions
            ]
            causes[cause.name] = {
                "cells": cause.cells, "regions": listed, "elsewhere": cause.elsewhere
            }  # fmt: skip
        return {
            "cells": self.partition.size,
            "stabilizable_cells": int((self.cell_status == CellStatus.STABILIZED).sum()),
            "lost_cells": self.lost,
            "unheld": self.unheld,
            "causes": causes,
            "hints": [hint.to_dict() for hint in self.hints],
            "phase_one": self.phase_one and self.phase_one.to_dict(),
        }

    def text(self) -> str:
        """Return the explanation for people."""
        free = self.lost + int((self.cell_status == CellStatus.STABILIZED).sum())
        lines = [f"{self.lost} of {free} free cells cannot be stabilized"]
        lines += ["", self.unheld] if self.unheld else []
        meaning = meanings(self.problem)
        finite_model = isinstance(self.problem.system, MatrixSystem)
        for cause in self.causes:
            lines += ["", f"{cause.name}, {cause.cells} cells: {meaning[cause.name]}"]
            for region in cause.regions:
                lines.append(f"  {region.cells} in {region}")
                lines.append(f"    {self.why(region.cell).first}")
            if cause.elsewhere:
                lines.append(f"  {cause.elsewhere} elsewhere")
        if self.lost and not finite_model:
            lines += ["", "what would help, as far as trials with the true map show:"]
            lines += [f"  {hint.text}" for hint in self.hints] or ["  nothing that was tried"]
        if self.phase_one:
            lines += ["", self.phase_one.text()]
        return "\n".join(lines)

    __str__ = text

    def __repr__(self) -> str:
        parts = [f"{cause.cells} {cause.name}" for cause in self.causes]
        return f"Explanation({', '.join(parts) or 'every cell is stabilizable'})"


@own_arithmetic
def explain(
    problem: Problem | StabilizationLP | FilePath,
    *,
    regions: int = 8,
    phase_one: bool = False,
    time_limit: float | Deadline | None = None,
    progress: Progress | bool | None = None,
) -> Explanation:
    """Explain which cells cannot be stabilized, why, and what would help.

    Parameters
    ----------
    problem
        A problem, the path of its file, or its LP; gamma plays a part in the phase-one LP only.
    regions
        Largest number of boxes for each cause.
    phase_one
        Solve the phase-one LP: how much mass of which cells cannot be stabilized.
    time_limit
        Seconds. Hints that were not tried by then are left out.
    progress
        Called with (stage, fraction done, or -1) during long work; True shows it on stderr.

    Raises
    ------
    BadInput
        The problem cannot be compiled, or ``regions`` is not positive.
    TimeLimitReached
        The problem was not compiled, or the phase-one LP not solved, in time.
    LmdslError
        The phase-one LP is not solved.
    """
    problem = given(problem, StabilizationLP)
    progress, deadline = told(progress), Deadline.of(time_limit)
    regions, phase_one = inputs.whole(regions, "regions"), inputs.flag(phase_one, "phase_one")
    assembled = None
    if phase_one:
        whole_cell.refuse(problem.problem if isinstance(problem, StabilizationLP) else problem)
    if isinstance(problem, StabilizationLP):
        partition, status = problem.partition, problem.cell_status.copy()
        status[status == CellStatus.BEYOND_GAMMA] = CellStatus.STABILIZED
        status.setflags(write=False)
        problem = problem.problem
    else:
        problem = settled(problem, deadline)
        partition = Partition.of(problem)
        assembled = holding.assembled(problem, partition, progress, deadline)
        status = _status(problem, partition, assembled, deadline)
    if phase_one and assembled is None:
        assembled = holding.assembled(problem, partition, progress, deadline)
    if progress:
        progress("explain", -1.0)
    found = []
    for code in LOST:
        area = Area.of(partition, np.flatnonzero(status == code), regions)
        if len(area):
            found.append(LostCells(NAMES[code], len(area), area.regions, area.elsewhere))
    solved = None
    if phase_one and assembled is not None:
        solved = PhaseOne.of(partition, assembled, status, problem.gamma, deadline)
    helpful = every_hint(problem, partition, status, deadline)
    return Explanation(problem, partition, status, tuple(found), helpful, solved, assembled)


def phase_one(problem: Problem, time_limit: float | Deadline | None = None) -> PhaseOne:
    """Solve the phase-one LP of a problem; see :mod:`lmdsl.explanation.lost_mass` for what it says.

    Parameters
    ----------
    problem
        A problem.
    time_limit
        Seconds.

    Raises
    ------
    TimeLimitReached
        The time limit was reached.
    LmdslError
        The LP is not solved.
    """
    deadline = Deadline.of(time_limit)
    whole_cell.refuse(problem)
    problem = settled(problem, deadline)
    partition = Partition.of(problem)
    assembled = holding.assembled(problem, partition, deadline=deadline)
    status = _status(problem, partition, assembled, deadline)
    return PhaseOne.of(partition, assembled, status, problem.gamma, deadline)


def _status(
    problem: Problem, partition: Partition, transitions: Transitions, deadline: Deadline
) -> Statuses:
    """Return the status of every cell, shape (N,)."""
    found = stabilizable_set.of_transitions(problem, partition, transitions, deadline)
    status = stabilizable_set.statuses(transitions, found)
    status.setflags(write=False)
    return status

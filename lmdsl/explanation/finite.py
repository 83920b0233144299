"""What the actions of a finite model do to a state that is not stabilizable."""

import numpy as np

from lmdsl.common.types import Statuses
from lmdsl.explanation.one_cell import MOST_CONTROLS, NAMES, Move
from lmdsl.model.discretization import control_vectors
from lmdsl.model.grid.partition import Partition
from lmdsl.model.stabilizable_set import CellStatus
from lmdsl.problem.problem import Problem
from lmdsl.systems import DataSystem, MatrixSystem
from lmdsl.systems.matrices.rows import GivenRows

KEPT = (CellStatus.ATTRACTOR, CellStatus.STABILIZED)


def moves(problem: Problem, partition: Partition, status: Statuses, cell: int) -> tuple[Move, ...]:
    """Return what the actions do in a cell that escapes or leads to lost cells."""
    assert isinstance(problem.system, MatrixSystem)
    rows, vectors = problem.system.rows, control_vectors(problem)
    picked = np.linspace(0, rows.controls - 1, min(rows.controls, MOST_CONTROLS)).round()
    recorded = isinstance(problem.system, DataSystem)
    missing, escapes = ("not recorded", "seen to leave") if recorded else ("missing", "escapes")
    found = []
    for a in np.unique(picked.astype(int)).tolist():
        control = dict(zip(problem.controls, vectors[a].tolist(), strict=True))
        state = _place(problem, partition, cell)
        k = _pair(rows, cell, a)
        if k is None:
            found.append(Move(control, missing, state, {}, {}, 1.0, given=True))
            continue
        entries = slice(rows.pointer[k], rows.pointer[k + 1])
        target, share = rows.target[entries], rows.values()[rows.code[entries]]
        code = np.where(target < 0, CellStatus.AVOID, status[target])
        leaving = code == CellStatus.AVOID
        bad = leaving if leaving.any() else ~np.isin(code, KEPT)
        e = int(np.argmax(bad))
        lost = float(share[bad].sum())
        if target[e] < 0:
            found.append(Move(control, escapes, state, {}, {}, lost, given=True))
            continue
        image = _place(problem, partition, int(target[e]))
        if leaving.any():
            found.append(Move(control, "avoid", state, {}, image, lost, given=True))
            continue
        cause = NAMES[CellStatus(code[e])]
        move = Move(control, "enters", state, {}, image, lost, (), int(target[e]), cause, True)
        found.append(move)
    return tuple(found)


def escaping(problem: Problem) -> str:
    """Return what it means that a cell escapes."""
    if isinstance(problem.system, DataSystem):
        return "every control recorded there was seen to leave or to enter avoid, or none was"
    return "every action may escape or enter avoid, or there is none"


def _place(problem: Problem, partition: Partition, cell: int) -> dict[str, float]:
    centre = partition.centres(np.array([cell]))[0]
    return dict(zip(problem.states, centre.tolist(), strict=True))


def _pair(rows: GivenRows, cell: int, control: int) -> int | None:
    first, last = np.searchsorted(rows.cell, [cell, cell + 1])
    k = int(first + np.searchsorted(rows.control[first:last], control))
    return k if k < last and rows.control[k] == control else None

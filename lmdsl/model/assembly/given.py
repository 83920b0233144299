"""The rows of a finite model, given and not sampled, as transitions on the free cells."""

from collections.abc import Callable, Mapping

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.errors import BadInput
from lmdsl.formulas.program import Program
from lmdsl.machine import memory
from lmdsl.model import discretization
from lmdsl.model.assembly.estimates import CODE, Pilot, estimate
from lmdsl.model.assembly.transitions import Transitions
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows, Shares, append_end, code_type
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem
from lmdsl.systems.matrices.rows import GivenRows


def of_matrices(problem: Problem, partition: Partition, sets: CellSets) -> Transitions:
    """Return the transitions of a finite model.

    A pair that may escape, or enter an avoid cell, is inadmissible.

    Raises
    ------
    BadInput
        It does not fit in memory, or the stage cost beside that of the matrices is no cost.
    """
    system = problem.system
    assert isinstance(system, MatrixSystem)
    memory.require(CODE * len(system.rows.numerator), "the shares of a finite model")
    given, number = system.rows, np.append(sets.number, np.int32(-1))
    target = number[given.target]  # an escape, -1, is the last entry
    free = sets.number[given.cell] < len(sets.free)
    admissible = free & (sets.number[given.cell] >= 0) & ~_any(target < 0, given)
    admitted = problem.admitted()
    if admitted is not None:
        admissible &= _at_pairs(problem, partition, given, admitted) != 0
    kept = np.flatnonzero(admissible)
    memory.require(estimate(problem, _pilot(given, kept, problem)), "the rows of a finite model")
    entry = np.flatnonzero(np.repeat(admissible, np.diff(given.pointer)))
    length = np.diff(given.pointer)[kept]
    order = np.lexsort((target[entry], np.repeat(np.arange(len(kept)), length)))
    shares, end = shares_of_matrices(problem, given), np.cumsum(length)
    codes = given.code[entry][order].astype(code_type(len(shares.numerator)))
    columns, F = target[entry][order], len(sets.free)
    if shares.ended is not None:
        end, columns, codes = append_end(end, columns, codes, F, shares.ended)
    cell = sets.number[given.cell[kept]]
    return Transitions(
        sets=sets,
        pair_pointer=np.searchsorted(cell, np.arange(F + 1)).astype(np.int64),
        control=given.control[kept],
        rows=Rows(np.concatenate([[0], end]).astype(np.int64), columns, codes, shares, F),
        cost=_cost(problem, partition, system, kept, target == F),
    )


def cut(every: Transitions, span: tuple[int, int] | None) -> Transitions:
    """Return the pairs of some free cells."""
    if span is None or span == (0, len(every.sets.free)):
        return every
    a, b = (int(every.pair_pointer[k]) for k in span)
    return Transitions(
        sets=every.sets,
        pair_pointer=every.pair_pointer[span[0] : span[1] + 1] - a,
        control=every.control[a:b],
        rows=every.rows.take(np.arange(a, b)),
        cost=every.cost[a:b],
    )


def shares_of_matrices(problem: Problem, given: GivenRows) -> Shares:
    """Return what the codes of a finite model stand for."""
    shares = Shares(given.numerator, None, given.values(), True, given.denominator)
    return shares if problem.discount is None else shares.discounted(problem.discount)


def _any(entries: Bools, given: GivenRows) -> Bools:
    """Return for which pairs an entry is true."""
    return np.bincount(given.owner(), entries, minlength=given.pairs) > 0


def _pilot(given: GivenRows, kept: Indices, problem: Problem) -> Pilot:
    pairs = max(given.cells * discretization.control_count(problem), 1)
    return Pilot(len(kept) / pairs, len(given.target) / max(given.pairs, 1))


def _cost(
    problem: Problem,
    partition: Partition,
    system: MatrixSystem,
    kept: Indices,
    absorbed: Bools,
) -> Floats:
    """Return the costs of the matrices, what is missed after A, and the stage cost beside."""
    given = system.rows
    cost: Floats = given.cost[kept]
    entered = np.flatnonzero(absorbed)
    paid = np.full(len(entered), system.missed(problem.gamma, problem.discount))
    terminal = problem.terminal()
    if terminal is not None:
        centres = partition.centres(given.target[entered].astype(np.int64))
        states = dict(zip(problem.states, centres.T, strict=True))
        (value,) = terminal(states)
        end = np.broadcast_to(value, paid.shape)
        used = np.where(np.isin(given.owner()[entered], kept), end, 0.0)
        _refuse_cost("terminal_cost", used, lambda e: _said(states, e))
        paid += end
    if paid.any():
        paid *= problem.gamma * (1.0 if problem.discount is None else problem.discount)
        paid *= given.values()[given.code[entered]]
        cost = cost + np.bincount(given.owner()[entered], paid, given.pairs)[kept]
    if not system.pays_all and str(problem.stage_cost).strip() != "0":
        cost = cost + _at_pairs(problem, partition, given, problem.program(problem.cost()))[kept]
    _refuse_cost("stage_cost", cost, lambda k: _said(_pairs(problem, partition, given), kept[k]))
    return cost


def _refuse_cost(key: str, cost: Floats, place: Callable[[int], str]) -> None:
    """Refuse costs that are negative or not finite, and say where."""
    wrong = np.flatnonzero(~(np.isfinite(cost) & (cost >= 0)))
    if len(wrong):
        k = int(wrong[0])
        raise BadInput(
            f"the {key.replace('_', ' ')} is {float(cost[k])!r} at {place(k)}; it must be finite "
            "and >= 0",
            key,
        )


def _said(values: Mapping[str, Floats], k: int) -> str:
    return ", ".join(f"{name} = {array[k] + 0.0:.6g}" for name, array in values.items())


def _at_pairs(problem: Problem, partition: Partition, given: GivenRows, of: Program) -> Floats:
    """Return what a program makes of state and control at every pair."""
    (found,) = of(_pairs(problem, partition, given))
    return np.asarray(np.broadcast_to(found, given.pairs), dtype=np.float64)


def _pairs(problem: Problem, partition: Partition, given: GivenRows) -> dict[str, Floats]:
    """Return the states and controls of every pair, by name."""
    centres = partition.centres(given.cell.astype(np.int64))
    controls = discretization.control_vectors(problem)[given.control]
    values = dict(zip(problem.states, centres.T, strict=True))
    return values | dict(zip(problem.controls, controls.T, strict=True))

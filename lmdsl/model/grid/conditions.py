"""The cells on which a condition in the states certainly holds, by enclosure and bisection.

A cell is judged like a box of a set: without 1e-9 widths at each side. Where interval arithmetic
does not decide a cell, the cell is bisected along the axes on which the condition depends, and only
the parts that are still undecided go on. A cell is lost as soon as the condition fails, as
computed, at the centre of a part or certainly on all of it. So what is found is right, and what is
not found may be a cell on which the condition holds and the work was used up: the safe side. The
cells are those of the axes on which the condition depends; along the others the answer is the same.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from lmdsl.common.types import Bools, Floats, Guard, Indices
from lmdsl.formulas.intervals import Interval
from lmdsl.formulas.language import Formula, negation
from lmdsl.formulas.program import Program
from lmdsl.machine import memory
from lmdsl.model.grid.axis import EDGE
from lmdsl.model.grid.partition import Partition

# Cells or parts at a time, but for twice the parts of a cell.
CHUNK: Final = 2**14

# Bytes of a cell while it is decided whether the condition holds on it.
CELL: Final = 24

# Bisections of an axis: so many for every cell, then up to so many while few parts are open.
LEAST: Final = 6
MOST: Final = 20

# Parts of a cell that are few; most cells are decided by then.
FEW: Final = 64

# Most parts of a cell that are open at a time.
PARTS: Final = 2**14

# Operations on parts that are shared out among the undecided cells, twice: a few seconds.
WORK: Final = 2**23


class OnAxes(NamedTuple):
    """Where a condition holds, by the cells of the axes on which it depends.

    Attributes
    ----------
    axes
        Which axes, ascending.
    held
        One entry for each of their cells, flat in C order.
    """

    axes: tuple[int, ...]
    held: Bools

    def everywhere(self, partition: Partition) -> Bools:
        """Return the cells of the box on which it holds, shape (N,)."""
        spread = [n if k in self.axes else 1 for k, n in enumerate(partition.shape)]
        return np.broadcast_to(self.held.reshape(spread), partition.shape).ravel()

    def on(self, index: Sequence[Indices], partition: Partition) -> Bools:
        """Return on which cells it holds, given by their index on every axis."""
        at = np.zeros(len(index[0]), dtype=np.int64)
        for k in self.axes:
            at = at * partition.shape[k] + index[k]
        return self.held[at]


def certain(
    condition: Formula, constants: Mapping[str, float], partition: Partition, guard: Guard
) -> Bools:
    """Return the cells on all of which a condition holds, shape (N,); see :func:`surely`."""
    return surely(condition, constants, partition, guard).everywhere(partition)


def possible(
    condition: Formula, constants: Mapping[str, float], partition: Partition, guard: Guard
) -> Bools:
    """Return the cells on which a condition may hold somewhere; see :func:`maybe`."""
    return maybe(condition, constants, partition, guard).everywhere(partition)


def maybe(
    condition: Formula, constants: Mapping[str, float], partition: Partition, guard: Guard
) -> OnAxes:
    """Return where a condition may hold somewhere in a cell; see :func:`surely`."""
    axes, fails = surely(negation(condition), constants, partition, guard)
    return OnAxes(axes, ~fails)


def surely(
    condition: Formula, constants: Mapping[str, float], partition: Partition, guard: Guard
) -> OnAxes:
    """Return where a condition holds on all of a cell.

    Parameters
    ----------
    condition
        In states and constants.
    constants
        Values of the parameters.
    partition
        The cells.
    guard
        Called now and then; it may raise.
    """
    program = Program([condition], constants)
    axes = [k for k, name in enumerate(partition.names) if name in program.names]
    test = _Test(program, [partition.names[k] for k in axes], guard)
    shape = [int(partition.cells[k]) for k in axes]
    memory.require(CELL * math.prod(shape) + partition.size, "the cells of a condition")
    held = np.zeros(math.prod(shape), dtype=np.bool_)
    open_ = []
    for start in range(0, len(held), CHUNK):
        some = np.arange(start, min(start + CHUNK, len(held)))
        verdict = test(*_ends(partition, axes, shape, some))
        held[some] = verdict.surely
        open_.append(some[verdict.open])
    undecided = np.concatenate(open_)
    for limit in (FEW, PARTS):  # first what is cheap, so that more work is left for the others
        most = min(limit, max(2, WORK // program.effort // max(len(undecided), 1)))
        left = []
        for start in range(0, len(undecided), CHUNK):
            some = undecided[start : start + CHUNK]
            yes, no = _bisected(test, *_ends(partition, axes, shape, some), most)
            held[some[yes]] = True
            left.append(some[~yes & ~no])
        undecided = np.concatenate([np.zeros(0, dtype=np.int64), *left])
    return OnAxes(tuple(axes), held)


class _Verdict(NamedTuple):
    surely: Bools
    open: Bools


class _Test:
    """Says of boxes, ends of shape (r, d), where the condition holds and where it is not known.

    What is neither fails somewhere.
    """

    def __init__(self, program: Program, names: Sequence[str], guard: Guard) -> None:
        self.program, self.names, self.guard = program, names, guard

    def __call__(self, low: Floats, high: Floats) -> _Verdict:
        ends = zip(self.names, low.T, high.T, strict=True)
        boxes = {name: Interval(a, b) for name, a, b in ends}
        surely, possibly = self.program.decide(boxes, self.guard)[0]
        centre = dict(zip(self.names, (low / 2 + high / 2).T, strict=True))
        here = self.program(centre, self.guard)[0] != 0
        surely, open_ = np.broadcast_arrays(surely, possibly & here, np.ones(len(low), bool))[:2]
        return _Verdict(surely, open_ & ~surely)


def _ends(
    partition: Partition, axes: Sequence[int], shape: Sequence[int], cells: Indices
) -> tuple[Floats, Floats]:
    """Return the ends of cells, by their number on some of the axes, shape (r, d) each."""
    index = np.stack(np.unravel_index(cells, shape or (1,)), axis=-1)[:, : len(axes)]
    low, width = partition.low[list(axes)], partition.width[list(axes)]
    return low + (index + EDGE) * width, low + (index + (1 - EDGE)) * width


def _bisected(test: _Test, low: Floats, high: Floats, most: int) -> tuple[Bools, Bools]:
    """Return on which undecided boxes the condition holds, and on which not.

    Parameters
    ----------
    test
        Judges boxes.
    low, high
        The ends, shape (r, d).
    most
        Parts of a box that may be open at a time; with more it stays undecided.
    """
    count, d = low.shape
    fails, given_up = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    todo = [(low, high, np.arange(count), 0)]
    while todo:
        low, high, owner, level = todo.pop()
        if d == 0 or level == MOST * d:
            given_up[owner] = True
            continue
        low, high = _halves(low, high, level % d)
        owner = np.concatenate([owner, owner])
        verdict = test(low, high)
        fails[owner[~verdict.surely & ~verdict.open]] = True
        low, high, owner = low[verdict.open], high[verdict.open], owner[verdict.open]
        parts = np.bincount(owner, minlength=count)
        given_up |= parts > (most if level < LEAST * d else min(most, FEW))
        going = ~fails[owner] & ~given_up[owner]
        owner, low, high = owner[going], low[going], high[going]
        half = owner < np.median(owner) if len(owner) > CHUNK else np.ones(len(owner), np.bool_)
        for piece in (half, ~half):
            if piece.any():
                todo.append((low[piece], high[piece], owner[piece], level + 1))
    return ~fails & ~given_up, fails


def _halves(low: Floats, high: Floats, axis: int) -> tuple[Floats, Floats]:
    """Return boxes cut in two along an axis, first all lower halves, then all upper ones."""
    lower, upper = high.copy(), low.copy()
    lower[:, axis] = upper[:, axis] = low[:, axis] / 2 + high[:, axis] / 2
    return np.concatenate([low, upper]), np.concatenate([lower, high])

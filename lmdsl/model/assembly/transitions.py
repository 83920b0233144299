"""Ulam's method: the samples of every cell and control become transition rows.

For a cell D_i outside A and Z and a control u^a, (P_a)_ij is the share of the samples of D_i whose
image lies in D_j (the paper's m(T_a^{-1}(D_j) n D_i)/m(D_i), estimated). Nothing is renormalised:
share in cells + absorbed + escaped = 1 for every pair. A pair with an escaping sample is
inadmissible and its row is not kept.

Work goes in blocks of pairs: memory beyond the result is bounded. Blocks are computed in several
threads and appended in order, so the rows do not depend on the number of threads.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.on_disk import Disk, growing
from lmdsl.common.types import Floats, Guard, Indices, Progress
from lmdsl.errors import BadInput
from lmdsl.machine.deadline import Deadline
from lmdsl.model.assembly.estimates import (
    Outlook,
    Pilot,
    refuse_given,
    require_least,
    require_room,
    unless_short,
)
from lmdsl.model.assembly.merging import BlockRows, Numbering, merge, merge_one, tile
from lmdsl.model.assembly.sampler import CHUNK, Block, Sampler
from lmdsl.model.discretization import Nodes
from lmdsl.model.grid import boxes
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows, Shares, append_end, code_type
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.systems import MatrixSystem


@dataclass(frozen=True, eq=False)
class Transitions:
    """The admissible pairs of a problem, ordered by cell, then control."""

    sets: CellSets  # the cells outside A and Z, on which pairs are formed
    # shape (F + 1,): pairs of the i-th free cell are ``pair_pointer[i]:pair_pointer[i + 1]``
    pair_pointer: Indices
    control: NDArray[np.int32]  # control index of each pair, int32
    rows: Rows  # one row per pair; targets number the free cells, F is the attractor
    cost: Floats  # weighted mean of the stage cost over the samples of each pair


SORTED_ALONE = CHUNK // 2  # number of samples of a pair from which on they are sorted by themselves


def assemble(
    problem: Problem,
    partition: Partition,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
    sets: CellSets | None = None,
    way: CellSets | None = None,
    span: tuple[int, int] | None = None,
    disk: Disk | None = None,
) -> Transitions:
    """Build the rows of every admissible pair.

    ``sets`` are the problem's, where they are known, and ``way`` those that judge what steps meet
    on their way, and what they pay at its end, where these are others. ``span`` are the first free
    cell whose pairs are asked for, and the one after the last, by their positions; default all.
    They are the same rows as among all: blocks of cells do not depend on what is asked for. On a
    ``disk`` the arrays of pairs and rows lie there instead of in memory.

    TimeLimitReached: the deadline has passed, and it was more than a moment's work. BadInput: the
    problem does not fit in memory, or the stage cost of an admissible pair is negative or not
    finite at a sample.
    """
    if span is None:  # else of a part, whose pairs are counted once a few cells are sampled
        require_least(problem, disk)
    deadline = unless_short(problem, Deadline.of(deadline))
    sets = sets or CellSets.of(problem, partition, deadline)
    if isinstance(problem.system, MatrixSystem):
        from lmdsl.model.assembly.given import cut, of_matrices  # which make what stands here

        refuse_given(disk)
        return cut(of_matrices(problem, partition, sets), span)
    sampler = Sampler(problem, partition, deadline, sets=way or sets)
    try:
        with sampler.asked.helped():
            sampler.audit(sets.free)
            asked = (0, len(sets.free)) if span is None else span
            return _assembled(problem, sets, sampler, progress, deadline, asked, disk)
    except BaseException:
        deadline.cancel()  # threads that help may be far from the end of their blocks
        raise


def _assembled(
    problem: Problem,
    sets: CellSets,
    sampler: Sampler,
    progress: Progress | None,
    deadline: Deadline,
    span: tuple[int, int],
    disk: Disk | None,
) -> Transitions:
    pilot = _pilot(sampler, sets, span)
    F, M = span[1] - span[0], len(sampler.controls)
    share = F / max(len(sets.free), 1)
    need = require_room(problem, "estimated from a few cells", disk, pilot, share)
    guard = partial(deadline.raise_if_over, "compiling")
    shares = shares_of(problem, len(sampler.points), sampler.nodes, guard)
    pairs = int(F * M * min(1.0, 1.05 * pilot.admissible)) + M
    capacity = int(pairs * (1.05 * pilot.entries + (shares.ended is not None))) + sampler.samples
    pointer, control = growing(disk, np.int64, pairs + 1), growing(disk, np.int32, pairs)
    cost = growing(disk, np.float64, pairs)
    target = growing(disk, np.int32, capacity)
    code = growing(disk, code_type(len(shares.numerator)), capacity)
    pair_pointer = np.zeros(F + 1, dtype=np.int64)
    pointer.append(np.zeros(1, dtype=np.int64))
    done, outlook = 0, Outlook("compiling and solving take", need, pairs * pilot.entries)
    # glibc returns the memory of a block to the system, to fault it in again for the next one,
    # unless it has seen more than that freed at once.
    np.empty(2**20)
    assembler = Assembler(sampler, sets, shares)
    parts = sampler.blocks(sets.free, span)
    for block, every in sampler.asked.in_order(assembler, parts, deadline.cancel):
        at, rows = _within(block, every, span)
        pair_pointer[1 + at : 1 + at + len(rows.per_cell)] += rows.per_cell
        pointer.append(rows.end + target.used)
        control.append(rows.control)
        cost.append(rows.cost)
        target.append(rows.target)
        code.append(rows.code)
        done += len(rows.per_cell) * block.width
        deadline.raise_if_over("compiling")
        if not sampler.asked.singles:  # which say so themselves
            outlook.done(done / (F * M))
        if progress:
            progress(sampler.asked.stage(done / (F * M)), done / (F * M))
    sampler.asked.again()
    return Transitions(
        sets=sets,
        pair_pointer=np.cumsum(pair_pointer, out=pair_pointer),
        control=control.array(),
        rows=Rows(pointer.array(), target.array(), code.array(), shares, len(sets.free)),
        cost=cost.array(),
    )


def _within(block: Block, rows: BlockRows, span: tuple[int, int]) -> tuple[int, BlockRows]:
    """Return which of the cells asked for a block begins with, and the rows of those in it.

    A block is always made as a whole: what a map is to the last bit may depend on the others.
    """
    first, last = max(span[0] - block.first, 0), min(span[1] - block.first, len(block.cells))
    at = block.first + first - span[0]
    if last - first == len(block.cells):
        return at, rows
    a, b = int(rows.per_cell[:first].sum()), int(rows.per_cell[:last].sum())
    start = rows.end[a - 1] if a else np.int64(0)
    entries = slice(int(start), int(rows.end[b - 1]) if b else 0)
    return at, BlockRows(
        rows.per_cell[first:last], rows.control[a:b], rows.cost[a:b], rows.end[a:b] - start,
        rows.target[entries], rows.code[entries],
    )  # fmt: skip


def shares_of(problem: Problem, points: int, nodes: Nodes, guard: Guard | None = None) -> Shares:
    """Return what the codes of a problem's sampled rows stand for."""
    shares = Shares.of(points, nodes, guard)
    return shares if problem.discount is None else shares.discounted(problem.discount)


def outcome(sampler: Sampler, cell: int, control: int) -> Indices:
    """Return the image cell of every sample of one pair, -1 where it leaves, shape (S,)."""
    block = Block(0, np.array([cell]), (control, control + 1))
    index = sampler.images(block, sampler.values(block)).reshape(-1)
    return np.where(index >= 0, index, -1.0).astype(np.int64)


class Assembler:
    """Computes the rows of blocks; it may be called from several threads at once."""

    def __init__(self, sampler: Sampler, sets: CellSets, shares: Shares) -> None:
        self.sampler, self.sets, nodes = sampler, sets, sampler.nodes
        self.columns, self.ended = len(sets.free), shares.ended
        sizes = np.bincount(nodes.group) * len(sampler.points)
        first_code = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
        bits = int(nodes.group.max()).bit_length()
        wide = (len(sets.free) + 1) << bits > 2**31
        group = np.tile(nodes.group, len(sampler.points)).astype(np.int64 if wide else np.int32)
        self.numbers = Numbering(sets.number, group, bits, first_code)

    def __call__(self, block: Block) -> tuple[Block, BlockRows]:
        """Return a block and its rows; BadInput: a cost is negative or not finite."""
        sampler, lanes = self.sampler, block.lanes
        index, mean = sampler.outcomes(block)
        self.sets.meet(index)
        rows = BlockRows(
            np.zeros(len(block.cells), dtype=np.int64),
            np.empty(lanes, dtype=np.int32),
            np.empty(lanes),
            np.empty(lanes, dtype=np.int64),
            np.empty(index.size, dtype=np.int32),
            np.empty(index.size, dtype=np.uint32),
        )
        per_cell, control, cost, end, target, code = rows
        high, wide = tile(block.cells_last, block.width)
        high = min(high, len(block.cells))
        if lanes == 1 and sampler.samples >= SORTED_ALONE:
            sampler.guard()
            row = merge_one(index, self.numbers)
            entries = len(row[0])
            target[:entries], code[:entries] = row
            pairs = per_cell[0] = int(entries > 0)
            control[0], cost[0], end[0] = 0, mean[0, 0], entries
        else:
            key = np.empty((sampler.samples, high * wide), dtype=self.numbers.group.dtype)
            pairs, entries = merge(
                index, block.cells_last, mean, self.numbers, key, high, wide, rows
            )  # fmt: skip
        control, cost = control[:pairs], cost[:pairs]
        if block.controls[0]:
            control += block.controls[0]
        if np.isnan(cost).any():
            k = int(np.isnan(cost).argmax())
            cell = block.cells[np.searchsorted(np.cumsum(per_cell), k, side="right")]
            _refuse_cost(sampler, int(cell), int(control[k]))
        parts = end[:pairs], target[:entries], code[:entries]
        if self.ended is not None:
            parts = append_end(*parts, self.columns, self.ended)
        return block, BlockRows(per_cell, control, cost, *parts)


def _pilot(sampler: Sampler, sets: CellSets, span: tuple[int, int]) -> Pilot:
    """Sample a few cells spread over those that are asked for."""
    F, M, S = span[1] - span[0], len(sampler.controls), sampler.samples
    if not F:
        return Pilot()
    count = max(1, min(64, F, 4 * sampler.chunk // S))
    cells = sets.free[np.linspace(span[0], span[1] - 1, count).astype(int)]
    width = max(1, min(M, 4 * sampler.chunk // (count * S)))
    blocks = [Block(0, cells, (0, M))]
    if width < M:  # another part of the controls for every cell
        starts = np.linspace(0, M - width, count).astype(int).tolist()
        blocks = [Block(0, cells[i : i + 1], (a, a + width)) for i, a in enumerate(starts)]
    lengths = np.concatenate([_lengths(sampler, sets, block) for block in blocks])
    kept = lengths > 0
    return Pilot(float(kept.mean()), float(lengths[kept].mean()) if kept.any() else 1.0)


def _lengths(sampler: Sampler, sets: CellSets, block: Block) -> Indices:
    """Return the number of targets of every pair of a block, 0 where inadmissible."""
    index = sampler.images(block, sampler.values(block))
    sampler.guard()
    leaves = np.isnan(index)
    sets.meet(index)
    target = sets.number[np.where(leaves, 0.0, index).astype(np.int64)]
    target[leaves] = -1
    rows = np.sort(target, axis=1)
    lengths: Indices = (np.diff(rows, axis=1) != 0).sum(axis=1) + 1
    return np.where(rows[:, 0] >= 0, lengths, 0).ravel()


def _refuse_cost(sampler: Sampler, cell: int, control: int) -> None:
    block = Block(0, np.array([cell]), (control, control + 1))
    values = sampler.values(block)
    for key, sample in sampler.costs_by_key(block, values).items():
        faulty = ~((sample >= 0) & np.isfinite(sample))
        if not faulty.any():
            continue
        every = np.broadcast_arrays(sample, faulty, *values.values())
        k = int(every[1].argmax())
        worst, _, *at = (float(array.flat[k]) for array in every)
        place = ", ".join(f"{name} = {x + 0.0:.6g}" for name, x in zip(values, at, strict=True))
        raise BadInput(
            f"the {key.replace('_', ' ')} is {worst!r} at {place}, a sample of "
            f"{boxes.named(sampler.partition, cell)}; it must be finite and >= 0 at every sample "
            "of every admissible pair: add a constant, square it, or write max(0, ...)",
            key,
        )
    raise BadInput("the mean of the samples overflows; scale the cost down", "stage_cost")

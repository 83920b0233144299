"""Ulam's method: the samples of every cell and control become transition rows.

For a cell D_i outside A and Z and a control u^a, (P_a)_ij is the share of the samples of D_i whose
image lies in D_j (the paper's m(T_a^{-1}(D_j) n D_i)/m(D_i), estimated). Nothing is renormalised:
share in cells + absorbed + escaped = 1 for every pair. A pair with an escaping sample is
inadmissible and its row is not kept.

Work goes in blocks of pairs: memory beyond the result is bounded. Blocks are computed in several
threads and appended in order, so the rows do not depend on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmdsl.common.types import Floats, Progress
from lmdsl.errors import BadInput
from lmdsl.formulas.program import Program
from lmdsl.machine import memory, threads
from lmdsl.machine.deadline import Deadline
from lmdsl.model import discretization
from lmdsl.model.assembly.merging import BlockRows, Numbering, merge, merge_one, tile
from lmdsl.model.assembly.sampler import CHUNK, Block, Sampler
from lmdsl.model.grid.partition import Partition
from lmdsl.model.rows import Rows, Shares, code_type
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Transitions:
    """The admissible pairs of a problem, ordered by cell, then control.

    Attributes
    ----------
    sets
        The cells outside A and Z, on which pairs are formed.
    pair_pointer
        Shape (F + 1,): pairs of the i-th free cell are ``pair_pointer[i]:pair_pointer[i + 1]``.
    control
        Control index of each pair, int32.
    rows
        One row per pair; targets number the free cells, F is the attractor.
    cost
        Weighted mean of the stage cost over the samples of each pair.
    """

    sets: CellSets
    pair_pointer: NDArray[np.int64]
    control: NDArray[np.int32]
    rows: Rows
    cost: Floats


def require_least(problem: Problem) -> None:
    """Refuse a problem whose grids and cells do not fit, before anything of it is made."""
    memory.require(estimate(problem), "at least, before sampling")


class Pilot(NamedTuple):
    """What a few cells say of all: the share of admissible pairs and the mean length of rows."""

    admissible: float = 1.0
    entries: float = 1.0


ALL_ADMISSIBLE = Pilot()


def estimate(problem: Problem, pilot: Pilot = ALL_ADMISSIBLE) -> int:
    """Return an upper bound of the bytes that compiling and solving a problem takes.

    Solving is counted for the default backend, as it goes as a rule. What takes more (cells that
    are lost, ties, other backends, a first policy that is hard to find) asks when it comes to it.
    """
    # Capped: a stranger's product of counts may exceed the range of doubles.
    N = min(math.prod(axis.cells for axis in problem.state_box.values()), 10**40)
    M = min(discretization.control_count(problem), 10**40)
    S = min(discretization.sample_points(problem) * discretization.node_count(problem), 10**40)
    entry = 4 + (1 if S <= 2**8 else 2 if S <= 2**16 else 4)
    pairs = M * pilot.admissible
    # Of a pair the row, its end, control and cost; of a cell the sets, levels and weights.
    model = N * (64 + pairs * (21 + pilot.entries * entry))
    copied = (
        pairs * (28 + pilot.entries * entry) if pilot.admissible < 1 else 0
    )  # cells may be lost
    # Of a pair whether it ties, and a unit cost; of a cell vectors, and the rows of a policy in
    # doubles.
    solving = pairs * 9 + 130 + 24 * pilot.entries
    peak = MARGIN * (model + max(N * copied + _blocks(problem, S), N * solving))
    return int(min(peak + _grids(problem, M, S) + OVERHEAD, 1e30))


MARGIN = 1.1
"""A few cells do not say exactly what all are like, and allocators keep something back."""

OVERHEAD = 2**25
"""Bytes of code, kernels and tables."""

CODE = 250
"""Bytes of a code of samples with noise: its exact numerator, of up to a thousand bits."""


def _blocks(problem: Problem, S: int) -> int:
    """Return the bytes of the blocks that are sampled at a time."""
    step, cost = problem.step(), Program([problem.cost()], problem.system.constants())
    d, samples, count = len(problem.state_box), max(CHUNK, S), threads.count()
    # States, images and their cells, the arrays of a formula, keys and rows.
    live = max(step.live, cost.live)
    each = 8 * samples * (3 * d + live + 8)
    waiting = 8 * (count - 1) * 16 * samples  # finished blocks, for their turn
    return count * each + waiting


def _grids(problem: Problem, M: int, S: int) -> int:
    """Return the bytes of sample points, controls, noise nodes and codes."""
    points, nodes = discretization.sample_points(problem), discretization.node_count(problem)
    codes = S * (CODE if nodes > 1 else 16)
    controls = M * 8 * (1 + 4 * len(problem.control_grid))
    return controls + points * 40 * len(problem.state_box) + nodes * discretization.NODE + codes


SHORT = 2e9
"""Additions up to which compiling takes a moment, and is not ended for the time it takes."""

MANY = CHUNK // 2
"""Samples from which those of a pair are sorted by themselves."""

SAMPLE = 40
"""Additions that take as long as locating and sorting a sample."""

CALL = 2_000
"""Additions that take as long as NumPy's own work for an operation on an array."""

SET = 20_000
"""Additions that take as long as resolving a point or a box of a set, its cells apart."""


def unless_short(problem: Problem, deadline: Deadline) -> Deadline:
    """Return a deadline, or one that never passes where compiling takes a moment at most."""
    N = math.prod(axis.cells for axis in problem.state_box.values())
    lanes = N * discretization.control_count(problem)
    samples = discretization.sample_points(problem) * discretization.node_count(problem)
    step, cost = problem.step(), Program([problem.cost()], problem.system.constants())
    calls = 2 + 2 * lanes * min(samples, CHUNK) // CHUNK
    work = lanes * samples * (SAMPLE + step.work + cost.work)
    work += CALL * calls * (step.effort + cost.effort)
    attractor, avoid, weight = problem.attractor, problem.avoid, problem.measure
    boxes = [attractor.boxes, avoid.boxes if avoid else (), (weight and weight.boxes) or ()]
    count = sum(map(len, boxes))
    work += N * count + SET * (count + len(attractor.points) + len(attractor.cells))
    density = problem.density()
    if density is not None:
        work += N * Program([density], problem.system.constants()).work
    if problem.local_controller is not None:  # linearised: some fifty operations for each
        work += 50 * CALL * step.effort
    return Deadline() if work <= SHORT else deadline


def assemble(
    problem: Problem,
    partition: Partition,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
) -> Transitions:
    """Build the rows of every admissible pair.

    Raises
    ------
    TimeLimitReached
        The deadline has passed, and it was more than a moment's work.
    BadInput
        The problem does not fit in memory, or the stage cost of an admissible pair is negative
        or not finite at a sample.
    """
    require_least(problem)
    deadline = unless_short(problem, Deadline.of(deadline))
    sets = CellSets.of(problem, partition, deadline)
    sampler = Sampler(problem, partition, deadline)
    try:
        return _assembled(problem, sets, sampler, progress, deadline)
    except BaseException:
        deadline.cancel()  # threads that help may be far from the end of their blocks
        raise


def _assembled(
    problem: Problem,
    sets: CellSets,
    sampler: Sampler,
    progress: Progress | None,
    deadline: Deadline,
) -> Transitions:
    audit = sampler.audit(sets.free)
    pilot = _pilot(sampler, sets)
    memory.require(estimate(problem, pilot), "estimated from a few cells")
    F, M = len(sets.free), len(sampler.controls)
    shares = Shares.of(len(sampler.points), sampler.nodes)
    pairs = int(F * M * min(1.0, 1.05 * pilot.admissible)) + M
    room = int(pairs * 1.05 * pilot.entries) + sampler.samples
    pointer, control = _Growing(np.int64, pairs + 1), _Growing(np.int32, pairs)
    cost = _Growing(np.float64, pairs)
    target, code = _Growing(np.int32, room), _Growing(code_type(len(shares.numerator)), room)
    pair_pointer = np.zeros(F + 1, dtype=np.int64)
    pointer.append(np.zeros(1, dtype=np.int64))
    done = 0
    # glibc returns the memory of a block to the system, to fault it in again for the next one,
    # unless it has seen more than that freed at once.
    np.empty(2**20)
    assembler, parts = _Assembler(sampler, sets), sampler.blocks(sets.free)
    for block, rows in threads.in_order(assembler, parts, deadline.cancel):
        pair_pointer[1 + block.first : 1 + block.first + len(block.cells)] += rows.per_cell
        pointer.append(rows.end + target.used)
        control.append(rows.control)
        cost.append(rows.cost)
        target.append(rows.target)
        code.append(rows.code)
        done += block.lanes
        deadline.raise_if_over("compiling")
        if progress:
            progress("transitions", done / (F * M))
    if audit is not None:
        audit.again()
    return Transitions(
        sets=sets,
        pair_pointer=np.cumsum(pair_pointer, out=pair_pointer),
        control=control.array(),
        rows=Rows(pointer.array(), target.array(), code.array(), shares, F),
        cost=cost.array(),
    )


def outcome(sampler: Sampler, cell: int, control: int) -> NDArray[np.int64]:
    """Return the image cell of every sample of one pair, -1 where it leaves, shape (S,)."""
    block = Block(0, np.array([cell]), (control, control + 1))
    index = sampler.images(block, sampler.values(block)).reshape(-1)
    return np.where(index >= 0, index, -1.0).astype(np.int64)


class _Assembler:
    """Computes the rows of blocks; it may be called from several threads at once."""

    def __init__(self, sampler: Sampler, sets: CellSets) -> None:
        self.sampler, nodes = sampler, sampler.nodes
        sizes = np.bincount(nodes.group) * len(sampler.points)
        first_code = np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)
        bits = int(nodes.group.max()).bit_length()
        wide = (len(sets.free) + 1) << bits > 2**31
        group = np.tile(nodes.group, len(sampler.points)).astype(np.int64 if wide else np.int32)
        self.numbers = Numbering(sets.number, group, bits, first_code)

    def __call__(self, block: Block) -> tuple[Block, BlockRows]:
        sampler, lanes = self.sampler, block.lanes
        index, mean = sampler.outcomes(block)
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
        if lanes == 1 and sampler.samples >= MANY:
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
        return block, BlockRows(
            per_cell, control, cost, end[:pairs], target[:entries], code[:entries]
        )


def _pilot(sampler: Sampler, sets: CellSets) -> Pilot:
    """Sample a few cells spread over the box."""
    if not len(sets.free):
        return Pilot()
    F, M, S = len(sets.free), len(sampler.controls), sampler.samples
    count = min(64, F)
    cells = sets.free[np.linspace(0, F - 1, count).astype(int)]
    width = max(1, min(M, 4 * CHUNK // (count * S)))
    blocks = [Block(0, cells, (0, M))]
    if width < M:  # another part of the controls for every cell
        starts = np.linspace(0, M - width, count).astype(int).tolist()
        blocks = [Block(0, cells[i : i + 1], (a, a + width)) for i, a in enumerate(starts)]
    lengths = np.concatenate([_lengths(sampler, sets, block) for block in blocks])
    kept = lengths > 0
    return Pilot(float(kept.mean()), float(lengths[kept].mean()) if kept.any() else 1.0)


def _lengths(sampler: Sampler, sets: CellSets, block: Block) -> NDArray[np.int64]:
    """Return the number of targets of every pair of a block, 0 where inadmissible."""
    index = sampler.images(block, sampler.values(block))
    sampler.guard()
    leaves = np.isnan(index)
    target = sets.number[np.where(leaves, 0.0, index).astype(np.int64)]
    target[leaves] = -1
    rows = np.sort(target, axis=1)
    lengths: NDArray[np.int64] = (np.diff(rows, axis=1) != 0).sum(axis=1) + 1
    return np.where(rows[:, 0] >= 0, lengths, 0).ravel()


def _refuse_cost(sampler: Sampler, cell: int, control: int) -> None:
    values = sampler.values(Block(0, np.array([cell]), (control, control + 1)))
    sample = np.asarray(sampler.cost(values)[0])
    faulty = sample[~((sample >= 0) & np.isfinite(sample))].ravel()
    if not len(faulty):
        raise BadInput("the mean of the samples overflows; scale the cost down", "stage_cost")
    worst = float(faulty[0])
    index = [int(k) for k in np.unravel_index(cell, sampler.partition.shape)]
    vector = [float(u) for u in sampler.controls[control]]
    raise BadInput(
        f"the stage cost is {worst!r} at a sample of cell {index} under control {vector}; "
        "it must be finite and >= 0 at every sample of every admissible pair",
        "stage_cost",
    )


class _Growing:
    """An array that grows by reallocation, so that no second copy of it ever exists.

    Room that is never used is never touched: it takes addresses, not memory.
    """

    def __init__(self, dtype: Any, room: int) -> None:
        self.data = np.empty(room, dtype=dtype)
        self.used = 0

    def append(self, part: NDArray[Any]) -> None:
        end = self.used + len(part)
        if end > len(self.data):
            more = int(1.1 * end) - len(self.data)
            memory.require(more * self.data.itemsize, "rows longer than those of a few cells")
            self.data.resize(int(1.1 * end), refcheck=False)
        self.data[self.used : end] = part
        self.used = end

    def array(self) -> NDArray[Any]:
        self.data.resize(self.used, refcheck=False)
        return self.data

"""Ulam's method: the samples of every cell and control become transition rows.

For a cell D_i outside A and Z and a control u^a, (P_a)_ij is the share of the samples of D_i whose
image lies in D_j (the paper's m(T_a^{-1}(D_j) n D_i)/m(D_i), estimated). Nothing is renormalised:
share in cells + absorbed + escaped = 1 for every pair. A pair with an escaping sample is
inadmissible and its row is not kept.

Formulas are evaluated on arrays of shape (cells, controls, points, nodes) that broadcast: what
does not depend on the control is computed once per cell. Work goes in chunks of cells, so memory
beyond the result is bounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from lmdsl import memory, sampling
from lmdsl.errors import BadInput
from lmdsl.partition import Partition
from lmdsl.problem import Problem
from lmdsl.program import Program
from lmdsl.regions import Regions
from lmdsl.rows import Rows, Shares, code_type

CHUNK = 2**16
"""Samples evaluated at a time: the temporaries of a formula stay in cache."""

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Transitions:
    """The admissible pairs of a problem, ordered by cell, then control.

    Attributes
    ----------
    regions
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

    regions: Regions
    pair_pointer: NDArray[np.int64]
    control: NDArray[np.int32]
    rows: Rows
    cost: Floats


class Sampler:
    """Evaluates a problem's map and stage cost at the samples of chunks of cells.

    Attributes
    ----------
    controls
        Control vectors, shape (M, p).
    points, nodes
        Sample offsets (points, d) and noise nodes.
    """

    def __init__(self, problem: Problem, partition: Partition) -> None:
        self.problem, self.partition = problem, partition
        self.points = sampling.offsets(problem)
        self.controls = sampling.control_vectors(problem)
        self.nodes = sampling.noise_nodes(problem)
        self.samples = len(self.points) * len(self.nodes.weights)
        self.step = problem.step()
        self.cost = Program([problem.cost()], problem.system.constants())

    def values(self, cells: NDArray[np.int64], controls: slice) -> dict[str, Floats]:
        """Return named arrays that broadcast to (cells, controls, points, nodes)."""
        axes = self.partition.samples(cells, self.points)
        named = {
            name: axis[:, None, :, None]
            for name, axis in zip(self.problem.states, axes, strict=True)
        }
        for k, name in enumerate(self.problem.controls):
            named[name] = np.ascontiguousarray(self.controls[controls, k])[None, :, None, None]
        for k, name in enumerate(self.problem.noises):
            named[name] = np.ascontiguousarray(self.nodes.values[:, k])[None, None, None, :]
        return named

    def evaluate(
        self, cells: NDArray[np.int64], controls: slice
    ) -> tuple[NDArray[np.int64], Floats, NDArray[np.bool_]]:
        """Return the image cells (cells, controls, points, nodes), mean cost and its validity."""
        width = len(range(*controls.indices(len(self.controls))))
        shape = (len(cells), width, len(self.points), len(self.nodes.weights))
        values = self.values(cells, controls)
        flat = np.zeros(shape, dtype=np.int64)
        images = [_four(image) for image in self.step(values)]
        self.partition.locate_into(flat, images)
        cost = np.broadcast_to(_four(self.cost(values)[0]), shape)
        mean, valid = np.empty(shape[:2]), np.empty(shape[:2], dtype=np.bool_)
        _mean_cost(cost, self.nodes.weights, mean, valid)
        return flat, mean, valid

    def blocks(self, cells: NDArray[np.int64]) -> Iterator[tuple[NDArray[np.int64], slice]]:
        """Yield (cells, controls) so that each block has about CHUNK samples, in pair order."""
        M = len(self.controls)
        per_cell = M * self.samples
        if per_cell <= CHUNK:
            step = CHUNK // per_cell
            for i in range(0, len(cells), step):
                yield cells[i : i + step], slice(0, M)
            return
        step = max(1, CHUNK // self.samples)
        for i in range(len(cells)):
            for a in range(0, M, step):
                yield cells[i : i + 1], slice(a, min(a + step, M))


def _four(array: Floats) -> Floats:
    return array.reshape((1,) * (4 - array.ndim) + array.shape)


def estimate(problem: Problem, entries: float = 1.0) -> int:
    """Return the bytes needed to compile a problem, given the mean entries per row."""
    # Capped: a stranger's product of counts may exceed the range of doubles.
    N = min(math.prod(axis.cells for axis in problem.state_box.values()), 10**40)
    M = min(sampling.control_count(problem), 10**40)
    S = min(sampling.sample_points(problem) * sampling.node_count(problem), 10**40)
    code = 1 if S <= 2**8 else 2 if S <= 2**16 else 4
    pairs = N * M
    rows = pairs * (20 + entries * (4 + code) * 1.25)
    graph = pairs * (8 + 4 * entries)
    grids = M * 8 * (1 + len(problem.control_grid)) + S * (8 * len(problem.state_box) + 200)
    # Samples and images of every axis, and the intermediate arrays of a formula.
    temporaries = (2 * len(problem.state_box) + 10) * 8 * max(CHUNK, S)
    return int(min(N * 40 + rows + graph + grids + temporaries, 1e30))


def assemble(
    problem: Problem, partition: Partition, progress: Progress | None = None
) -> Transitions:
    """Build the rows of every admissible pair.

    Raises
    ------
    BadInput
        The problem does not fit in memory, or the stage cost of an admissible pair is negative
        or not finite at a sample.
    """
    memory.require(estimate(problem), "a lower estimate, before sampling")
    regions = Regions.of(problem, partition)
    sampler = Sampler(problem, partition)
    memory.require(estimate(problem, _pilot(sampler, regions)), "estimated from a few cells")
    F, M, S = len(regions.free), len(sampler.controls), sampler.samples
    group = np.tile(sampler.nodes.group, len(sampler.points))
    first_code = _first_codes(sampler)
    shares = Shares.of(len(sampler.points), sampler.nodes)
    length = _Growing(np.int32)  # entries of each pair's row, 0 where inadmissible
    cost, target = _Growing(np.float64), _Growing(np.int32)
    code = _Growing(code_type(len(shares.numerator)))
    done = 0
    for cells, controls in sampler.blocks(regions.free):
        flat, mean, valid = sampler.evaluate(cells, controls)
        pairs = flat.shape[0] * flat.shape[1]
        lengths = length.room(pairs)
        used = _merge(
            flat.reshape(pairs, S),
            regions.number,
            group,
            first_code,
            lengths,
            target.room(pairs * S),
            code.room(pairs * S),
        )
        kept = lengths > 0
        if not valid.ravel()[kept].all():
            _refuse_cost(sampler, cells, controls, kept & ~valid.ravel())
        cost.room(int(kept.sum()))[:] = mean.ravel()[kept]
        for growing, count in ((length, pairs), (target, used), (code, used)):
            growing.keep(count)
        cost.keep(int(kept.sum()))
        done += pairs
        if progress:
            progress("transitions", done / (F * M))
    lengths = length.array()
    admissible = lengths > 0
    pointer = np.zeros(int(admissible.sum()) + 1, dtype=np.int64)
    np.cumsum(lengths[admissible], out=pointer[1:])
    per_cell = admissible.reshape(F, M).sum(axis=1)
    control = np.tile(np.arange(M, dtype=np.int32), F)[admissible]
    return Transitions(
        regions=regions,
        pair_pointer=np.concatenate([[0], np.cumsum(per_cell)]).astype(np.int64),
        control=control,
        rows=Rows(pointer, target.array(), code.array(), shares, F),
        cost=cost.array(),
    )


def outcome(sampler: Sampler, cell: int, control: int) -> NDArray[np.int64]:
    """Return the image cell of every sample of one pair, -1 where it leaves, shape (S,)."""
    flat, _, _ = sampler.evaluate(np.array([cell]), slice(control, control + 1))
    return flat.reshape(-1)


def _first_codes(sampler: Sampler) -> NDArray[np.int64]:
    """Code of a single sample of each group (see rows.Shares)."""
    sizes = np.bincount(sampler.nodes.group) * len(sampler.points)
    return np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64)


def _pilot(sampler: Sampler, regions: Regions) -> float:
    """Estimate the mean entries per pair from a few cells spread over the box."""
    if not len(regions.free):
        return 1.0
    M, S = len(sampler.controls), sampler.samples
    count = max(1, min(32, CHUNK // (M * S), len(regions.free)))
    cells = regions.free[np.linspace(0, len(regions.free) - 1, count).astype(int)]
    controls = slice(0, min(M, max(1, 4 * CHUNK // S)))
    flat, _, _ = sampler.evaluate(cells, controls)
    rows = np.sort(flat.reshape(-1, S), axis=1)
    rows = rows[rows[:, 0] >= 0]
    return float((np.diff(rows, axis=1) != 0).sum(axis=1).mean() + 1) if len(rows) else 1.0


def _refuse_cost(
    sampler: Sampler, cells: NDArray[np.int64], controls: slice, bad: NDArray[np.bool_]
) -> None:
    width = len(bad) // len(cells)
    i, a = divmod(int(np.flatnonzero(bad)[0]), width)
    cell, control = int(cells[i]), int(controls.start) + a
    values = sampler.values(np.array([cell]), slice(control, control + 1))
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
    """An array that grows by reallocation, so that no second copy of it ever exists."""

    def __init__(self, dtype: Any) -> None:
        self.data = np.empty(CHUNK, dtype=dtype)
        self.used = 0

    def room(self, count: int) -> NDArray[Any]:
        if self.used + count > len(self.data):
            self.data.resize(int(1.25 * (self.used + count)), refcheck=False)
        return self.data[self.used : self.used + count]

    def keep(self, count: int) -> None:
        self.used += count

    def array(self) -> NDArray[Any]:
        self.data.resize(self.used, refcheck=False)
        return self.data


@njit(
    types.void(
        types.Array(types.float64, 4, "A", readonly=True),
        types.float64[::1],
        types.float64[:, ::1],
        types.boolean[:, ::1],
    ),
    cache=True,
    nogil=True,
)
def _mean_cost(cost, weights, mean, valid):  # type: ignore[no-untyped-def]
    """Weighted mean over (points, nodes), and whether every sample is finite and >= 0."""
    points, nodes = cost.shape[2], cost.shape[3]
    total = points * weights.sum()
    for c in range(cost.shape[0]):
        for a in range(cost.shape[1]):
            amount, fine = 0.0, True
            for p in range(points):
                for q in range(nodes):
                    g = cost[c, a, p, q]
                    fine = fine and g >= 0.0 and g < np.inf
                    amount += weights[q] * g
            mean[c, a] = amount / total
            valid[c, a] = fine and mean[c, a] < np.inf


@njit(cache=True, nogil=True)
def _merge(flat, number, group, first_code, lengths, target, code):  # type: ignore[no-untyped-def]
    """Sort the samples of each pair by (target, group) and count equal ones.

    Writes rows one after the other into target and code, their lengths into ``lengths``
    (0: inadmissible, nothing written), and returns the number of entries.
    """
    pairs, S = flat.shape
    groups = len(first_code)
    key = np.empty(S, dtype=np.int64)
    used = 0
    for k in range(pairs):
        escaped = False
        for s in range(S):
            cell = flat[k, s]
            if cell < 0 or number[cell] < 0:
                escaped = True
                break
            value = np.int64(number[cell]) * groups + group[s]
            if S > 64:
                key[s] = value
                continue
            j = s
            while j > 0 and key[j - 1] > value:
                key[j] = key[j - 1]
                j -= 1
            key[j] = value
        lengths[k] = 0
        if escaped:
            continue
        if S > 64:
            key.sort()
        start = used
        s = 0
        while s < S:
            run = s + 1
            while run < S and key[run] == key[s]:
                run += 1
            target[used] = key[s] // groups
            code[used] = first_code[key[s] % groups] + (run - s - 1)
            used += 1
            s = run
        lengths[k] = used - start
    return used

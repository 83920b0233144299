"""A survey: what the map does to some cells, spread over the box."""

from collections.abc import Iterator

import numpy as np

from lmdsl.common.types import Bools, Floats, Indices
from lmdsl.explanation.trials import MapTrial
from lmdsl.machine.deadline import Deadline
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets
from lmdsl.problem.problem import Problem
from lmdsl.slabs.graph.cuts import Blocks, Looked

# Number of cells that are tried, and of operations above which they are fewer.
LEAST_CELLS, MOST_CELLS, WORK = 64, 1024, 1e9
SAMPLE = 40  # operations that take as long as what a sample takes beside the map
SLOW = 1e5  # the same for a map of which nobody knows
MOST_SETS = 2**22  # number of cells above which the sets are not made for a survey
EDGE = 1e-8  # widths from an edge within which an image lands on it


class Variant(MapTrial):
    """The map tried on cells, however many, a few at a time."""

    def batches(self, cells: Indices) -> Iterator[Indices]:
        """Yield a few of the cells at a time."""
        for start in range(0, len(cells), self.most_cells):
            yield cells[start : start + self.most_cells]

    def stuck_share(self, cells: Indices) -> float:
        """Return the share of cells that keep all of their samples under every control."""
        return float(np.mean(self.all_stuck(cells))) if len(cells) else 0.0

    def all_stuck(self, cells: Indices) -> Bools:
        """Return which of many cells keep all of their samples under every control."""
        parts = [self.stuck(some) for some in self.batches(cells)]
        return np.concatenate([np.zeros(0, dtype=np.bool_), *parts])

    def edge_share(self, axis: int, places: Floats) -> float:
        """Return the share of images on an edge, of the samples of cells around places (r, d)."""
        cells: Indices = np.unique(self.partition.locate([*places.T]))
        shares = [
            len(some)
            * self.edge_share_of(axis, self.images(self.start(some), self.vectors())[axis])
            for some in self.batches(cells)
        ]
        return float(np.sum(shares) / max(len(cells), 1))

    def edge_share_of(self, axis: int, image: Floats) -> float:
        """Return the share of images on an edge inside an axis, of sample points that are not."""
        p = self.partition
        t = (image - p.low[axis]) / p.width[axis]
        on = np.abs(t - np.round(t)) <= EDGE
        if not p.periodic[axis]:
            on &= (t > EDGE) & (t < p.cells[axis] - EDGE)
        inside: Bools = np.all((self.points > 0) & (self.points < 1), axis=1)
        if image.ndim == 4 and image.shape[2] == len(inside):
            on = on[:, :, inside]
        return float(on.mean()) if on.size else 0.0


class Survey(Variant):
    """The map tried on cells chosen at random, with a fixed seed, outside attractor and avoid.

    Attributes
    ----------
    sets
        The sets of cells, None where there are too many cells.
    cells
        What was tried, ascending.
    stays
        Which of them keep all of their samples under every control tried.
    moved
        How far the median sample of each moves under the control that moves it most, in widths of
        a cell, on the axis where that is most.
    on_edge
        Share of the images on each axis that land on an edge between two cells, shape (d,).
    """

    def __init__(
        self, problem: Problem, partition: Partition, deadline: Deadline | None = None
    ) -> None:
        super().__init__(problem, partition, deadline, "checking")
        self.sets = CellSets.of(problem, partition) if partition.size <= MOST_SETS else None
        each = len(self.points) * len(self.nodes) * len(self.controls)
        work = min(self.true_map.map.work, SLOW) + SAMPLE
        self.count = int(min(max(WORK / (work * each), LEAST_CELLS), MOST_CELLS))
        self.cells = self._chosen()
        self.stays = self.all_stuck(self.cells)
        moved = [np.zeros(0)]
        edge = np.zeros(partition.dimension)
        with np.errstate(all="ignore"):
            for cells in self.batches(self.cells):
                start = self.start(cells)
                images = self.images(start, self.vectors())
                moved.append(self._moved(start, images, self.shape(cells)))
                shares = [self.edge_share_of(k, image) for k, image in enumerate(images)]
                edge += len(cells) * np.array(shares)
        self.moved: Floats = np.concatenate(moved)
        self.on_edge: Floats = edge / max(len(self.cells), 1)

    def of(self, problem: Problem) -> "Variant":
        """Return the map of a changed problem, to be tried on the same cells."""
        return Variant(problem, Partition.of(problem))

    def _chosen(self) -> Indices:
        random = np.random.default_rng(0)
        if self.sets is None:
            return np.unique(random.integers(self.partition.size, size=self.count))
        free = self.sets.free
        if len(free) <= self.count:
            return free
        return np.sort(random.choice(free, self.count, replace=False))

    def _moved(
        self, start: list[Floats], images: tuple[Floats, ...], shape: tuple[int, ...]
    ) -> Floats:
        far = np.zeros(shape)
        for k, (x, image) in enumerate(zip(start, images, strict=True)):
            away = image - x
            if self.partition.periodic[k]:
                away = away - np.round(away / self.span[k]) * self.span[k]
            np.fmax(far, np.abs(away) / self.partition.width[k], out=far)
        return np.asarray(np.median(far.max(axis=1), axis=(1, 2)))

    def looked(self, blocks: Blocks) -> Looked:
        """Return which middles are free and have an admissible pair, and where these pairs lead."""
        middles, size = blocks.middles, self.partition.size
        block = np.flatnonzero(self._free(middles))
        pairs, keys = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        with np.errstate(all="ignore"):
            for cells in self.batches(middles[block]):
                to, inside = self._targets(cells)
                led = inside[:, :, None, None] & self._free(to)
                whose = np.nonzero(led)[0] + sum(map(len, pairs))
                pairs.append(inside.sum(axis=1))
                keys.append(np.unique(whose * size + to[led]))
        each = np.concatenate(pairs)
        source, target = np.divmod(np.concatenate(keys), size)
        some, number = np.flatnonzero(each), np.cumsum(each > 0) - 1
        return Looked(block[some], each[some], number[source], target)

    def _targets(self, cells: Indices) -> tuple[Indices, Bools]:
        """Return where samples of cells end, shape (cells, controls, points, nodes), -1 outside.

        And of which pairs none leaves, or ends in a cell to avoid.
        """
        state, controls = self.start(cells), self.vectors()
        to = self.partition.locate(self.images(state, controls))
        stays: Bools = to >= 0
        admitted = self.admits(state, controls)
        if admitted is not None:
            stays = stays & admitted
        if self.sets is not None:
            stays = stays & (self.sets.number[to] >= 0)
        shape = self.shape(cells)
        inside = np.asarray(np.broadcast_to(stays, shape).all(axis=(2, 3)))
        return np.broadcast_to(to, shape), inside

    def _free(self, cells: Indices) -> Bools:
        """Return which cells lie outside attractor and avoid, all where that is not known."""
        if self.sets is None:
            return np.ones(cells.shape, dtype=np.bool_)
        number = self.sets.number[cells]
        return np.asarray((number >= 0) & (number < len(self.sets.free)))

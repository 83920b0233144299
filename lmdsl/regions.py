"""Which cells are attractor, avoid or free, and where the weight m may be positive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmdsl.errors import BadInput
from lmdsl.partition import Partition
from lmdsl.problem import Problem


@dataclass(frozen=True)
class Regions:
    """Which cells are attractor (A), avoid (Z) or free (neither).

    Attributes
    ----------
    attractor, avoid
        Masks of shape (N,).
    support
        Cells in which m may be positive, shape (N,).
    free
        Indices of the cells outside A and Z, shape (F,), ascending.
    number
        Shape (N,), int32: position in ``free``; F for the attractor; -1 for avoid.
    """

    attractor: NDArray[np.bool_]
    avoid: NDArray[np.bool_]
    support: NDArray[np.bool_]
    free: NDArray[np.int64]
    number: NDArray[np.int32]

    @classmethod
    def of(cls, problem: Problem, partition: Partition) -> Regions:
        """Resolve the attractor, avoid and measure of a problem.

        Raises
        ------
        BadInput
            A point or index lies outside the box, a set has no cell, or a cell is both
            attractor and avoid.
        """
        attractor = _attractor(problem, partition)
        avoid = np.zeros(partition.size, dtype=np.bool_)
        if problem.avoid:
            avoid = partition.mask(
                partition.overlapping_box(box, f"avoid.boxes[{i}]")
                for i, box in enumerate(problem.avoid.boxes)
            )
        both = np.flatnonzero(attractor & avoid)
        if len(both):
            index = [int(k) for k in np.unravel_index(both[0], partition.shape)]
            raise BadInput(f"cell {index} is both attractor and avoid; shrink one of them", "avoid")
        support = np.ones(partition.size, dtype=np.bool_)
        if problem.measure:
            support = partition.mask(
                partition.inside_box(box, f"measure.boxes[{i}]")
                for i, box in enumerate(problem.measure.boxes)
            )
            if not support.any():
                raise BadInput("no cell lies inside the boxes; enlarge them", "measure.boxes")
        free = np.flatnonzero(~attractor & ~avoid)
        number = np.full(partition.size, -1, dtype=np.int32)
        number[free] = np.arange(len(free), dtype=np.int32)
        number[attractor] = len(free)
        return cls(attractor, avoid, support, free, number)


def _attractor(problem: Problem, partition: Partition) -> NDArray[np.bool_]:
    declared = problem.attractor
    blocks = [
        partition.around_point(
            [point[name] for name in partition.names] if isinstance(point, dict) else point,
            f"attractor.points[{i}]",
        )
        for i, point in enumerate(declared.points)
    ]
    blocks += [
        partition.inside_box(box, f"attractor.boxes[{i}]") for i, box in enumerate(declared.boxes)
    ]
    for i, cell in enumerate(declared.cells):
        for k, index in enumerate(cell):
            if index >= partition.cells[k]:
                raise BadInput(
                    f"index {index} is outside 0..{partition.cells[k] - 1} of axis "
                    f"{partition.names[k]}",
                    f"attractor.cells[{i}]",
                )
        blocks.append(tuple(np.array([index]) for index in cell))
    mask = partition.mask(blocks)
    if not mask.any():
        raise BadInput("no cell lies inside the boxes; enlarge them or give points", "attractor")
    return mask

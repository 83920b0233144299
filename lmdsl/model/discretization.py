"""The finite grids of a problem: sample offsets within a cell, control vectors, noise nodes."""

import math
from dataclasses import dataclass

import numpy as np

from lmdsl.common.types import Floats, Guard, Indices
from lmdsl.machine import memory
from lmdsl.problem.problem import Problem

NODE = 400  # bytes for each noise node: its values, its weight, and what orders them


def offsets(problem: Problem) -> Floats:
    """Return the sample offsets within a cell, shape (points, d), in [0, 1]."""
    states = problem.states
    memory.require(32 * len(states) * sample_points(problem), "sample points")
    return problem.sampling.offsets(states)


def sample_points(problem: Problem) -> int:
    """Return the number of sample points per cell without making them."""
    return problem.sampling.count(problem.states)


def control_values(problem: Problem) -> list[Floats]:
    """Return the values of every control."""
    axes = problem.control_grid.values()
    memory.require(16 * max((axis.count() for axis in axes), default=0), "controls")
    return [axis.vector() for axis in axes]


def control_vectors(problem: Problem) -> Floats:
    """Return the control vectors in C order, shape (M, p); (1, 0) for an autonomous system."""
    memory.require(24 * control_count(problem) * len(problem.control_grid), "control vectors")
    values = control_values(problem)
    if not values:
        return np.zeros((1, 0))
    return np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, len(values))


def control_count(problem: Problem) -> int:
    """Return M without making the control vectors."""
    return math.prod(axis.count() for axis in problem.control_grid.values())


def control_range(problem: Problem) -> tuple[Floats, Floats]:
    """Return the least and the largest value of every control without making the others."""
    ends = [axis.ends() for axis in problem.control_grid.values()]
    low, high = np.array(ends, dtype=float).reshape(-1, 2).T
    return low, high


@dataclass(frozen=True, eq=False)
class Nodes:
    """The noise nodes of a problem."""

    # shape (q, r): q nodes of r noise variables, C-order product; one node without noise
    values: Floats
    # shape (q,), > 0. Probabilities up to rounding: shares divide by their exact sum.
    weights: Floats
    group: Indices  # shape (q,): nodes of equal weight share a group, numbered by first appearance

    def exact_weights(self, guard: Guard | None = None) -> tuple[list[int], list[int]]:
        """Return the weights of the groups as whole numbers of a unit, and their sizes.

        The unit is the largest power of two for which they are whole numbers.
        """
        ratios: list[tuple[int, int]] = []
        for i in np.unique(self.group, return_index=True)[1].tolist():
            if guard is not None:
                guard()
            ratios.append(float(self.weights[i]).as_integer_ratio())
        unit = max(below for _, below in ratios)  # all are powers of two
        return [n * (unit // below) for n, below in ratios], np.bincount(self.group).tolist()

    def mean(self) -> Floats:
        """Return the mean of every noise variable, shape (r,)."""
        mean: Floats = self.weights @ self.values / self.weights.sum()
        return mean


def noise_nodes(problem: Problem) -> Nodes:
    """Return the noise nodes; nodes of zero weight are dropped."""
    memory.require(node_count(problem) * NODE, "noise nodes")
    if not problem.noise:
        return Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64))
    variables = []
    for noise in problem.noise.values():
        values, weights = noise.nodes()
        kept = weights > 0
        weights = weights[kept] / math.fsum(weights[kept])
        variables.append((values[kept], weights))
    grids = np.meshgrid(*(values for values, _ in variables), indexing="ij", copy=False)
    weights = np.ones(1)
    for _, each in variables:  # in the order of the variables, as rounding depends on it
        weights = np.multiply.outer(weights, each).reshape(-1)
    kept = weights > 0
    values = np.stack([grid.reshape(-1)[kept] for grid in grids], axis=-1)
    weights = weights[kept]
    _, first, found = np.unique(weights, return_index=True, return_inverse=True)
    number = np.empty(len(first), dtype=np.int64)
    number[np.argsort(first)] = np.arange(len(first))
    return Nodes(values, weights, number[found])


def noise_parts(problem: Problem) -> tuple[Floats, Floats]:
    """Return the boxes of noise that enclosures cover: their ends, shapes (q, r)."""
    memory.require(node_count(problem) * NODE, "noise nodes")
    parts = [noise.parts() for noise in (problem.noise or {}).values()]
    if not parts:
        return np.zeros((1, 0)), np.zeros((1, 0))
    grids = (np.meshgrid(*ends, indexing="ij") for ends in zip(*parts, strict=True))
    low, high = (np.stack(grid, axis=-1).reshape(-1, len(parts)) for grid in grids)
    return low, high


def node_count(problem: Problem) -> int:
    """Return an upper bound of the number of noise nodes without making them."""
    return math.prod(noise.count() for noise in (problem.noise or {}).values())

"""The finite grids of a problem: sample offsets within a cell, control vectors, noise nodes."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from lmdsl.problem import ControlValues, Grid, NoiseNormal, Problem, Random

Floats = NDArray[np.float64]


def offsets(problem: Problem) -> Floats:
    """Return the sample offsets within a cell, shape (points, d), in [0, 1)."""
    d = len(problem.state_box)
    sampling = problem.sampling
    if isinstance(sampling, Grid):
        k = sampling.per_axis
        axis = (np.arange(k) + 0.5) / k
        return np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
    if isinstance(sampling, Random):
        return np.random.default_rng(sampling.seed).random((sampling.points, d))
    from scipy.stats import qmc

    with warnings.catch_warnings():
        # Balance wants a power of two; any number of points is a valid sample.
        warnings.simplefilter("ignore", UserWarning)
        points: Floats = qmc.Sobol(d, scramble=True, seed=sampling.seed).random(sampling.points)
    return points


def sample_points(problem: Problem) -> int:
    """Return the number of sample points per cell without making them."""
    sampling = problem.sampling
    if isinstance(sampling, Grid):
        return int(sampling.per_axis ** len(problem.state_box))
    return int(sampling.points)


def control_values(problem: Problem) -> list[Floats]:
    """Return the values of every control."""
    return [
        np.array(axis.values)
        if isinstance(axis, ControlValues)
        else np.linspace(axis.low, axis.high, axis.points)
        for axis in problem.control_grid.values()
    ]


def control_vectors(problem: Problem) -> Floats:
    """Return the control vectors in C order, shape (M, p); (1, 0) for an autonomous system."""
    values = control_values(problem)
    if not values:
        return np.zeros((1, 0))
    return np.stack(np.meshgrid(*values, indexing="ij"), axis=-1).reshape(-1, len(values))


def control_count(problem: Problem) -> int:
    """Return M without making the control vectors."""
    return math.prod(
        len(axis.values) if isinstance(axis, ControlValues) else axis.points
        for axis in problem.control_grid.values()
    )


@dataclass(frozen=True, eq=False)
class Nodes:
    """The noise nodes of a problem.

    Attributes
    ----------
    values
        Shape (q, r): q nodes of r noise variables, C-order product; one node without noise.
    weights
        Shape (q,), > 0. Probabilities up to rounding: shares divide by their exact sum.
    group
        Shape (q,): nodes of equal weight share a group, numbered by first appearance.
    """

    values: Floats
    weights: Floats
    group: NDArray[np.int64]

    def group_weights(self) -> list[float]:
        """Return the weight of each group."""
        first = np.unique(self.group, return_index=True)[1]
        return [float(self.weights[i]) for i in first]

    def exact_total(self) -> Fraction:
        """Return the exact sum of the weights."""
        return sum((Fraction(float(w)) for w in self.weights), Fraction(0))


def noise_nodes(problem: Problem) -> Nodes:
    """Return the noise nodes; nodes of zero weight are dropped."""
    if not problem.noise:
        return Nodes(np.zeros((1, 0)), np.ones(1), np.zeros(1, dtype=np.int64))
    variables = []
    for noise in problem.noise.values():
        if isinstance(noise, NoiseNormal):
            x, w = np.polynomial.hermite.hermgauss(noise.normal.points)
            values, weights = math.sqrt(2) * noise.normal.std * x, w
        else:
            values, weights = np.array(noise.values), np.array(noise.weights)
        kept = weights > 0
        weights = weights[kept] / math.fsum(weights[kept])
        variables.append((values[kept], weights))
    products = list(itertools.product(*(range(len(values)) for values, _ in variables)))
    values = np.array(
        [[variables[k][0][i] for k, i in enumerate(index)] for index in products], dtype=float
    )
    weights = np.array(
        [math.prod(variables[k][1][i] for k, i in enumerate(index)) for index in products]
    )
    kept = weights > 0
    values, weights = values[kept], weights[kept]
    numbers: dict[float, int] = {}
    group = np.array([numbers.setdefault(float(w), len(numbers)) for w in weights], dtype=np.int64)
    return Nodes(values, weights, group)


def node_count(problem: Problem) -> int:
    """Return an upper bound of the number of noise nodes without making them."""
    return math.prod(
        noise.normal.points if isinstance(noise, NoiseNormal) else len(noise.values)
        for noise in (problem.noise or {}).values()
    )

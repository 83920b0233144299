"""Controls, noise nodes, and sample points."""

import itertools
import math
import warnings
from typing import Any

import numpy as np
from scipy.stats import qmc

from reference.grid import Axis


def control_vectors(problem: dict[str, Any]) -> list[tuple[float, ...]]:
    """Every control vector in C order; the empty tuple alone for an autonomous system."""
    lists = []
    for grid in problem["control_grid"].values():
        if "values" in grid:
            lists.append([float(v) for v in grid["values"]])
        else:
            lists.append([float(v) for v in np.linspace(grid["low"], grid["high"], grid["points"])])
    return list(itertools.product(*lists))


def noise_nodes(problem: dict[str, Any]) -> list[tuple[tuple[float, ...], float]]:
    """(values, weight) of every joint noise node in C order; one empty node without noise."""
    per_variable = []
    for spec in problem.get("noise", {}).values():
        if "normal" in spec:
            x, w = np.polynomial.hermite.hermgauss(spec["normal"]["points"])
            values = [math.sqrt(2.0) * spec["normal"]["std"] * float(v) for v in x]
            weights = [float(v) for v in w]
        elif "uniform" in spec:
            low, high, k = (spec["uniform"][key] for key in ("low", "high", "points"))
            values = [low + (i + 0.5) / k * (high - low) for i in range(k)]
            weights = [1.0 / k] * k
        else:
            values = [float(v) for v in spec["values"]]
            weights = [float(v) for v in spec["weights"]]
        total = math.fsum(weights)
        nodes = [(v, w / total) for v, w in zip(values, weights, strict=True) if w > 0]
        per_variable.append(nodes)
    joint = []
    for combination in itertools.product(*per_variable):
        weight = 1.0
        for _, w in combination:
            weight *= w
        joint.append((tuple(v for v, _ in combination), weight))
    return joint


def sample_offsets(problem: dict[str, Any]) -> list[tuple[float, ...]]:
    """Offsets of the sample points, in cell widths, the same in every cell."""
    axes = list(problem["state_box"])
    sampling = problem["sampling"]
    seed = sampling.get("seed", 0)
    if sampling["kind"] == "grid":
        k = sampling["per_axis"]
        each = [k[name] if isinstance(k, dict) else k for name in axes]
        points = list(itertools.product(*([(i + 0.5) / n for i in range(n)] for n in each)))
    elif sampling["kind"] == "random":
        points = np.random.default_rng(seed).random((sampling["points"], len(axes))).tolist()
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SciPy warns unless the number is a power of two
            drawn = qmc.Sobol(len(axes), scramble=True, seed=seed).random(sampling["points"])
        points = drawn.tolist()
    if sampling.get("corners", False):
        points += list(itertools.product([0.0, 1.0], repeat=len(axes)))
    return [tuple(float(v) for v in point) for point in points]


def sample_of(axis: Axis, index: int, offset: float) -> float:
    """Coordinate of a sample point; the upper corner of the last cell is the end of the axis."""
    if offset == 1 and index == axis.cells - 1:
        return axis.high
    return axis.low + (index + offset) * axis.width

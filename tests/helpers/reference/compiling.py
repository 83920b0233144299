"""From a problem to its finite model: every pair is sampled."""

import math
from fractions import Fraction
from typing import Any

from reference.formulas import value_of
from reference.grid import number_of_cells, read_axes, unflat
from reference.holding import asks_to_hold, held_cells
from reference.model import Pair, ReferenceModel, Row
from reference.reaching import classify
from reference.samples import control_vectors, noise_nodes, sample_of, sample_offsets
from reference.sets import attractor_cells, avoid_cells
from reference.steps import step_function


def compile_reference(problem: dict[str, Any]) -> ReferenceModel:
    """Sample every pair outside A and Z, sort its samples into cells, and find C and the causes."""
    axes = read_axes(problem)
    controls = control_vectors(problem)
    offsets = sample_offsets(problem)
    noise = noise_nodes(problem)
    A, Z = attractor_cells(problem), avoid_cells(problem)
    if A & Z or not (A or ("discount" in problem and not problem["attractor"])):
        raise ValueError("no attractor cell, or a cell that is both attractor and avoid")
    hold = None
    if asks_to_hold(problem):
        hold = held_cells(problem, axes, (offsets, controls, noise), A, Z)
        A = A if problem["local_controller"].get("partial") else set(hold)
    step = step_function(problem, axes, A, Z)
    admissible = value_of(problem, problem.get("admissible", "0 == 0"))
    N = number_of_cells(axes)

    model = ReferenceModel(
        problem=problem,
        axes=axes,
        controls=controls,
        N=N,
        M=len(controls),
        S=len(offsets) * len(noise),
        points=len(offsets),
        noise=noise,
        attractor=A,
        avoid=Z,
        counts={},
        rows={},
        admissible=set(),
        cost={},
        discount=Fraction(float(problem.get("discount", 1))),
        hold=hold,
    )
    for cell in range(N):
        if cell in A or cell in Z:
            continue
        corner = unflat(axes, cell)
        samples = [
            [sample_of(a, i, o) for a, i, o in zip(axes, corner, offset, strict=True)]
            for offset in offsets
        ]
        for number, control in enumerate(controls):
            pair = (cell, number)
            count: dict[int | str, list[int]] = {}
            costs = []
            for x in samples:
                for node, (w, _) in enumerate(noise):
                    names = _names(problem, x, control, w)
                    key, cost = step(names)
                    key = key if admissible(names) else "escaped"
                    count.setdefault(key, [0] * len(noise))[node] += 1
                    costs.append(cost)
            model.counts[pair] = count
            row = _shares(count, [w for _, w in noise], len(offsets))
            model.rows[pair] = _discounted(row, model.discount)
            if "escaped" not in count:
                model.admissible.add(pair)
                model.cost[pair] = _mean_cost(model, pair, costs)
    classify(model)
    return model


def _names(problem: dict, x: list[float], u: tuple, w: tuple) -> dict[str, float]:
    """Put the values of states, controls and noise variables beside their names."""
    names = dict(zip(problem["state_box"], x, strict=True))
    names.update(zip(problem["control_grid"], u, strict=True))
    names.update(zip(problem.get("noise", {}), w, strict=True))
    return names


def _shares(count: dict, weights: list[float], points: int) -> Row:
    """Turn counts per noise node into exact shares of the whole weight."""
    exact = [Fraction(w) for w in weights]
    whole = points * sum(exact)
    share = {}
    for key, numbers in count.items():
        share[key] = sum(n * w for n, w in zip(numbers, exact, strict=True)) / whole
    absorbed = share.pop("absorbed", Fraction(0))
    escaped = share.pop("escaped", Fraction(0))
    return share, absorbed, escaped


def _discounted(row: Row, b: Fraction) -> Row:
    targets, absorbed, escaped = row
    return {t: b * share for t, share in targets.items()}, b * absorbed, b * escaped


def _mean_cost(model: ReferenceModel, pair: Pair, costs: list[float]) -> float:
    """Weighted mean of the costs of the samples, by sample point, then noise node."""
    for g in costs:
        if not (math.isfinite(g) and g >= 0):
            raise ValueError(f"the cost is {g} at cell {pair[0]}, control {pair[1]}")
    weights = [weight for _, weight in model.noise]
    terms = [weight * g for weight, g in zip(weights * model.points, costs, strict=True)]
    return math.fsum(terms) / (model.points * math.fsum(weights))

"""What is proved also happens in 50-digit arithmetic, each image rounded to doubles."""

from __future__ import annotations

import functools
from decimal import Context, Decimal, localcontext

import numpy as np
import precise
import pytest
from named_systems import solved
from proved_points import ARRIVES, drawn

FIFTY = Context(prec=50)
PLAIN = {
    "+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b,
    "/": lambda a, b: a / b, "**": lambda a, b: a ** int(b), "negative": lambda a: -a,
    "sin": lambda a: precise.sin(a), "cos": lambda a: precise.cos(a),
}  # fmt: skip


@functools.cache
def proved(name):
    targets = {"logistic_map": 1.0, "henon_map": 0.95, "double_integrator": 0.99}
    return solved(name), solved(name).prove(targets.get(name, 0.3))


def image(program, values):
    """The formulas in 50-digit arithmetic, constants the doubles that they are."""
    slots = [None if x is None else Decimal(x) for x in program.template]
    for name, slot in program.variables.items():
        slots[slot] = Decimal(values[name])
    for operation, operands, target, *_ in program.instructions:
        slots[target] = PLAIN[operation](*(slots[k] for k in operands))
    return np.array([float(slots[k]) for k in program.outputs])


def follow(name, count):
    """Follow states of arriving boxes; return how many do not arrive within their level."""
    result, proof = proved(name)
    problem, partition = result.problem, result.partition
    x, box = drawn(proof, partition, 3 * count, np.random.default_rng(6))
    on = np.flatnonzero(proof.kind[box] == ARRIVES)[:count]
    program, late = problem.step(), 0
    for state, level in zip(x[on], proof.level[box[on]].tolist(), strict=True):
        for _ in range(level + 1):
            (state,), (cell,) = partition.enter(state[None])
            if cell < 0 or result.cell_status[cell] != 1:
                break
            u = result.control_vectors[result.control_index[cell]]
            values = dict(zip((*problem.states, *problem.controls), (*state, *u), strict=True))
            with localcontext(FIFTY):
                state = image(program, values)
        late += not (cell >= 0 and result.cell_status[cell] == 0)
    return late


MAPS = ["logistic_map", "henon_map", "double_integrator", "standard_map"]


@pytest.mark.parametrize("name", MAPS)
def test_arriving_states_arrive(name):
    assert follow(name, 100) == 0


@pytest.mark.long
@pytest.mark.parametrize("name", MAPS)
def test_ten_thousand_of_them_do(name):
    assert follow(name, 10_000) == 0

"""What is proved also happens in 50-digit arithmetic, each image rounded to doubles.

``PYTHONPATH=tests/helpers python tests/proof/test_precise_runs.py NAME [STATES]`` follows so many
states of boxes that arrive, and as many of boxes that are lost, of a named system.
"""

from __future__ import annotations

import functools
import sys
from decimal import Context, Decimal, localcontext

import numpy as np
import precise
import pytest
from named_systems import solved
from problems import made
from proved_points import ARRIVES, LOST

import lmdsl as lm
from lmdsl.proof import proving

FIFTY = Context(prec=50)
PLAIN = {
    "+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b,
    "/": lambda a, b: a / b, "**": lambda a, b: a ** int(b), "negative": lambda a: -a,
    "sin": lambda a: precise.sin(a), "cos": lambda a: precise.cos(a),
}  # fmt: skip
TARGETS = {"logistic_map": 1.0, "henon_map": 0.95, "double_integrator": 0.99}
EQUATIONS = {"van_der_pol": 32, "inverted_pendulum": 40, "pendulum_on_cart": 40}  # cells an axis
SLOPE = {
    "format": "lmdsl/1",
    "system": {"kind": "ode", "derivative": {"x": "sin(x)**20 - 0.6"}, "step": 0.5, "substeps": 2,
               "judged": "endpoint"},
    "state_box": {"x": {"low": 0, "high": 1.5, "cells": 8}},
    "attractor": {"cells": [[0]]},
    "control_grid": {},
    "stage_cost": "1",
    "sampling": {"kind": "grid", "per_axis": 1},
}  # fmt: skip


@functools.cache
def proved(name):
    """Judged at the ends of steps: between them nothing is followed here."""
    if name == "slope":
        result = lm.solve(made(SLOPE))
        return result, decided(result, 0.9)
    if name not in EQUATIONS:
        return solved(name), decided(solved(name), TARGETS.get(name, 0.3))
    data = lm.systems.NAMED[name].problem
    box = {k: {**axis, "cells": EQUATIONS[name]} for k, axis in data["state_box"].items()}
    system = {**data["system"], "judged": "endpoint"}
    result = lm.solve(made({**data, "state_box": box, "system": system}))
    return result, decided(result, 0.5)


def decided(result, target):
    """Prove, without closing in on the cost: of that nothing is asked here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proving, "GROWN", 0)
        patch.setattr(proving, "FEW", 0)
        patch.setattr(proving, "close", lambda arrays: True)
        return result.prove(target)


def evaluated(program, values):
    """The formulas in 50-digit arithmetic, constants the doubles that they are."""
    slots = [None if x is None else Decimal(x) for x in program.template]
    for name, slot in program.variables.items():
        slots[slot] = values[name]
    for operation, operands, target, *_ in program.instructions:
        slots[target] = PLAIN[operation](*(slots[k] for k in operands))
    return [slots[k] for k in program.outputs]


def image(problem, step, x, u):
    """The map, or the compiled Runge-Kutta step with its h/2 and h/6 the doubles that they are."""
    x, held = (
        [Decimal(v) for v in x],
        {k: Decimal(v) for k, v in zip(problem.controls, u, strict=True)},
    )

    def named(at):
        return dict(zip(problem.states, at, strict=True)) | held

    if problem.flow() is None:
        return np.array([float(v) for v in evaluated(step, named(x))])
    h, half, sixth = (Decimal(v) for v in (step.h, step.h / 2, step.h / 6))
    for _ in range(step.substeps):
        slopes, at = [], x
        for by in (half, half, h, None):
            slopes.append(evaluated(step.field, named(at)))
            at = [a + by * k for a, k in zip(x, slopes[-1], strict=True)] if by else at
        x = [a + sixth * (k + 2 * m + 2 * n + p) for a, k, m, n, p in zip(x, *slopes, strict=True)]
    return np.array([float(v) for v in x])


def drawn(proof, partition, kind, count):
    """Random states of boxes of a kind."""
    rng, boxes = np.random.default_rng(6), np.flatnonzero(proof.kind == kind)
    if not len(boxes):
        return np.zeros((0, partition.dimension)), boxes
    box = rng.choice(boxes, size=count)
    index = np.stack(partition.multi_index(proof.cell[box]), axis=-1)
    part = (proof.place[box] + rng.random((count, partition.dimension))) / 2.0 ** proof.split[box]
    return partition.low + (index + part) * partition.width, box


def follow(name, kind, count):
    """Follow states of boxes; return how many were, and how many do not end as is proved."""
    result, proof = proved(name)
    problem, partition = result.problem, result.partition
    x, box = drawn(proof, partition, kind, count)
    step, wrong = problem.step(), 0
    for state, level in zip(x, proof.level[box].tolist(), strict=True):
        for _ in range(level + 1):
            (state,), (cell,) = partition.enter(state[None])
            if cell < 0 or result.cell_status[cell] != 1:
                break
            u = result.control_vectors[result.control_index[cell]]
            with localcontext(FIFTY):
                state = image(problem, step, state, u)
        status = result.cell_status[cell] if cell >= 0 else None
        wrong += status in (0, 1) if kind == LOST else status != 0
    return len(x), wrong


MAPS = ["logistic_map", "henon_map", "double_integrator", "standard_map"]


@pytest.mark.parametrize("name", MAPS)
def test_arriving_states_arrive(name):
    assert follow(name, ARRIVES, 100) == (100, 0)


def test_lost_states_are_lost():
    assert follow("henon_map", LOST, 60) == (60, 0)


def test_states_of_an_equation_do_as_is_proved():
    """Below A, and beyond the point at which the sine wins, runs are lost."""
    assert follow("slope", ARRIVES, 50) == (50, 0)
    assert follow("slope", LOST, 50) == (50, 0)


@pytest.mark.long
@pytest.mark.full
@pytest.mark.parametrize("name", [*MAPS, *EQUATIONS])
def test_ten_thousand_of_them_do(name):
    assert follow(name, ARRIVES, 10_000) == (10_000, 0)
    assert follow(name, LOST, 10_000)[1] == 0


if __name__ == "__main__":
    wanted = int(sys.argv[2]) if len(sys.argv) > 2 else 10_000
    for kind, word in ((ARRIVES, "arrive"), (LOST, "are lost")):
        states, wrong = follow(sys.argv[1], kind, wanted)
        print(f"{sys.argv[1]}: {states} states of boxes that {word}, {wrong} do otherwise")

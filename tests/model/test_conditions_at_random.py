"""Random problems written otherwise: boxes as conditions, formulas by way of definitions."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from problems import made, steps
from random_problems import random_problem
from reference import compile_reference

import lmdsl as lm


def as_conditions(problem):
    """The same problem with a condition in the place of every box."""
    problem = copy.deepcopy(problem)
    for key in ("attractor", "avoid", "measure"):
        if boxes := problem.get(key, {}).pop("boxes", None):
            problem[key]["where"] = [
                " and ".join(f"{n} >= {a!r} and not {n} > {b!r}" for n, (a, b) in box.items())
                or "0 < 1"
                for box in boxes
            ]
    return problem


def by_definitions(problem, rng):
    """The same problem with parts of its formulas, or all of them, under names of their own."""
    problem = copy.deepcopy(problem)
    cost = problem["stage_cost"]
    problem["let"] = {"twice_": "2", "all_of_it": cost, "unused_": "all_of_it**twice_"}
    problem["stage_cost"] = "all_of_it"
    key = {"map": "next", "ode": "derivative"}.get(problem["system"]["kind"])
    if key:
        for k, (state, text) in enumerate(problem["system"][key].items()):
            if rng.random() < 0.7:
                problem["let"][f"f{k}_"] = text
                problem["system"][key][state] = f"f{k}_"
    return problem


@pytest.mark.parametrize("seed", range(25))
def test_written_otherwise_it_is_the_same_model(seed):
    rng = np.random.default_rng(seed)
    data = random_problem(np.random.default_rng(1000 + seed))
    expected = lm.compile(made(data))
    assert lm.compile(made(as_conditions(data))).digest == expected.digest
    assert lm.compile(made(by_definitions(as_conditions(data), rng))).digest == expected.digest


@pytest.mark.parametrize("seed", range(12))
def test_the_reference_agrees_on_admissible_pairs(seed):
    rng = np.random.default_rng(seed)
    data = random_problem(np.random.default_rng(2000 + seed))
    state, axis = next(iter(data["state_box"].items()))
    place = axis["low"] + rng.random() * (axis["high"] - axis["low"])
    bound = f"{state} > place" + "".join(f" or {u} <= 0" for u in data["control_grid"])
    data |= {"let": {"place": repr(place)}, "admissible": bound}
    model, lp = compile_reference(data), lm.compile(made(data))
    assert lp.cell_status.tolist() == model.cell_status
    pairs = zip(lp.cells[lp.cell].tolist(), lp.control.tolist(), strict=True)
    assert sorted(pairs) == sorted(model.surviving)


def test_definitions_stand_in_every_formula():
    ode = {"kind": "ode", "derivative": {"x": "push"}, "step": 0.5, "parameters": {"k": 2}}
    let = {"push": "-(k - 1)*u", "rate": "1 + x*x", "end_": "x + k"}
    base = steps(system=ode, sampling={"kind": "grid", "per_axis": 3})
    del base["stage_cost"]
    short = made({**base, "let": let, "cost_rate": "rate", "terminal_cost": "end_"})
    ode = {**ode, "derivative": {"x": "-(k - 1)*u"}}
    long = made({**base, "system": ode, "cost_rate": "1 + x*x", "terminal_cost": "x + k"})
    assert lm.compile(short).digest == lm.compile(long).digest
    with pytest.raises(lm.BadInput, match="terminal_cost: character 1: 'push' depends on u"):
        made({**base, "let": let, "cost_rate": "rate", "terminal_cost": "push"})


def test_paths_and_admissible_pairs_together():
    """The condition is judged at the sample, whatever the path meets."""
    ode = {"kind": "ode", "derivative": {"x": "-u"}, "step": 0.25}
    plain = lm.compile(made(steps(system=ode)))
    assert lm.compile(made(steps(system=ode, admissible="x < 9"))).digest == plain.digest
    none = lm.compile(made(steps(system=ode, admissible="u < 1")))
    assert none.n == 0
    some = lm.compile(made(steps(system=ode, admissible="u < 1 or x < 0.7")))
    assert some.cells.tolist() == [1, 2]

"""Arithmetic line by line: the bits of NumPy, whatever the formulas, axes and shapes."""

import numpy as np
import pytest
from problems import made, standard_map
from random_problems import random_problem

import lmdsl as lm
from lmdsl.formulas.language import parse
from lmdsl.formulas.program import Program
from lmdsl.model.assembly import lines, sampler, tape
from lmdsl.model.assembly.lines import Lines
from lmdsl.model.assembly.sampler import Sampler
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import CellSets


def sampled(problem):
    partition = Partition.of(problem)
    return Sampler(problem, partition), CellSets.of(problem, partition).free


def agree(found, expected):
    """Equal bit for bit, NaN for NaN, an axis of length 1 standing for all."""
    return all(
        np.array_equal(*np.broadcast_arrays(a, b), equal_nan=True)
        for a, b in zip(found, expected, strict=True)
    )


def compared(problem, blocks=3):
    """Whether images and costs are made line by line; every block must agree with NumPy's."""
    drawn, free = sampled(problem)
    for _, block in zip(range(blocks), drawn.blocks(free), strict=False):
        values = drawn.values(block)
        expected = drawn.images(block, values), drawn.costs(block, values)
        assert agree(drawn.outcomes(block), expected)
    images, costs = drawn._images, drawn._costs
    return (
        images is not None and max(images.varying[: len(problem.states)]) >= 0,
        costs is not None and costs.varying[-1] >= 0,
    )


@pytest.mark.long
def test_random_problems(monkeypatch):
    """Maps and differential equations, noise, clipping, one to three axes, one or two controls."""
    rng, seen = np.random.default_rng(20), set()
    monkeypatch.setattr(lines, "LEAST", 1)
    monkeypatch.setattr(sampler, "LEAST_LINE", 1)
    for turn in range(80):
        monkeypatch.setattr(lines, "LINE", (512, 7)[turn % 2])
        monkeypatch.setattr(sampler, "CHUNK", (2**17, 300)[turn // 2 % 2])  # both orientations
        seen.add(compared(lm.Problem.model_validate(random_problem(rng))))
    assert len(seen) == 4  # images and costs, each made either way


@pytest.mark.parametrize("name", ["van_der_pol", "lorenz"])
def test_polynomial_fields_are_stepped_line_by_line(name):
    problem = at_endpoints(lm.systems.NAMED[name].problem)
    assert compared(problem)[0]


def test_a_model_is_the_same_either_way(monkeypatch):
    problem = at_endpoints(lm.systems.NAMED["van_der_pol"].problem)
    digest = lm.compile(problem).digest
    monkeypatch.setattr(lines, "MOST", 0)
    assert not compared(problem)[0]
    assert lm.compile(problem).digest == digest


def at_endpoints(data):
    """The problem of a named system with steps judged where they end: only these go by lines."""
    kind = lm.systems.NAMED[data["system"]["kind"]]
    judged = {"judged": "endpoint"} if "judged" in kind.model_fields else {}
    if judged:  # as many as the system takes unasked: few enough to be written out
        judged["substeps"] = kind.model_fields["substeps"].default
    return lm.Problem.model_validate({**data, "system": {**data["system"], **judged}})


def with_step(text, cost="2 + x*u", **more):
    data = {
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": {"low": -1, "high": 1, "cells": 40}},
        "attractor": {"points": [{"x": 0}]},
        "control_grid": {"u": {"low": -1, "high": 1, "points": 9}},
        "stage_cost": cost,
        "sampling": {"kind": "random", "points": 6, "seed": 0},
        **more,
    }
    return made(data)


def test_all_plain_operations_and_what_is_not_finite(monkeypatch):
    monkeypatch.setattr(lines, "LEAST", 1)
    text = "-sqrt(x+u) / floor(3*x*u) + abs(u-x)**2 - ceil(x/u) * (x*u - 0.25)"
    assert compared(with_step(text, on_exit="clip")) == (True, True)
    assert compared(with_step(text, cost="x*u")) == (True, True)  # negative: NaN
    assert compared(with_step(text, cost="1/(x*u)**2 + x*u")) == (True, True)
    assert compared(with_step("x*u", cost="2 + x")) == (True, False)  # a small cost
    assert compared(with_step("0.5*x", cost="1 + x*u")) == (False, True)


@pytest.mark.parametrize("text", ["sin(x*u)", "min(x, u)", "where(x < u, x, u)", "(x*u)**3"])
def test_what_is_not_correctly_rounded_is_left_to_numpy(text, monkeypatch):
    monkeypatch.setattr(lines, "LEAST", 1)
    assert Lines.of(Program([parse(text, {"x", "u"})]), ["u"]) is None
    assert compared(with_step(text)) == (False, True)


def test_short_lines_are_left_to_numpy(monkeypatch):
    problem = at_endpoints(lm.systems.NAMED["lorenz"].problem)
    drawn, free = sampled(problem)
    assert drawn._images is not None
    monkeypatch.setattr(lines, "run", None)  # what is not called may be missing
    block = next(drawn.blocks(free[:20]))
    assert block.shape[1] < sampler.LEAST_LINE
    drawn.outcomes(block)
    with pytest.raises(TypeError):
        drawn.outcomes(next(drawn.blocks(free[:200])))


def test_what_no_result_needs_is_not_computed():
    """Written out, Runge-Kutta steps states that no right-hand side reads: never freed."""
    data = dict(lm.systems.NAMED["double_integrator"].problem)
    data["system"] = {"kind": "ode", "derivative": {"x": "v", "v": "sin(v*u)"}, "step": 0.1}
    data["state_box"] = dict(zip("xv", data["state_box"].values(), strict=True))
    data["attractor"], data["stage_cost"] = {"points": [{"x": 0, "v": 0}]}, "1"
    problem = lm.Problem.model_validate(data)
    program = sampled(problem)[0].step.func  # a partial call, with the deadline
    read = {k for step in program.instructions for k in step.operands} | set(program.outputs)
    assert all(step.target in read for step in program.instructions)
    assert len(program.instructions) < len(program.operations)


def test_few_operations_are_left_to_numpy():
    assert compared(made(standard_map(20))) == (False, False)


def test_small_images_are_located_once(monkeypatch):
    """One axis does not depend on the control, and one is an angle."""
    monkeypatch.setattr(lines, "LEAST", 1)
    data = standard_map(20)
    data["system"] = {"kind": "map", "next": {"x": "x + 0.3*sin(6*y)", "y": "y + u*x + 7*u"}}
    problem = made(data)
    assert compared(problem) == (True, True)
    drawn, _ = sampled(problem)
    assert drawn._images.varying[0] == -1
    assert drawn._images.varying[1] >= 0


def test_the_kernel_against_a_plain_reference():
    """Random tapes on random inputs of every shape that broadcasts."""
    rng = np.random.default_rng(3)
    plain = [np.add, np.subtract, np.multiply, np.divide, np.negative, np.absolute, np.sqrt]
    plain += [np.floor, np.ceil]
    for _ in range(40):
        shape = (*(int(k) for k in rng.integers(1, 5, 3)), int(rng.integers(1, 1200)))
        arrays = [
            rng.normal(size=tuple(k if rng.random() < 0.6 else 1 for k in shape)) for _ in range(3)
        ]
        rows, steps = [*(np.broadcast_to(a, shape) for a in arrays), np.full(shape, 0.7)], []
        for _ in range(12):
            code, a, b = (int(k) for k in rng.integers(0, (9, len(rows), len(rows))))
            steps.append((code, a, b, len(rows)))
            with np.errstate(all="ignore"):
                rows.append(plain[code](rows[a], rows[b]) if code < 4 else plain[code](rows[a]))
        cost, weights = np.abs(rows[-1]), rng.random(shape[2])
        mean = np.zeros((shape[0], shape[3]))
        steps.append((tape.ABS, len(rows) - 1, len(rows) - 1, len(rows)))
        tape.run(
            int(rng.choice([512, 7])),
            tape.Tape(np.array(steps), np.array([0.7]), 3, len(rows) + 1),
            tape.Inputs.of(arrays), shape,
            tape.Located(np.empty(0, dtype=np.int64), np.empty((0, 6)), False),
            np.empty((0, 0, 0)), len(rows), weights, mean,
        )  # fmt: skip
        with np.errstate(all="ignore"):
            expected = np.einsum("ipqj,q->ij", cost, weights) / (shape[1] * weights.sum())
        expected[~np.isfinite(expected)] = np.nan
        np.testing.assert_allclose(mean, expected, rtol=1e-12)


def test_rows_are_used_again_but_never_that_of_an_operand():
    text = "+".join(f"(x*u*{k}-x)/(u-{k + 2})" for k in range(30))
    tape = Lines.of(Program([parse(text, {"x", "u"})]), ["u"]).tape
    assert tape.rows - tape.steps[0, 3] <= 4 < len(tape.steps) / 20
    assert all(result not in (a, b) for _, a, b, result in tape.steps.tolist())


@pytest.mark.parametrize("name", sorted(lm.systems.NAMED))
def test_a_step_written_out_has_the_same_bits(name):
    """Runge-Kutta as one program against Runge-Kutta as it is written."""
    problem = at_endpoints(lm.systems.NAMED[name].problem)
    drawn, free = sampled(problem)
    values = drawn.values(next(drawn.blocks(free[:50])))
    written, step = drawn.step(values), problem.step()(values)
    assert agree(written, step)
    assert agree(Program(problem.step().formulas, problem.system.constants())(values), step)


def test_long_steps_are_not_written_out():
    data = dict(lm.systems.NAMED["van_der_pol"].problem)
    data["system"] = {**data["system"], "substeps": 1000, "judged": "endpoint"}
    step = lm.Problem.model_validate(data).step()
    assert step.formulas is None
    assert sampled(lm.Problem.model_validate(data))[0]._images is None


def test_formulas_that_repeat_themselves_are_not_written_out():
    """Few operations, as equal ones are done once, but as many nodes as a file may have."""
    data = dict(lm.systems.NAMED["double_integrator"].problem)
    long = "x*v + u"
    for _ in range(6):
        long = f"({long})*({long})"
    data["system"] = {
        "kind": "ode",
        "derivative": {"x": long, "v": long},
        "step": 0.1,
        "substeps": 5,
        "judged": "endpoint",
    }
    data["state_box"] = {
        name: data["state_box"][k] for name, k in zip("xv", data["state_box"], strict=True)
    }
    data["attractor"] = {"points": [{"x": 0, "v": 0}]}
    data["stage_cost"] = "1"
    step = lm.Problem.model_validate(data).step()
    assert step.effort < 1_000
    assert step.formulas is None

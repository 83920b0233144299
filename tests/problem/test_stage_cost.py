"""Stage costs written as Python functions: the same model as formulas, and honest directories."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest
from problems import made, standard_map, steps
from saved_results import put, refused

import lmdsl as lm
from lmdsl.results.directory import reading
from lmdsl.systems import FunctionSystem

RNG = np.random.default_rng(0)
NOISE = {"w": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}}


def quadratic(x, y, u):
    return x**2 + y**2 + u**2


def with_cost(data, cost):
    return made(data).replaced(stage_cost=cost)


# The same model --------------------------------------------------------------------------------


def test_the_model_is_that_of_the_formula():
    formula = lm.compile(made(standard_map(12)))
    own = with_cost(standard_map(12), quadratic)
    assert lm.compile(own).digest == formula.digest
    assert lm.solve(own).verified


@pytest.mark.parametrize(("cost", "formula"), [
    (lambda: 1.0, "1"),
    (lambda x: 1 + x, "1 + x"),
    (lambda u: 1 + u, "1 + u"),
    (lambda w: 1 + w, "1 + w"),
    (lambda u, x: x + u, "x + u"),
    (lambda x, u, w, k: k + x * u + w, "2 + x*u + w"),
    (lambda **values: 1 + values["x"] + values["u"], "1 + x + u"),
    (lambda x, scale=3.0: scale * x, "3*x"),
])  # fmt: skip
@pytest.mark.parametrize("system", ["formula", "arrays", "singles"])
def test_a_cost_takes_what_it_names(cost, formula, system):
    plain = made(steps(noise=NOISE)).replaced(
        system=lm.systems.MapSystem(next={"x": "x - 0.25*u"}, parameters={"k": 2.0}),
        stage_cost=formula,
    )
    own = plain.replaced(stage_cost=cost)
    if system != "formula":
        own = own.replaced(
            system=FunctionSystem(
                next=lambda x, u, w, k: [x - 0.25 * u + 0 * w], parameters={"k": 2.0},
                vectorized=system == "arrays",
            )
        )  # fmt: skip
    assert lm.compile(own).digest == lm.compile(plain).digest


def test_it_is_called_as_the_system_is():
    kinds = []

    def cost(x):
        kinds.append(type(x))
        return 1 + x

    lm.compile(with_cost(steps(), cost))
    assert set(kinds) == {np.ndarray}
    kinds.clear()
    single = FunctionSystem(next=lambda x, u: [x - 0.25 * u], vectorized=False)
    lm.compile(with_cost(steps(), cost).replaced(system=single))
    assert set(kinds) == {float}


# What is refused ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("cost", "words"), [
    (lambda v: 1, "takes 'v', which is none of x, u"),
    (lambda x: None, "real numbers are needed"),
    (lambda x: {"x": x}, "real numbers are needed"),
    (lambda x: x - 0.5, "finite and >= 0"),
    (lambda x: x / (x - x), "finite and >= 0"),
    (lambda x: x.ravel(), "the result has shape"),
    (lambda x: 1 if x > 0.5 else 2, "one sample at a time"),
    (lambda x: np.multiply(x, 2, out=x), "writes to its arguments"),
    (lambda x: np.cumsum(x, axis=-1), "must not depend on other samples"),
    (lambda x, rng=RNG: 1 + rng.random(x.shape), "same every time"),
])  # fmt: skip
def test_what_it_may_not_do(cost, words):
    with pytest.raises(lm.BadInput, match=rf"stage_cost: .*{words}"):
        lm.compile(with_cost({**steps(), "sampling": {"kind": "grid", "per_axis": 30}}, cost))


@pytest.mark.parametrize(("cost", "words"), [
    (lambda x: None, "the result is None for x = "),
    (lambda x: [x], "the result is"),
    (lambda x: x - 0.5, "finite and >= 0"),
])  # fmt: skip
def test_what_it_may_not_do_sample_by_sample(cost, words):
    single = FunctionSystem(next=lambda x, u: [x - 0.25 * u], vectorized=False)
    with pytest.raises(lm.BadInput, match=rf"stage_cost: .*{words}"):
        lm.compile(with_cost(steps(), cost).replaced(system=single))


def test_no_file_holds_it(tmp_path):
    own = with_cost(steps(), lambda x: 1 + x)
    with pytest.raises(lm.BadInput, match=r"stage_cost: .*cannot be written"):
        own.to_json()
    (tmp_path / "own.json").write_text(json.dumps({**steps(), "stage_cost": {"kind": "function"}}))
    with pytest.raises(lm.BadInput, match="stage_cost"):
        lm.load(tmp_path / "own.json")
    with pytest.raises(lm.BadInput, match="is no formula"):
        own.cost()
    with pytest.raises(lm.BadInput, match=r"stage_cost: 1\.0 is not accepted; write a string"):
        with_cost(steps(), 1.0)


# Directories -------------------------------------------------------------------------------------


@pytest.mark.parametrize("system", ["formula", "arrays", "singles"])
def test_a_saved_result_keeps_the_rows(tmp_path, system):
    own = with_cost(steps(), lambda x: 1 + x)
    if system != "formula":
        own = own.replaced(
            system=FunctionSystem(next=lambda x, u: [x - 0.25 * u], vectorized=system == "arrays")
        )
    result = lm.solve(own)
    result.save(tmp_path / "out")
    found = lm.verify(tmp_path / "out")
    assert found.holds, found.reasons
    assert "not re-evaluated" in found.notes[0].replace("were not", "not")
    assert "stage cost" in found.notes[0]
    assert lm.verify(tmp_path / "out", exact=True).holds
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.cost == result.cost
    if system == "formula":  # whose map is at hand
        runs = result.simulate(starts=20)
        assert runs.cost is not None
        assert loaded.simulate(starts=20) == replace(runs, cost=None)


@pytest.mark.parametrize("key", ["control_index", "value", "lower"])
def test_a_wrong_answer_is_refused(tmp_path, key):
    result = lm.solve(with_cost(steps(), lambda x, u: 1 + x + u))
    spoiled = np.array(getattr(result, key))
    spoiled[-1] = 0
    object.__setattr__(result, key, spoiled)
    result.save(tmp_path / "out")
    assert not lm.verify(tmp_path / "out").holds


@pytest.mark.parametrize("factor", [0.5, 2.0, -1.0, np.nan])
@pytest.mark.parametrize("system", ["formula", "arrays"])
def test_spoiled_costs_are_refused(tmp_path, system, factor):
    own = with_cost(steps(), lambda x, u: 1 + x + u)
    if system == "arrays":
        own = own.replaced(system=FunctionSystem(next=lambda x, u: [x - 0.25 * u]))
    lm.solve(own).save(tmp_path / "out")
    with np.load(tmp_path / "out/model.npz") as held:
        rows = dict(held)
    rows["cost"] = rows["cost"] * factor
    put(tmp_path / "out", model=rows)
    assert refused(tmp_path / "out")


@pytest.mark.parametrize("change", [
    {"gamma": 0.5}, {"sampling": {"kind": "grid", "per_axis": 3}}, {"attractor": {"cells": [[1]]}},
    {"system": {"kind": "map", "next": {"x": "x - 0.5*u"}}}, {"stage_cost": "1 + x + u"},
])  # fmt: skip
def test_costs_of_a_function_belong_to_one_problem(tmp_path, change):
    lm.solve(with_cost(steps(), lambda x, u: 1 + x + u)).save(tmp_path / "out")
    problem = json.loads((tmp_path / "out/problem.json").read_text())
    content = reading.text({**problem, **change})
    (tmp_path / "out/problem.json").write_bytes(content)
    stored = json.loads((tmp_path / "out/certificate.json").read_text())
    stored["files"]["problem.json"] = hashlib.sha256(content).hexdigest()
    put(tmp_path / "out", stored)
    assert refused(tmp_path / "out") == ("stage_cost" not in change)

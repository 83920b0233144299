"""Nothing a result directory says is believed: every field and array is spoiled in turn."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from dataclasses import fields, replace

import numpy as np
import pytest
from corners import corner
from problems import doubling, made, standard_map, steps
from saved_results import put, refused

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.results.directory import functions, reading
from lmdsl.results.directory.certificate_file import CertificateFile
from lmdsl.results.summary import Summary
from lmdsl.systems import FunctionSystem

# Keys of certificate.json that say history, options, text; of the digest a difference is said.
NOT_CLAIMED = (
    "backend", "solver_status", "tolerance", "polish_steps", "iterations", "gap_before_polish",
    "seconds", "versions", "message", "model_sha256", "digest",
)  # fmt: skip

ORBIT = [[0.25, 0.5], [0.75, 0.5]]


def function():
    # The control is the one of least cost, and no other leads to the attractor.
    return made(steps(cost="1 + x", avoid={"boxes": [{"x": [0.75, 1]}]})).replaced(
        system=FunctionSystem(next=lambda x, u: (x - 0.25 * u,))
    )


CASES = {
    "policy": lambda: lm.solve(made(standard_map(8))),
    "local": lambda: lm.solve(
        made(standard_map(20, local_controller={"kind": "lqr", "orbit": ORBIT}))
    ),
    "refused": lambda: lm.solve(made(doubling(3.0))),
    "empty": lambda: lm.solve(made({**steps(), "control_grid": {"u": {"values": [0]}}})),
    "require_all": lambda: lm.solve(made(standard_map(8)), require_all=True),
    "restricted": lambda: lm.solve(made(corner(2.5)), restrict_to_gamma=True),
    "function": lambda: lm.solve(function()),
}


@pytest.fixture(scope="module", params=CASES)
def saved(request, tmp_path_factory):
    target = tmp_path_factory.mktemp("stored") / request.param
    CASES[request.param]().save(target)
    assert lm.verify(target).holds, lm.verify(target).reasons
    assert lm.verify(target, exact=True).holds
    return target


def others(value):
    """Other values of the same type, null, and a value where there was null."""
    if value is None:
        return [0.5, 0, [1.0, 2.0], "gamma", {}]
    if isinstance(value, bool):
        return [not value, None]
    if isinstance(value, int):
        return [value + 1, value - 1, None]
    if isinstance(value, float):
        return [value * 1.5 + 1e-6, value * 0.5 - 1e-6, -value - 1, None, 1e300]
    if isinstance(value, str):
        return [value + "x", ""]
    if isinstance(value, list):
        return [[], [*value, "x"], None]
    return [{}, None]


def places(data, path=()):
    """Every path of JSON data, and the value that stands there."""
    yield from ([(path, data)] if path else [])
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))
        else:
            yield (*path, key), value


def test_a_word_of_a_result_is_plain_text(tmp_path):
    result = lm.solve(made(doubling(3.0)))
    result.save(tmp_path / "out")
    for found in (result, lm.Result.load(tmp_path / "out")):
        assert (found.status, found.cause) == ("not_stabilizable", "gamma")
        assert f"{found.status} {found.cause!r}" == "not_stabilizable 'gamma'"
        assert repr(found).startswith("Result(status='not_stabilizable', backend=")
        assert type(found.to_dict()["status"]) is str


def test_what_a_certificate_says_is_what_a_result_holds():
    """A key of the report is saved and read again where the certificate names it, and it does."""
    apart = {"format", "claims", "measure_residual", "reasons", "versions", "scope", "proof"}
    held = {field.name for field in fields(lm.Result)} | {"beyond_gamma", "reward"}
    keys = {*CertificateFile.model_fields}
    assert keys - apart <= held
    assert {field.name for field in fields(Summary)} - {"simulation", "integration_error"} <= keys


# True statements that say less, and are accepted.
WEAKER = {"gamma_bar", "proved", "measure_residual"}


@pytest.mark.long
def test_every_field_of_the_certificate(saved):
    good = json.loads((saved / "certificate.json").read_text())
    tried = 0
    for path, value in places(good):
        if path[0] in NOT_CLAIMED:
            continue
        for other in others(value):
            if other == value and type(other) is type(value):
                continue
            spoiled = copy.deepcopy(good)
            at = spoiled
            for key in path[:-1]:
                at = at[key]
            at[path[-1]] = other
            (saved / "certificate.json").write_bytes(reading.text(spoiled))
            tried += 1
            if refused(saved):
                continue
            text = path[0] == "reasons" and good["status"] == "not_stabilizable"  # as message
            assert text or WEAKER & set(path), (path, value, other)
    for key in good:
        if key not in NOT_CLAIMED:
            less = {k: v for k, v in good.items() if k != key}
            (saved / "certificate.json").write_bytes(reading.text(less))
            # What earlier versions did not say may be missing.
            earlier = (
                "beyond_gamma",
                "local_controller",
                "scope",
                "coverage",
                "sure_cells",
                "data",
                "reward",
                "proof",
                "proved",
            )
            assert refused(saved) or key in earlier, key
    (saved / "certificate.json").write_bytes(reading.text(good))
    assert lm.verify(saved).holds
    assert tried > 50


@pytest.mark.long
def test_every_array(saved):
    good = json.loads((saved / "certificate.json").read_text())
    with np.load(saved / "solution.npz") as held:
        arrays_ = dict(held)
    weight = lm.Result.load(saved).weight
    for name, array in arrays_.items():
        for i in range(0, len(array), max(1, len(array) // 7)):
            for change in (lambda x: x + 1, lambda x: x - 1, lambda x: -x - 1):
                new = array.copy()
                with np.errstate(all="ignore"):
                    new[i] = change(new[i].astype(np.float64))
                if np.array_equal(new, array):
                    continue
                put(saved, copy.deepcopy(good), solution={**arrays_, name: new})
                if not refused(saved):
                    # A larger w, or a bound of a cell that no weight and no path touches.
                    assert name == "witness" or (weight[i] == 0 and name != "cell_status"), (
                        name,
                        i,
                    )
    put(saved, good, solution=arrays_)
    assert lm.verify(saved).holds


@pytest.mark.parametrize(
    ("bracket", "holds"),
    [([1e-5, 1e-4], False), ([2.0001, 3.0], False), ([1.0, 1.9999], False), ([1.0, 2.5], True),
     ([2.000003, 2.000004], False), ([1.999996, 1.999997], False),
     ([3.0, 2.0], False), ([-1.0, 3.0], False), ([0.0, "inf"], True), (None, False)],
)  # fmt: skip
def test_brackets_of_gamma_bar(tmp_path, bracket, holds):
    """The truth is 2."""
    lm.solve(made(doubling(2.5))).save(tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "certificate.json").read_text())
    low, high = stored["gamma_bar"]
    assert low <= 2 <= high
    put(tmp_path / "out", {**stored, "gamma_bar": bracket})
    found = lm.verify(tmp_path / "out")
    assert found.holds == holds
    assert holds or "gamma_bar" in found.reasons[0]


@pytest.mark.parametrize(
    "change",
    [{"cost": 1e-20}, {"cost": 0.0}, {"lower_bound": 5e-16}, {"measure_residual": -1e-12}],
)
@pytest.mark.parametrize("exact", [False, True])
def test_no_slack_is_large_beside_small_costs(tmp_path, change, exact):
    result = lm.solve(made(steps(cost="1e-20")))
    assert result.cost > 1e-20
    result.save(tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "certificate.json").read_text())
    put(tmp_path / "out", {**stored, **change})
    assert not lm.verify(tmp_path / "out", exact=exact).holds


@pytest.mark.parametrize(
    "change",
    [{"stage_cost": "2 + x"}, {"stage_cost": "0"}, {"attractor": {"cells": [[1]]}},
     {"avoid": {"boxes": [{"x": [0.5, 0.75]}]}}, {"gamma": 0.5}, {"avoid": None},
     {"control_grid": {"u": {"values": [0, 1, 2]}}},
     {"sampling": {"kind": "grid", "per_axis": 3}}],
)  # fmt: skip
def test_the_problem_of_a_function_is_compared(tmp_path, change):
    target = tmp_path / "out"
    lm.solve(function()).save(target)
    data = json.loads((target / "problem.json").read_text())
    data = {key: value for key, value in {**data, **change}.items() if value is not None}
    content = reading.text(data)
    (target / "problem.json").write_bytes(content)
    stored = json.loads((target / "certificate.json").read_text())
    stored["files"]["problem.json"] = hashlib.sha256(content).hexdigest()
    put(target, stored)
    assert refused(target)


@pytest.mark.parametrize(
    "change",
    [{"state_box": {"x": {"low": 0, "high": 1000, "cells": 4}}},
     {"state_box": {"y": {"low": 0, "high": 1, "cells": 4}}},
     {"state_box": {"x": {"low": 0, "high": 1, "cells": 4, "periodic": True}}},
     {"sampling": {"kind": "random", "points": 2}}, {"on_exit": "clip"},
     {"control_grid": {"thrust": {"values": [0, 1]}}},
     {"noise": {"w": {"values": [-5, 5], "weights": [0.5, 0.5]}}},
     {"noise": {"v": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}}},
     {"system": {"kind": "function", "parameters": {"a": 2.0}}}],
)  # fmt: skip
@pytest.mark.parametrize("digests", [True, False])
def test_rows_of_a_function_belong_to_one_problem(tmp_path, change, digests):
    """Neither set nor cost shows the difference: the rows were made from another problem."""
    target = tmp_path / "out"
    data = steps(noise={"w": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}})
    system = FunctionSystem(next=lambda x, u, w, a: (x - a * u + w,), parameters={"a": 0.25})
    lm.solve(made(data).replaced(system=system)).save(target)
    stored = json.loads((target / "certificate.json").read_text())
    problem = json.loads((target / "problem.json").read_text())
    for changed, holds in (({**problem, "name": "renamed"}, True), ({**problem, **change}, False)):
        content = reading.text(changed) if digests else json.dumps(changed).encode()
        (target / "problem.json").write_bytes(content)
        if digests:
            stored["files"]["problem.json"] = hashlib.sha256(content).hexdigest()
        put(target, stored)
        found = lm.verify(target)
        assert found.holds == holds, found.reasons
    assert "what the problem says" in found.reasons[0]


@pytest.mark.parametrize(
    "change",
    [{"proved": 4}, {"kept": 10**9}, {"kept": -1}, {"samples": -5}, {"cells": 99},
     {"kind": "linear"}],
)  # fmt: skip
def test_what_no_function_can_show_of_its_local_controller(tmp_path, change):
    problem = made(standard_map(8, local_controller={"kind": "constant"}))
    step = problem.step()

    def images(**values):
        return [np.asarray(image) for image in step(values)]

    lm.solve(problem.replaced(system=FunctionSystem(next=images))).save(tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "certificate.json").read_text())
    local = stored["local_controller"]
    assert local["proved"] is None
    for said, holds in ({}, True), (change, False):
        put(tmp_path / "out", {**stored, "local_controller": {**local, **said}})
        found = lm.verify(tmp_path / "out")
        assert found.holds == holds
        assert "what the local controller does was not checked" in found.notes
    put(tmp_path / "out", {**stored, "local_controller": None})
    assert not lm.verify(tmp_path / "out").holds


def test_what_cannot_be_checked_of_a_function_is_said(tmp_path):
    problem = made(corner(2.5))
    step = problem.step()

    def images(**values):
        shape = np.broadcast_shapes(*(np.shape(x) for x in values.values()))
        return [np.broadcast_to(image, shape) for image in step(values)]

    function = problem.replaced(system=FunctionSystem(next=images))
    lm.solve(function, restrict_to_gamma=True).save(tmp_path / "out")
    found = lm.verify(tmp_path / "out")
    assert found.holds
    assert "that gamma is infeasible from the cells left out was not checked" in found.notes


def test_a_function_saved_by_an_earlier_version_holds(tmp_path):
    result = lm.solve(function())
    result.save(tmp_path / "out")
    stored = json.loads((tmp_path / "out" / "certificate.json").read_text())
    put(tmp_path / "out", {**stored, "model_sha256": result.lp.digest})
    found = lm.verify(tmp_path / "out")
    assert (found.holds, found.same_model) == (True, True)


@pytest.mark.parametrize("discount", [None, 0.97])
def test_a_terminal_cost_of_a_function(tmp_path, discount):
    """It is paid at images that are not at hand: what can be known of the costs is checked."""
    problem = function().replaced(terminal_cost="2 + x", discount=discount)
    result, out = lm.solve(problem), tmp_path / "out"
    result.save(out)
    found = lm.verify(out)
    assert found.holds
    assert "the terminal cost was not checked" in found.notes[1]
    cost, entering = result.lp.cost, functions._entering(result.lp)
    assert 0 < entering.sum() < len(entering)
    for k in range(len(cost)):
        for more in (0.5, -3):
            changed = cost.copy()
            changed[k] += more
            text = str(functions.function_differences(replace(result.lp, cost=changed), result))
            unseen = entering[k] and more > 0
            assert ("is not the stage cost" in text) != unseen


@pytest.mark.parametrize("name", ["pair_pointer", "control", "pointer", "target", "code", "cost"])
def test_the_rows_of_a_function_are_those_of_the_digest(tmp_path, name):
    target = tmp_path / "out"
    lm.solve(function()).save(target)
    with np.load(target / "model.npz") as held:
        rows = dict(held)
    for i in range(len(rows[name])):
        changed = rows[name].copy()
        changed[i] = changed[i] + 1 if changed[i] == 0 else changed[i] - 1
        put(target, model={**rows, name: changed})
        assert refused(target), i
    put(target, model=rows)
    assert lm.verify(target).holds


def test_a_file_written_anew_is_judged_and_named(tmp_path):
    target = tmp_path / "out"
    lm.solve(made(steps())).save(target)
    with np.load(target / "solution.npz") as held:
        np.savez(target / "solution.npz", **held)
    found = lm.verify(target)
    assert found.holds
    assert "solution.npz was written anew" in found.notes[0]


@pytest.mark.long
@pytest.mark.parametrize("form", [[], ["--json"]])
def test_what_is_not_checked_is_said(tmp_path, capsys, form):
    lm.solve(made(steps())).save(tmp_path / "out")
    assert main(["simulate", str(tmp_path / "out"), "--starts", "5", *form]) == 0
    said = capsys.readouterr()
    assert "as stored, not re-checked" in (said.err if form else said.out)
    assert main(["plot", str(tmp_path / "out")]) == 0
    assert "as stored, not re-checked" in capsys.readouterr().out
    assert math.isfinite(lm.Result.load(tmp_path / "out").cost)

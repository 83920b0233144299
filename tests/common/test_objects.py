"""What users hold: equal by content, hashed, pickled, copied, read-only; checked when changed."""

from __future__ import annotations

import copy
import dataclasses
import importlib
import pickle
import pkgutil

import numpy as np
import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.common.records import Frozen
from lmdsl.errors import LmdslError, MissingDependency

NOISE = {"w": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}}
LOCAL = {"local_controller": {"kind": "constant", "control": {"u": 0}}}


def module_function(x, u):
    return {"x": x - 0.25 * u}


def everything():
    """One of every kind of object that the public functions return, made anew."""
    problem = made(steps(**LOCAL))
    lp = lm.compile(problem)
    result = dataclasses.replace(lm.solve(lp), seconds=None)
    noisy = lm.solve(made({**steps(noise=NOISE), "system": {
        "kind": "map", "next": {"x": "x - 0.25*u + w"}}}), "highs")  # fmt: skip
    function = problem.replaced(system=lm.systems.FunctionSystem(next=module_function))
    trapped = made(steps(avoid={"boxes": [{"x": [0.5, 0.75]}]}))
    explanation = lm.explain(trapped, phase_one=True)
    objects = [
        problem, *vars(problem).values(), made(standard_map()), lm.compile(function),
        lp, lp.rows, lp.rows.shares, lp.partition, result, result.certificate, result.controller,
        result.controller.local, result.local_controller, noisy.controller,
        result.simulate(starts=50, steps=20, hold=5), result.cost_from({"x": (0.25, 0.5)}),
        lm.solve(made(doubling(3.0))).certificate, lm.gamma_max(made(doubling())),
        lm.compare(lp, ["policy-iteration"]).agreement, explanation, explanation.phase_one,
        *explanation.causes, *explanation.hints, explanation.why(2), lm.backends.get("highs"),
        lm.backends.Options(start=lp.tree[1]), lm.backends.get("highs").capabilities,
        lm.gamma_max(made(doubling())).limiting,
    ]  # fmt: skip
    return [one for one in objects if dataclasses.is_dataclass(one) or hasattr(one, "model_dump")]


MADE = everything()
AGAIN = everything()
NAMED = pytest.mark.parametrize("k", range(len(MADE)), ids=lambda k: type(MADE[k]).__name__)


@NAMED
def test_equal_by_content(k):
    one, other = MADE[k], AGAIN[k]
    if isinstance(one, lm.backends.Options):
        return  # for a backend, during a solve
    assert (one == other) is True
    assert (one != other) is False
    assert hash(one) == hash(other)
    assert (one == 7) is False
    assert one is not None
    assert one in [other]
    assert len({one, other}) == 1
    repr(one)


@NAMED
@pytest.mark.parametrize("how", [lambda x: pickle.loads(pickle.dumps(x)), copy.copy, copy.deepcopy])
def test_pickled_and_copied(k, how):
    one = MADE[k]
    twin = how(one)
    assert type(twin) is type(one)
    if not isinstance(one, lm.backends.Options):
        assert twin == one
        assert hash(twin) == hash(one)
    for array in arrays(twin):
        assert isinstance(one, lm.backends.Options) or not array.flags.writeable


def arrays(one, depth=3):
    if isinstance(one, np.ndarray):
        yield one
    elif dataclasses.is_dataclass(one) and depth:
        for field in (field for field in dataclasses.fields(one) if field.compare):
            yield from arrays(getattr(one, field.name), depth - 1)
    elif isinstance(one, tuple):
        for part in one:
            yield from arrays(part, depth)


PRIVATE = {"Options", "Solution", "Transitions", "CellSets"}


@NAMED
def test_arrays_are_read_only(k):
    one = MADE[k]
    if type(one).__name__ in PRIVATE:
        return
    parts = [getattr(one, f.name) for f in dataclasses.fields(one)] if dataclasses.is_dataclass(
        one) else []  # fmt: skip
    for array in (a for part in parts if type(part).__name__ not in PRIVATE for a in arrays(part)):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_what_is_derived_is_read_only_too():
    result = lm.solve(made(steps()))
    for array in (result.weight, result.lp.cell, *result.lp.tree, result.closed_loop.status,
                  result.controller.index, lm.gamma_max(result.lp).policy):  # fmt: skip
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_what_the_arrays_of_a_model_are_views_of_is_read_only_too():
    lp = lm.solve(made(steps())).lp
    for field in dataclasses.fields(lp):
        for array in arrays(getattr(lp, field.name)):
            base = array.base
            while isinstance(base, np.ndarray):
                assert not base.flags.writeable, field.name
                base = base.base


def test_a_loaded_result_is_the_saved_one(tmp_path):
    result = lm.solve(made(steps()))
    result.save(tmp_path / "out")
    first, second = (lm.Result.load(tmp_path / "out") for _ in range(2))
    assert first == second
    assert hash(first) == hash(second)
    assert pickle.loads(pickle.dumps(first)) == first
    assert not first.value.flags.writeable
    assert first.problem == result.problem


def test_what_differs_is_not_equal():
    lp, result = lm.compile(made(steps())), lm.solve(made(steps()))
    assert lp != lm.compile(made(steps(cost="2")))
    assert lp != dataclasses.replace(lp, cost=lp.cost.astype(np.float32))
    assert result != dataclasses.replace(result, gap=0.5)
    assert result != dataclasses.replace(result, value=result.value + 1)
    assert result.controller != dataclasses.replace(
        result.controller, index=result.controller.index - 1
    )
    assert made(steps()) != made(steps(cost="2"))
    a = made(standard_map())
    b = a.replaced(state_box=dict(reversed(a.state_box.items())))
    assert a != b  # the same keys, but cells are numbered by the order of the axes


def test_not_a_number_equals_itself():
    lp = lm.compile(made(steps()))
    spoiled = [dataclasses.replace(lp, cost=np.full(lp.K, np.nan)) for _ in range(2)]
    assert spoiled[0] == spoiled[1]
    results = [dataclasses.replace(lm.solve(lp), gap=float("nan"), seconds=None) for _ in range(2)]
    assert results[0] == results[1]
    assert hash(results[0]) == hash(results[1])


def test_every_record_with_arrays_compares_without_asking_an_array():
    for found in pkgutil.walk_packages(lm.__path__, "lmdsl."):
        if "__main__" in found.name:
            continue
        module = importlib.import_module(found.name)
        for kind in vars(module).values():
            if not dataclasses.is_dataclass(kind) or not isinstance(kind, type):
                continue
            held = " ".join(str(field.type) for field in dataclasses.fields(kind))
            if any(word in held for word in ("NDArray", "Floats", "Policy", "Bools", "Indices")):
                own = kind.__eq__ in (Frozen.__eq__, object.__eq__)
                assert own, f"{kind.__name__}: == would compare arrays"


@pytest.mark.parametrize("error", [
    lm.BadInput("wrong", "gamma"), lm.BadInput("wrong"), MissingDependency("absent", "backend"),
    lm.LmdslError("odd"), lm.TimeLimitReached("compiling"),
])  # fmt: skip
def test_errors_travel_between_processes(error):
    for twin in (pickle.loads(pickle.dumps(error)), copy.copy(error), copy.deepcopy(error)):
        assert type(twin) is type(error)
        assert str(twin) == str(error)
        assert vars(twin) == vars(error)
        assert isinstance(twin, LmdslError)


def test_the_failure_of_the_contract_travels():
    from lmdsl.testing import Check, ContractFailure, Report

    failure = ContractFailure(Report("b", (Check("c", "", "failed", "Why."),)))
    twin = pickle.loads(pickle.dumps(failure))
    assert str(twin) == str(failure)
    assert twin.report == failure.report


# Changed copies ------------------------------------------------------------------------------


def test_changed_copies_are_checked():
    problem = made(steps())
    assert problem.replaced(gamma=0.5) == problem.model_copy(update={"gamma": 0.5})
    assert problem.model_copy() == problem.model_copy(deep=True) == problem
    for change in ({"gamma": -1}, {"gamma": float("nan")}, {"nonsense": 1}, {"stage_cost": "1/"}):
        for change_it in (problem.replaced, lambda **c: problem.model_copy(update=c)):
            with pytest.raises(lm.BadInput):
                change_it(**change)
    axis = problem.state_box["x"]
    assert axis.replaced(cells=8).cells == 8
    for wrong in (0, 2.5, "8"):
        with pytest.raises(lm.BadInput, match="cells"):
            axis.model_copy(update={"cells": wrong})


@pytest.mark.filterwarnings("ignore")
def test_ways_around_the_checks_are_refused():
    problem = made(steps())
    for around in (
        lambda: problem.copy(update={"gamma": -1}),
        lambda: lm.Problem.model_construct(gamma=-1),
        lambda: type(problem.state_box["x"]).model_construct(cells=0),
    ):
        with pytest.raises(lm.BadInput, match="check"):
            around()
    for write in (
        lambda: setattr(problem, "gamma", -1),
        lambda: setattr(problem, "nonsense", 1),
        lambda: delattr(problem, "gamma"),
    ):
        with pytest.raises(AttributeError, match=r"replaced\("):
            write()
    for write in (
        lambda: problem.state_box.update(y=1),
        lambda: problem.state_box.__setitem__("x", 1),
        lambda: problem.system.next.clear(),
    ):
        with pytest.raises(TypeError, match=r"replaced\("):
            write()
    assert problem == made(steps())


def test_text_is_read_as_strictly_as_a_file():
    text = made(steps()).to_json()
    assert lm.Problem.model_validate_json(text) == made(steps())
    assert lm.Problem.model_validate_json(text.encode()) == made(steps())
    for wrong in ("{", "[]", '{"gamma": NaN}', text.replace('"gamma"', '"name": "", "gamma"'),
                  text.replace('"name"', '"nonsense"'), b"\xff"):  # fmt: skip
        with pytest.raises(lm.BadInput):
            lm.Problem.model_validate_json(wrong)


# The caller's settings of NumPy --------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("mode", ["raise", "warn", "ignore"])
def test_the_callers_error_handling_changes_nothing(mode, tmp_path):
    problem = made(standard_map(12))
    small = made(steps(cost="1e-300*u + 1e-320", **LOCAL))
    expected = [lm.solve(p) for p in (problem, small)]
    before = np.geterr()
    with np.errstate(all=mode):
        during = np.geterr()
        for p, one in zip((problem, small), expected, strict=True):
            for backend in ("policy-iteration", "highs", "clarabel", "cvxpy"):
                result = lm.solve(p, backend)
                assert result.status == one.status
                assert result.cost == pytest.approx(one.cost, rel=1e-9)
            result.simulate(starts=20, steps=20, hold=5)
            result.controller(np.full((3, len(p.states)), 1e300))
            result.closed_loop.path([0.3] * len(p.states), 5)
            result.cost_from({})
            result.save(tmp_path / "out")
            assert lm.verify(tmp_path / "out").holds
            assert lm.verify(tmp_path / "out", exact=True).holds
            lm.gamma_max(p)
            lm.explain(p, phase_one=True).text()
            lm.compare(p, ["policy-iteration", "highs"]).table()
            lm.exports.export_certificate(result, tmp_path / "c.txt")
            lm.plotting.figure(result)
        assert np.geterr() == during
    assert np.geterr() == before

"""Backends that lie, break or crash: the answer is verified all the same, or honestly not."""

from __future__ import annotations

import numpy as np
import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.backends import Backend, Capabilities, Solution, Stop


def backend(function):
    return Backend("wrong", function, Capabilities())


def crash(lp, options):
    raise RuntimeError("kaboom\nwith lines")


class Panic(BaseException):
    pass


def panic(lp, options):
    raise Panic("thread panicked")


WRONG = {
    "crash": crash,
    "panic": panic,
    "nothing": lambda lp, o: None,
    "no stop": lambda lp, o: Solution("optimal", "optimal"),
    "empty": lambda lp, o: Solution(Stop.OPTIMAL, "optimal"),
    "NaN value": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", np.full(lp.n, np.nan)),
    "negative value": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", np.full(lp.n, -1e9)),
    "zero value": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", np.zeros(lp.n)),
    "short value": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", np.zeros(lp.n - 1)),
    "strings": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", ["a"] * lp.n),
    "random theta": lambda lp, o: Solution(
        Stop.OPTIMAL, "optimal", None, np.random.default_rng(0).random(lp.K)
    ),
    "interior theta": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", None, np.full(lp.K, 1e-9)),
    "first control": lambda lp, o: Solution(
        Stop.OPTIMAL, "optimal", policy=lp.pair_pointer[:-1].copy()
    ),
    "foreign column": lambda lp, o: Solution(
        Stop.OPTIMAL, "optimal", policy=np.zeros(lp.n, dtype=np.int64)
    ),
    "float policy": lambda lp, o: Solution(Stop.OPTIMAL, "optimal", policy=np.zeros(lp.n)),
    "says infeasible": lambda lp, o: Solution(Stop.INFEASIBLE, "infeasible"),
    "says unbounded": lambda lp, o: Solution(Stop.UNBOUNDED, "unbounded"),
}


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("problem", [standard_map(10), steps(1.1, cost="u"), steps(0.9)])
def test_a_wrong_backend_is_polished_into_the_truth(name, problem):
    result = lm.solve(made(problem), backend(WRONG[name]))
    truth = lm.solve(made(problem))
    assert result.status == truth.status == "verified", result.message
    np.testing.assert_array_equal(result.control_index, truth.control_index)
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    assert "\n" not in result.message


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_backend_cannot_make_the_impossible_verified(name):
    result = lm.solve(made(doubling(2.5)), backend(WRONG[name]))
    assert result.status == "not_stabilizable"


@pytest.mark.parametrize("stop", [Stop.TIME_LIMIT, Stop.ITERATION_LIMIT, Stop.INTERRUPTED])
def test_a_limit_is_not_an_answer(stop):
    def late(lp, options):
        return Solution(stop, stop.name, policy=lp.tree[1])

    result = lm.solve(made(standard_map(20)), backend(late))
    assert result.status == "solver_failed"
    assert result.exit_status == 4
    assert result.polish_steps == 0
    assert result.certificate.stabilizing  # the best certified answer so far, gap stated
    assert 1e-6 < result.gap < 1
    assert "limit" in result.message or "interrupted" in result.message


def test_a_limit_with_the_optimum_in_hand_is_verified_all_the_same():
    best = lm.solve(made(standard_map(10)))

    def late(lp, options):
        M = len(lp.controls)
        key = lp.cell.astype(np.int64) * M + lp.control
        wanted = np.arange(lp.n) * M + best.control_index[lp.cells]
        return Solution(Stop.TIME_LIMIT, "late", policy=np.searchsorted(key, wanted))

    assert lm.solve(made(standard_map(10)), backend(late)).status == "verified"


def test_interrupts_pass_through():
    def interrupted(lp, options):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lm.solve(made(steps()), backend(interrupted))


def test_entry_points(monkeypatch):
    from lmdsl.backends import registry

    class Entry:
        name = "theirs"

        def load(self):
            return backend(WRONG["zero value"])

    monkeypatch.setattr(registry, "entry_points", lambda group: [Entry()])
    assert "theirs" in registry.names()
    assert lm.solve(made(steps()), "theirs").status == "verified"
    Entry.load = lambda self: object()
    with pytest.raises(lm.BadInput, match="theirs"):
        lm.solve(made(steps()), "theirs")


def test_a_missing_package_is_named():
    from dataclasses import replace

    from lmdsl.backends import registry

    monkey = replace(registry.get("highs"), requires=("no_such_package",))
    assert monkey.requires
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lmdsl.backends.highs.BACKEND", monkey)
        with pytest.raises(lm.BadInput, match="no_such_package"):
            lm.solve(made(steps()), "highs")


def test_a_backend_cannot_change_the_model():
    lp = lm.compile(made(standard_map(10)))

    def cheat(lp, options):
        lp.cost[:] = 0
        return Solution(Stop.OPTIMAL, "optimal", value=np.zeros(lp.n))

    result = lm.solve(lp, backend(cheat))
    assert result.cost == lm.solve(lp).cost
    assert "read-only" in result.solver_status
    for array in (lp.cost, lp.weight, lp.pair_pointer, lp.control, lp.cells, lp.cell,
                  lp.rows.pointer, lp.rows.target, lp.rows.code, lp.rows.shares.value):  # fmt: skip
        assert not array.flags.writeable


def test_numbers_of_numpy_are_saved(tmp_path):
    def numpy_numbers(lp, options):
        return Solution(Stop.OPTIMAL, "ok", policy=lp.tree[1], iterations=np.int64(3))

    lm.solve(made(steps()), backend(numpy_numbers)).save(tmp_path / "out")
    assert lm.Result.load(tmp_path / "out").iterations == 3


def test_arguments_of_the_wrong_kind_are_bad_input():
    problem = made(steps())
    result = lm.solve(problem)
    for call in (
        lambda: lm.solve(0),
        lambda: lm.solve("file.json"),
        lambda: lm.solve(problem, tolerance="x"),
        lambda: lm.solve(problem, time_limit="x"),
        lambda: lm.solve(problem, max_iterations=1.5),
        lambda: lm.compare(problem, "highs"),
        lambda: lm.compare(0),
        lambda: lm.load(None),
        lambda: result.simulate(starts=2.5),
        lambda: result.simulate(seed=-1),
        lambda: result.controller("a"),
        lambda: result.controller([1, 2]),
    ):
        with pytest.raises(lm.BadInput):
            call()

"""Our backends beyond the contract (``test_contract.py``): the standard map, refusals, Ipopt.

Driven by one table: a new backend adds its specs there, no test. The standard map is compared with
policy iteration.
"""

import contextlib
import os
import signal
import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lmdsl import backends
from lmdsl.backends import Options, Solution, Stop, get, resolve
from lmdsl.backends import clarabel as clarabel_backend
from lmdsl.backends import cvxpy as cvxpy_backend
from lmdsl.backends import highs as highs_backend
from lmdsl.backends import ipopt as ipopt_backend
from lmdsl.backends.scaled import ScaledLP, failure
from lmdsl.errors import BadInput, MissingDependency
from lmdsl.model import lp as model
from lmdsl.model.lp import StabilizationLP
from lmdsl.problem import Problem
from lmdsl.systems import StandardMap
from lmdsl.testing import known

SPECS = [
    f"{name}:{algorithm}"
    for name in backends.installed()
    for algorithm in get(name).capabilities.algorithms
]
SPECS += [f"cvxpy:{solver}" for solver in ("", "clarabel", "highs", "scipy", "scs", "osqp")]
SLOW = {"cvxpy:osqp"}  # too slow for the standard map
every = pytest.mark.parametrize("spec", SPECS)
fast = pytest.mark.parametrize("spec", [spec for spec in SPECS if spec not in SLOW])


def solve(spec: str, lp: StabilizationLP, **options) -> Solution:
    backend, algorithm = resolve(spec)
    try:
        return backend.solve(lp, Options(algorithm=algorithm, **options))
    except MissingDependency as missing:
        pytest.skip(missing.message)


def steps(gamma: float) -> StabilizationLP:
    """Stay, or one cell down, on three cells; three pairs of columns."""
    return known.steps(3, gamma).compile()


@cache
def standard_map() -> StabilizationLP:
    box = {name: axis | {"cells": 20} for name, axis in StandardMap.problem["state_box"].items()}
    problem = StandardMap.problem | {"state_box": box}
    return model.compile(Problem.model_validate(problem))


@cache
def reference() -> np.ndarray:
    return get("policy-iteration").solve(standard_map(), Options()).value


# The standard map -----------------------------------------------------------------------------


@fast
def test_agrees_with_policy_iteration_on_the_standard_map(spec):
    lp = standard_map()
    found = solve(spec, lp)
    assert found.stop is Stop.OPTIMAL
    assert found.value == pytest.approx(reference(), rel=1e-5)
    if found.occupation is not None:
        assert lp.cost @ found.occupation == pytest.approx(reference().mean(), rel=1e-5)


@fast
def test_units_of_the_cost_do_not_matter_on_the_standard_map(spec):
    lp = standard_map()
    found = solve(spec, replace(lp, cost=lp.cost * 1e-9))
    assert found.stop is Stop.OPTIMAL
    assert found.value / 1e-9 == pytest.approx(reference(), rel=1e-5)


@pytest.mark.long
@fast
def test_no_cost_is_worth_nothing(spec):
    lp = standard_map()
    found = solve(spec, replace(lp, cost=np.zeros(lp.K)))
    assert found.stop is Stop.OPTIMAL
    assert found.value == pytest.approx(np.zeros(lp.n), abs=1e-6)


def test_scaling_goes_back():
    lp = replace(steps(1.0), cost=np.array([0, 4, 2, 4, 4, 1.0]))
    scaled = ScaledLP.of(known.weighted(lp, np.array([0.5, 0.25, 0.25])))
    assert scaled.c.max() == scaled.b.max() == 1
    found = scaled.solution(Stop.OPTIMAL, "", np.ones(3), np.ones(6), 1)
    assert (found.value == 4).all()
    assert (found.occupation == 0.5).all()


# Refusals, limits, failures -------------------------------------------------------------------


@every
def test_infeasible_is_said_without_a_ray(spec):
    found = solve(spec, known.single(3.0).compile())
    assert found.stop is Stop.INFEASIBLE
    assert found.value is None


@every
@pytest.mark.parametrize("limit", [{"time_limit": 1e-9}, {"max_iterations": 1}])
def test_a_limit_is_never_a_success(spec, limit):
    found = solve(spec, standard_map(), **limit)
    assert not found.stop.success
    assert found.stop.limit or "SolverError" in found.word  # CVXPY loses some limits
    assert found.word


@fast
def test_a_tighter_tolerance_is_accepted(spec):
    found = solve(spec, standard_map(), tolerance=1e-9, time_limit=60.0)
    assert found.stop is Stop.OPTIMAL
    assert found.value == pytest.approx(reference(), rel=1e-5)
    assert "not supported" not in found.details


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_dropped(bad):
    scaled = ScaledLP.of(steps(1.0))
    y, x = np.array([1, bad, 1]), np.array([1, 1, 1, 1, 1, bad])
    found = scaled.solution(Stop.OPTIMAL, "", y, x, 1)
    assert found.value is None
    assert found.occupation is None
    assert scaled.solution(Stop.OPTIMAL, "", y[:1], x[:1], 1).value is None


def test_rays_and_starting_points_are_no_values():
    scaled = ScaledLP.of(steps(1.0))
    for stop, iterations in ((Stop.INFEASIBLE, 5), (Stop.UNBOUNDED, 5), (Stop.TIME_LIMIT, 0)):
        assert scaled.solution(stop, "", np.ones(3), np.ones(6), iterations).value is None
    assert scaled.solution(Stop.TIME_LIMIT, "", np.ones(3), np.ones(6), 5).value is not None


def test_exceptions_become_failures_but_not_interrupts():
    class PanicException(BaseException):
        pass

    found = failure(PanicException("index\nout of bounds"))
    assert found.stop is Stop.FAILED
    assert found.word == "PanicException: index out of bounds"
    with pytest.raises(KeyboardInterrupt):
        failure(KeyboardInterrupt())


def test_cvxpy_survives_a_panic(monkeypatch):
    import cvxpy

    class PanicException(BaseException):
        pass

    def panic(*_, **__):
        raise PanicException("called `Option::unwrap()` on a `None` value")

    monkeypatch.setattr(cvxpy.Problem, "solve", panic)
    found = solve("cvxpy", steps(1.0))
    assert found.stop is Stop.FAILED
    assert "unwrap" in found.word


@pytest.mark.parametrize("error", ["SolverError", "DCPError"])
def test_cvxpy_errors_are_failures(monkeypatch, error):
    import cvxpy

    def fail(*_, **__):
        raise getattr(cvxpy.error, error)("no")

    monkeypatch.setattr(cvxpy.Problem, "solve", fail)
    assert solve("cvxpy", steps(1.0)).stop is Stop.FAILED


def test_an_unknown_cvxpy_solver_is_refused_with_the_installed_ones():
    import cvxpy

    with pytest.raises(BadInput) as refused:
        get("cvxpy").solve(steps(1.0), Options(algorithm="nope"))
    assert all(name in refused.value.message for name in cvxpy.installed_solvers())


def test_cvxpy_names_the_options_a_solver_does_not_get():
    options = Options(tolerance=1e-6, time_limit=1.0, max_iterations=5)
    passed, unsupported = cvxpy_backend._passed("DAQP", options, 1.0)
    assert passed == {}
    assert unsupported == ["time_limit", "max_iterations", "tolerance"]


@pytest.mark.parametrize("name", ["highs", "clarabel", "cvxpy"])
def test_no_tolerance_is_looser_than_without_one(name):
    module = {"highs": highs_backend, "cvxpy": cvxpy_backend}.get(name)
    if module is highs_backend:
        import highspy

        for option, (default, _) in highs_backend.TOLERANCES.items():
            assert default <= highspy.Highs().getOptionValue(option)[1]
    elif module is cvxpy_backend:
        for solver in cvxpy_backend.TOLERANCE:
            loose = cvxpy_backend._passed(solver, Options(tolerance=1.0), None)
            assert loose == cvxpy_backend._passed(solver, Options(), None)
    else:
        import clarabel

        for option in clarabel_backend.TOLERANCES:
            settings = clarabel_backend._settings(clarabel, Options(tolerance=1.0), "qdldl")
            assert getattr(settings, option) <= getattr(clarabel.DefaultSettings(), option)


# Ipopt ----------------------------------------------------------------------------------------


def test_multipliers_that_prove_nothing_are_no_refusal():
    scaled = ScaledLP.of(steps(1.0))
    for y in (np.ones(3), -np.ones(3), np.zeros(3), np.full(3, np.nan), np.full(3, np.inf)):
        assert not ipopt_backend._proves_infeasible(scaled, y)
    impossible = ScaledLP.of(known.single(3.0).compile())
    assert ipopt_backend._proves_infeasible(impossible, np.array([1e50]))
    assert not ipopt_backend._proves_infeasible(impossible, np.array([-1e50]))


def test_ctrl_c_ends_ipopt_and_the_solve():
    pytest.importorskip("casadi")
    lp = model.compile(Problem.model_validate(StandardMap.problem))  # some seconds
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            solve("ipopt", lp)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        timer.cancel()
        signal.signal(signal.SIGINT, before)


def test_ctrl_c_that_casadi_swallows_is_raised():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with (
            pytest.raises(KeyboardInterrupt),
            ipopt_backend._interruptible(),
            contextlib.suppress(KeyboardInterrupt),
        ):
            signal.raise_signal(signal.SIGINT)
        with ipopt_backend._interruptible():
            pass
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_ipopt_solves_in_any_thread():
    pytest.importorskip("casadi")
    found = []
    thread = threading.Thread(target=lambda: found.append(solve("ipopt", steps(1.0))))
    thread.start()
    thread.join()
    assert found[0].stop is Stop.OPTIMAL


def test_ipopt_prints_nothing(capfd):
    pytest.importorskip("casadi")
    for options in ({}, {"max_iterations": 0}, {"max_iterations": 1}, {"time_limit": 1e-9}):
        solve("ipopt", steps(1.0), **options)
    solve("ipopt", known.single(3.0).compile())
    assert capfd.readouterr() == ("", "")

"""The contract suite: our backends keep it, and every check catches a backend made to break it."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.backends import Backend, Capabilities, Solution, Stop, get, installed
from lmdsl.backends.policy_iteration import solve as howard
from lmdsl.optimize.policies.evaluation import evaluate
from lmdsl.testing import Check, ContractFailure, Report, check_backend, known
from lmdsl.testing.checks import CHECKS
from lmdsl.testing.known import BY_HAND, LARGE
from lmdsl.testing.probe import judge

SPECS = [
    f"{name}:{algorithm}"
    for name in installed()
    for algorithm in get(name).capabilities.algorithms or ("clarabel", "highs", "scipy", "scs")
]


@pytest.mark.parametrize("spec", SPECS)
def test_our_backends_keep_the_contract(spec):
    report = check_backend(spec)
    if not report.passed:  # then all is skipped
        pytest.skip(str(report))
    assert [check.name for check in report] == list(CHECKS)
    allowed = {"vertex", "rays", "occupation", "policy"}
    assert {check.name for check in report.skipped} <= allowed


@pytest.mark.long
def test_osqp_is_honest_where_it_does_not_converge():
    # A first-order method: its own iteration limit on two of the LPs, said as such or, through
    # CVXPY before 1.7, as a failure.
    failed = check_backend("cvxpy:osqp", raise_on_failure=False).failed
    assert {check.name for check in failed} <= {"gamma under", "zeros in the cost"}
    assert all(re.search("stops with (ITERATION_LIMIT|FAILED)", check.reason) for check in failed)


@pytest.mark.parametrize("spec", [*(s for s in SPECS if "hipo" not in s), "cvxpy:osqp"])
@pytest.mark.parametrize(("cost", "optimum"), [("0", 0.0), ("u", 2.0), ("where(x < 0.5, 0, 1)", 1)])
def test_costs_with_zeros_are_verified_by_every_backend(spec, cost, optimum):
    # From cells 1, 2, 3: u costs 1, 2, 3; the last costs 0, 1, 2 (cell 1 is free). Means 2 and 1.
    result = lm.solve(made(steps(1.0, cost=cost)), spec)
    assert result.status == "verified"
    assert result.cost == pytest.approx(optimum, abs=1e-9)
    assert result.controller([[0.3], [0.6], [0.9]]).tolist() == [[1], [1], [1]]


@pytest.mark.parametrize("one", [*BY_HAND, LARGE, known.tie(0.9), known.degenerate(12),
                                 known.trapped(), known.zero_cost(1.0), known.zeros(0.9),
                                 known.zeros(1.25)], ids=lambda one: one.name)  # fmt: skip
def test_the_answers_satisfy_bellmans_equation(one):
    lp = one.compile()
    Q = lp.gamma * (lp.P @ one.value) + lp.cost
    least = np.minimum.reduceat(Q, lp.pair_pointer[:-1])
    np.testing.assert_allclose(least, one.value, rtol=1e-12, atol=1e-12)


# Backends that break one part each ------------------------------------------------------------


def honest(lp, options):
    found = howard(lp, options)
    if found.policy is None or not found.stop.success:
        return found
    Pu = lp.P[found.policy].toarray()
    theta = np.zeros(lp.K)
    theta[found.policy] = np.linalg.solve(np.eye(lp.n) - lp.gamma * Pu.T, lp.solve_weight)
    return replace(found, occupation=theta)


ABLE = Capabilities(algorithms=("dense",), vertex=True, rays=True, warm_start=True)
HONEST = Backend("honest", honest, ABLE)


def spoiled(change):
    """An honest backend with a last step: (lp, options, solution) -> solution."""
    return replace(HONEST, name="spoiled", solve=lambda lp, o: change(lp, o, honest(lp, o)))


def where(condition, stop=Stop.FAILED):
    """An honest backend that gives up on some LPs."""
    return spoiled(lambda lp, o, found: Solution(stop, "no") if condition(lp) else found)


def optimal(lp, value, **parts):
    return Solution(Stop.OPTIMAL, "optimal", np.asarray(value, dtype=float), **parts)


def takes_gamma_below_one_as_one(lp, options):
    found = honest(replace(lp, gamma=1.0) if lp.gamma < 1 and lp.cost.all() else lp, options)
    return replace(found, policy=None, occupation=None)


def piles_up(lp, options, found):
    if found.occupation is None or not lp.cost[0]:
        return found
    theta = np.zeros(lp.K)  # the right cost, all in the first column
    theta[0] = lp.cost @ found.occupation / lp.cost[0]
    return replace(found, occupation=theta)


def duplicates(lp):
    dense = np.column_stack([lp.P.toarray(), lp.cost, lp.cell])
    return len(np.unique(dense, axis=0)) < lp.K


def splits_ties(lp, options, found):
    if found.occupation is None or not duplicates(lp):
        return found
    share = found.occupation.reshape(lp.n, 2).mean(axis=1)
    return replace(found, occupation=np.repeat(share, 2))


def indifferent(lp):
    Q = lp.P @ np.arange(1.0, lp.n + 1) + lp.cost
    return lp.n > 3 and lp.cost.max() == 2 and np.allclose(Q, lp.cell + 1)


def value_iteration(lp, options, found):
    if not (found.stop.success and lp.cost.any() and not lp.cost.all()):
        return found
    V = np.zeros(lp.n)  # too low where staying is free
    for _ in range(1000):
        V = np.minimum.reduceat(lp.gamma * (lp.P @ V) + lp.cost, lp.pair_pointer[:-1])
    return optimal(lp, V)


def believes_the_start(lp, options, found):
    if options.start is None:
        return found
    return optimal(lp, evaluate(lp, options.start), policy=options.start)


def never_late(lp, options):
    return honest(lp, replace(options, time_limit=None))


def calls_a_limit_optimal(lp, options, found):
    if found.stop is not Stop.ITERATION_LIMIT:
        return found
    return optimal(lp, evaluate(lp, lp.tree[1]))


def counts_past_the_limit(lp, options):
    return replace(honest(lp, replace(options, max_iterations=None)), iterations=7)


def trusts_its_options(lp, options, found):
    if options.tolerance is not None and not options.tolerance > 0:
        raise ZeroDivisionError("tolerance")
    return found


def writes_into_the_model(lp, options, found):
    owner = lp.cost if lp.cost.base is None else lp.cost.base
    for array in (owner, lp.cost):
        array.flags.writeable = True
    lp.cost[:] = -1
    return found


COUNTER = count()


def drifts(lp, options, found):
    if found.value is None:
        return found
    return replace(found, value=found.value * (1 + 1e-13 * next(COUNTER)))


def added(error, relative=False):
    def change(lp, options, found):
        if found.value is None:
            return found
        return replace(found, value=found.value + error * (found.value if relative else 1.0))

    return spoiled(change)


BREAKS = [
    ("requires", replace(HONEST, requires=("no_such_package",))),
    ("requires", replace(HONEST, requires=("no_such_package.inside",))),
    ("algorithms", replace(HONEST, capabilities=replace(ABLE, algorithms=()))),
    ("algorithms", replace(HONEST, capabilities=replace(ABLE, algorithms=("a", "a")))),
    ("value", replace(HONEST, solve=takes_gamma_below_one_as_one)),
    ("occupation", spoiled(piles_up)),
    ("policy", spoiled(lambda lp, o, s: (s.policy is None and s) or replace(
        s, policy=lp.pair_pointer[:-1].copy()))),
    ("policy", spoiled(lambda lp, o, s: (s.policy is None and s) or replace(
        s, policy=np.zeros(lp.n, dtype=np.int64) + lp.K - 1))),
    ("vertex", spoiled(splits_ties)),
    ("dual sign", spoiled(lambda lp, o, s: (s.value is None and s) or replace(s, value=-s.value))),
    ("exact tie", where(duplicates)),
    ("degenerate", where(indifferent)),
    ("trapped", where(lambda lp: lp.n < lp.partition.size - 1)),
    ("gamma under", where(lambda lp: lp.n == 1 and 0 < 1 - lp.gamma * lp.P.min() < 0.01,
                          Stop.INFEASIBLE)),
    ("gamma over", spoiled(lambda lp, o, s: optimal(lp, np.full(lp.n, 1e9))
                           if s.stop is Stop.INFEASIBLE and lp.gamma == 2 else s)),
    ("gamma over", spoiled(lambda lp, o, s: replace(s, stop=Stop.UNBOUNDED)
                           if s.stop is Stop.INFEASIBLE and lp.gamma == 2 else s)),
    ("rays", spoiled(lambda lp, o, s: replace(s, stop=Stop.FAILED)
                     if s.stop is Stop.INFEASIBLE else s)),
    ("zero cost", where(lambda lp: not lp.cost.any())),
    ("zeros in the cost", spoiled(value_iteration)),
    ("scale", added(1e-9)),
    ("start", spoiled(believes_the_start)),
    ("tolerance", added(1e-6, relative=True)),
    ("time limit", replace(HONEST, solve=never_late)),
    ("iteration limit", spoiled(calls_a_limit_optimal)),
    ("iteration limit", replace(HONEST, solve=counts_past_the_limit)),
    ("options", spoiled(trusts_its_options)),
    ("inputs", spoiled(writes_into_the_model)),
    ("deterministic", spoiled(drifts)),
]  # fmt: skip

MALFORMED = {
    "it raises": lambda lp, o, s: 1 // 0,
    "it raises SystemExit": lambda lp, o, s: sys.exit(0),
    "MaskedArray, not a plain array": lambda lp, o, s: replace(s, value=np.ma.array(s.value)),
    "not a Solution": lambda lp, o, s: None,
    "not a Stop": lambda lp, o, s: replace(s, stop="optimal"),
    "not a text": lambda lp, o, s: replace(s, word=7),
    "not a whole number": lambda lp, o, s: replace(s, iterations=1.5),
    "right kind": lambda lp, o, s: replace(s, value=list(s.value)),
    "shape": lambda lp, o, s: replace(s, value=s.value[:-1]),
    "not finite": lambda lp, o, s: replace(s, value=s.value * np.nan),
    "without value": lambda lp, o, s: Solution(Stop.OPTIMAL, "optimal"),
}


def names(checks):
    return {check.name for check in checks}


def test_an_honest_backend_passes_everything():
    report = check_backend(HONEST)
    assert report.passed
    assert [check.name for check in report] == list(CHECKS)
    assert not report.skipped
    assert all(check.reason.endswith(".") and "\n" not in check.reason for check in report)


@pytest.mark.parametrize(("part", "backend"), BREAKS, ids=[part for part, _ in BREAKS])
def test_a_backend_that_breaks_one_part_fails_that_check_alone(part, backend):
    report = check_backend(backend, raise_on_failure=False)
    assert names(report.failed) == {part}, str(report)
    assert not report.passed


@pytest.mark.parametrize("fault", MALFORMED)
def test_a_malformed_solution_is_said_once(fault):
    def change(lp, options, found):
        plain = lp.n == 12 and found.stop.success  # on one LP
        return MALFORMED[fault](lp, options, found) if plain else found

    report = check_backend(spoiled(change), raise_on_failure=False)
    assert names(report.failed) == {"solution"}, str(report)
    assert fault in report.failed[0].reason
    assert "degenerate" in names(report.skipped)


def test_every_check_has_a_backend_that_breaks_it():
    assert {part for part, _ in BREAKS} | {"solution"} == set(CHECKS)


# What a record rules out, and the report ------------------------------------------------------


def test_what_the_record_rules_out_is_skipped():
    unable = Capabilities(("dense",), tolerance=False, time_limit=False, iteration_limit=False)
    report = check_backend(replace(HONEST, capabilities=unable))
    assert names(report.skipped) == {"vertex", "rays", "tolerance", "time limit", "iteration limit"}
    assert "tolerance=False" in next(c.reason for c in report if c.name == "tolerance")


@pytest.mark.parametrize("part", ["value", "occupation", "policy"])
def test_one_part_of_a_solution_is_enough(part):
    def only(lp, options, found):
        others = {"value", "occupation", "policy"} - {part}
        return replace(found, **dict.fromkeys(others))

    skipped = {"value": {"occupation", "vertex", "policy"}, "occupation": {"dual sign", "policy"},
               "policy": {"dual sign", "occupation", "vertex"}}  # fmt: skip
    assert names(check_backend(spoiled(only)).skipped) == skipped[part]


def test_a_wrong_occupation_or_policy_alone_is_noticed():
    one = known.walk(60)
    lp = one.compile()
    for parts in ({"policy": lp.tree[1]}, {"occupation": np.full(lp.K, 1.0)}):
        with pytest.raises(Exception, match="off by"):
            judge(one, lp, Solution(Stop.OPTIMAL, "", **parts))


def test_failures_are_raised_with_the_report():
    part, wrong = BREAKS[9]
    assert part == "dual sign"
    with pytest.raises(ContractFailure, match="dual sign: V = -1 where the cost rises by 1") as e:
        check_backend(wrong)
    assert isinstance(e.value, AssertionError)
    assert isinstance(e.value.report, Report)
    assert str(e.value).count("\n") == len(e.value.report.failed)


def test_a_report_reads_as_a_list():
    checks = tuple(Check(f"c{i}", "x" if i else "", o, "Why.")
                   for i, o in enumerate(("passed", "failed", "skipped")))  # fmt: skip
    report = Report("b", checks)
    assert str(report) == "passed  c0: Why.\nfailed  x, c1: Why.\nskipped x, c2: Why."
    assert not Report("b", checks[2:]).passed


def test_every_algorithm_of_a_backend_is_run():
    report = check_backend("policy-iteration")
    assert {check.algorithm for check in report} == {"howard"}
    report = check_backend("clarabel", algorithms=["dual", "dual-qdldl"])
    assert {check.algorithm for check in report} == {"dual", "dual-qdldl"}
    with pytest.raises(lm.BadInput, match="nonsense"):
        check_backend("clarabel", algorithms=["nonsense"])
    with pytest.raises(lm.BadInput, match="sequence"):
        check_backend("clarabel", algorithms="dual")
    with pytest.raises(lm.BadInput, match="not a backend"):
        check_backend("nonsense")


def test_an_algorithm_that_is_not_installed_is_skipped():
    from lmdsl.errors import MissingDependency

    def absent(lp, options):
        raise MissingDependency("install it", "backend")

    report = check_backend(replace(HONEST, solve=absent))
    assert [(c.name, c.outcome) for c in report] == [("available", "skipped")]
    assert not report.passed


def test_interrupts_pass_through():
    def interrupted(lp, options):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        check_backend(replace(HONEST, solve=interrupted))

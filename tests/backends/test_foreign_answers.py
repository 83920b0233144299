"""Backends are foreign: what they return, and what of it is believed."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from foreign_backends import Unspeakable, asked, foreign, optimal

import lmdsl as lm
from lmdsl.backends import Solution, Stop
from lmdsl.backends.policy_iteration import Iterated
from lmdsl.optimize.policies import evaluation, iteration
from lmdsl.optimize.policies.iteration import Iteration


class Agreeable(np.ndarray):
    """An array that finds every comparison true, and of which arithmetic gives itself."""

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        if ufunc in (np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.isfinite):
            return np.ones(self.shape, dtype=bool)
        return self

    def __array_function__(self, function, types, args, kwargs):
        return self

    def astype(self, *_, **__):
        return self

    def all(self, *_, **__):
        return True

    def copy(self, *_, **__):
        return self


class Proxy:
    """No array; makes one when asked, of any kind."""

    def __init__(self, array):
        self.array = array
        self.asked = 0

    def __array__(self, dtype=None, copy=None):
        self.asked += 1
        return self.array if dtype is None else self.array.astype(dtype)


LIES = {
    "subclass": lambda a: a.view(Agreeable),
    "no array": Proxy,
    "matrix": np.asmatrix,
    "strided": lambda a: np.repeat(a, 2)[::2],
    "backwards": lambda a: a[::-1][::-1],
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype),
    "foreign bytes": lambda a: a.astype(a.dtype.newbyteorder()),
}


def exact(array, dtype):
    return (array is None) or (
        type(array) is np.ndarray
        and array.dtype == dtype
        and array.dtype.isnative
        and array.flags.c_contiguous
        and array.flags.aligned
        and array.base is None
    )


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("wrong", [False, True])
def test_arrays_are_copied_into_plain_ones(lp, truth, lie, wrong):
    value = truth.value[lp.cells] * (0.1 if wrong else 1.0)
    pair = lp.pair_pointer[:-1].copy()

    def claims(lp, options):
        theta = np.ones(lp.K)
        return optimal(lp, value=LIES[lie](value), occupation=LIES[lie](theta),
                       policy=LIES[lie](pair))  # fmt: skip

    found = asked(lp, claims)
    assert exact(found.value, np.float64)
    assert exact(found.occupation, np.float64)
    assert exact(found.policy, np.int64)
    result = lm.solve(lp, foreign(claims))
    assert result.status == "verified"
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    np.testing.assert_array_equal(result.control_index, truth.control_index)


def test_an_array_that_finds_every_comparison_true_proves_nothing(lp, truth):
    def claims(lp, options):
        return optimal(
            lp, value=np.ones(lp.n).view(Agreeable), policy=lp.pair_pointer[:-1].view(Agreeable)
        )

    result = lm.solve(lp, foreign(claims))
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)
    assert type(result.value) is np.ndarray


NO_NUMBERS = {
    "complex": lambda n: np.ones(n) + 1j,
    "boolean": lambda n: np.ones(n, dtype=bool),
    "dates": lambda n: np.full(n, np.datetime64(1, "s")),
    "durations": lambda n: np.full(n, np.timedelta64(1, "s")),
    "objects": lambda n: np.ones(n, dtype=object),
    "text": lambda n: np.full(n, "1.0"),
    "records": lambda n: np.ones(n, dtype=[("a", float)]),
    "masked": lambda n: np.ma.MaskedArray(np.ones(n), [True] + [False] * (n - 1)),
    "column": lambda n: np.ones((n, 1)),
    "scalar": lambda n: 1.0,
    "too long": lambda n: np.ones(n + 1),
    "infinite": lambda n: np.full(n, np.inf),
    "beyond doubles": lambda n: np.full(n, np.longdouble("1e400")),
    "generator": lambda n: (1.0 for _ in range(n)),
    "ragged": lambda n: [[1.0], [1.0, 2.0]],
    "dict": lambda n: dict.fromkeys(range(n), 1.0),
}


@pytest.mark.parametrize("kind", NO_NUMBERS)
def test_what_is_no_vector_of_finite_numbers_is_left_out(lp, kind):
    make = NO_NUMBERS[kind]
    found = asked(lp, lambda lp, o: optimal(lp, value=make(lp.n), occupation=make(lp.K)))
    assert found.value is None
    assert found.occupation is None
    assert asked(lp, lambda lp, o: optimal(lp, policy=make(lp.n))).policy is None


@pytest.mark.parametrize("bad", [np.uint64(2**63), np.int64(-1), np.uint64(2**64 - 1)])
def test_columns_far_away_are_no_policy(lp, bad):
    pair = lp.pair_pointer[:-1].astype(type(bad))
    pair[0] = bad
    assert asked(lp, lambda lp, o: optimal(lp, policy=pair)).policy is None


def test_arrays_that_are_changed_later_do_not_matter(lp, truth):
    value = truth.value[lp.cells].copy()
    pair = np.array(lp.tree[1])
    ended = threading.Event()

    def scribble():
        while not ended.is_set():
            value[:] = 1e9
            pair[:] = -1
            time.sleep(0.001)

    thread = threading.Thread(target=scribble)

    def claims(lp, options):
        thread.start()
        return optimal(lp, value=value, policy=pair)

    try:
        result = lm.solve(lp, foreign(claims))
    finally:
        ended.set()
        thread.join()
    assert result.status == "verified"
    assert result.cost == pytest.approx(truth.cost, rel=1e-9)


class Changing(Solution):
    """A solution that is another one each time it is looked at."""

    looked = 0

    def __getattribute__(self, name):
        if name == "policy":
            Changing.looked += 1
        return super().__getattribute__(name)


def test_each_part_is_read_once(lp):
    Changing.looked = 0
    asked(lp, lambda lp, o: Changing(Stop.OPTIMAL, "optimal", policy=lp.tree[1]))
    assert Changing.looked == 1


class Shouting(str):
    __slots__ = ()

    def __str__(self):
        return self

    def __format__(self, spec):
        return "verified"


@pytest.mark.parametrize("word", [None, 7, Unspeakable(), "a\nb\x1b[2J\x00c", "\ud800", "x" * 10**6,
                                  b"bytes", Shouting("loud"), ["list"]])  # fmt: skip
def test_words_become_one_printable_line(lp, word, capsys, tmp_path):
    result = lm.solve(lp, foreign(lambda lp, o: Solution(Stop.OPTIMAL, word, policy=lp.tree[1])))
    assert result.status == "verified"
    assert type(result.solver_status) is str
    assert result.solver_status.isprintable()
    assert len(result.solver_status) <= 200
    json.dumps(result.to_dict(), allow_nan=False).encode("utf-8")
    result.save(tmp_path / "out")


@pytest.mark.parametrize(("given", "kept"), [
    (3, 3), (np.int64(3), 3), (-1, None), (10**400, None), (2.0, None), (np.nan, None),
    ("many", None), (True, None), (np.array([3]), None), (Unspeakable(), None),
])  # fmt: skip
def test_iterations_are_a_count_or_nothing(lp, given, kept, tmp_path):
    def claims(lp, options):
        return Solution(Stop.OPTIMAL, "optimal", policy=lp.tree[1], iterations=given)

    result = lm.solve(lp, foreign(claims))
    assert (result.iterations, type(result.iterations)) == (kept, type(kept))
    result.save(tmp_path / "out")
    assert lm.Result.load(tmp_path / "out").iterations == kept


@pytest.mark.parametrize("stop", [None, "OPTIMAL", Stop, 0, Unspeakable()])
def test_a_stop_is_a_stop(lp, stop):
    assert asked(lp, lambda lp, o: Solution(stop, "optimal")).stop is Stop.FAILED


@pytest.mark.parametrize("typed", [False, True])
def test_details_prove_nothing(lp, truth, typed):
    # What our own policy iteration hands on must not be forged: here a policy that is not optimal.
    def forger(lp, options):
        pair = lp.tree[1]
        value = evaluation.evaluate(lp, pair)
        screen = iteration.Screen(lp)
        claim = Iteration(pair, value, 0, True, screen)
        if typed:
            return Iterated(Stop.OPTIMAL, "optimal", value, None, pair, 1, iteration=claim)
        return Solution(Stop.OPTIMAL, "optimal", value, None, pair, 1, {"iteration": claim})

    assert (lp.tree[1] != truth.lp.column(0, 0)).any()
    result = lm.solve(lp, foreign(forger))
    assert result.status == "verified"
    assert result.polish_steps > 0
    assert result.cost == truth.cost
    own = lm.solve(lp, replace(lm.backends.get("policy-iteration"), name="own"))
    assert own.polish_steps == 0
    for details in (None, 7, {"iteration": Unspeakable()}, Unspeakable()):
        found = asked(lp, lambda lp, o, d=details: Solution(Stop.OPTIMAL, "", details=d))
        assert dict(found.details) == {}

"""Laws of random recorded data: what holds whatever was recorded."""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import lmdsl as lm

CHANCES = settings(
    max_examples=20, deadline=None, derandomize=True,
    suppress_health_check=[HealthCheck.filter_too_much],
)  # fmt: skip


@st.composite
def recordings(draw):
    """Transitions of a random process on 3 x 3 cells with up to three controls."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    T, M = draw(st.integers(20, 400)), draw(st.integers(1, 3))
    x = rng.uniform(0, 3, (T, 2))
    u = rng.integers(0, M, T)
    x_next = np.clip(0.8 * x + rng.normal(0, 0.3, (T, 2)) - 0.2 * u[:, None], 0.01, 2.99)
    keys = {
        "state_box": {name: {"low": 0, "high": 3, "cells": 3} for name in "ab"},
        "control_grid": {"u": {"low": 0, "high": M - 1, "points": M}},
        "stage_cost": draw(st.sampled_from(["1", "a*b", "a**2 + u"])),
        "attractor": {"cells": [[0, 0]]},
        "gamma": draw(st.sampled_from([0.9, 1.0, 1.02])),
        "discount": draw(st.sampled_from([None, 0.8])),
        "min_count": draw(st.sampled_from([1, 3])),
    }
    return (x, u, x_next), keys


@CHANCES
@given(recordings(), st.sampled_from([0.5, 0.95]))
def test_the_recorded_cost_lies_in_the_range_and_a_higher_level_is_wider(recorded, level):
    """The recorded rows are in the intervals; V_up and W bound their cost from both sides."""
    arrays, keys = recorded
    results = [lm.solve(lm.from_data(*arrays, confidence=c, **keys)) for c in (level, 0.999)]
    assume(results[0].verified)
    ranges = [result.data.cost for result in results]
    for low, high in ranges:
        assert low <= results[0].cost
        assert high is None or high >= results[0].lower_bound
    (low, high), (least, most) = ranges
    assert least <= low * (1 + 1e-9)
    assert most is None or (high is not None and high <= most * (1 + 1e-9))
    gamma = keys["gamma"] * (keys["discount"] or 1)
    if gamma <= 1:
        assert most is not None  # all rows of the intervals have the same support
    met = [result.data.unseen_in_a_run for result in results]
    assert 0 < met[0] <= met[1] + 1e-12 <= 1 + 1e-12


@CHANCES
@given(recorded=recordings())
def test_saved_results_are_confirmed_exactly(recorded, tmp_path_factory):
    arrays, keys = recorded
    place = tmp_path_factory.mktemp("saved") / "out"
    result = lm.solve(lm.from_data(*arrays, confidence=0.9, smoothing=0.25, **keys))
    assume(result.verified)
    result.save(place)
    found = lm.verify(place, exact=True)
    assert found.holds, found
    assert found.same_model


@CHANCES
@given(recordings(), st.randoms(use_true_random=False))
def test_the_order_of_the_data_changes_nothing(recorded, random):
    (x, u, x_next), keys = recorded
    keys["stage_cost"] = "1"  # sums of other costs depend on the order in their last bit
    order = list(range(len(x)))
    random.shuffle(order)
    first, second = (
        lm.from_data(x[k], u[k], x_next[k], confidence=0.9, **keys) for k in (slice(None), order)
    )
    assert first == second


@CHANCES
@given(recordings())
def test_data_written_down_twice_have_the_same_rows_and_narrower_intervals(recorded):
    """Which is wrong, as the draws are not independent: the assumption is the user's."""
    (x, u, x_next), keys = recorded
    once = lm.solve(lm.from_data(x, u, x_next, confidence=0.9, **keys | {"min_count": 1}))
    assume(once.verified)
    twice = lm.solve(
        lm.from_data(*(np.concatenate([part, part]) for part in (x, u, x_next)), confidence=0.9,
                     **keys | {"min_count": 1})
    )  # fmt: skip
    assert twice.cost == pytest.approx(once.cost, rel=1e-6)
    assert twice.data.unseen[0] < once.data.unseen[0]
    if np.array_equal(once.control_index, twice.control_index) and once.data.cost[1] is not None:
        assert twice.data.cost[1] <= once.data.cost[1] * (1 + 1e-9)

"""Proofs of the systems known by name: states of their boxes, followed by the true map.

All of it, more states: ``lmdsl prove DIR``, then ``tests/helpers/proved_points.py DIR 1e7``.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from named_systems import NAMED, solved
from proved_points import ARRIVES, box_at, drawn, exceptions

from lmdsl.machine.deadline import Deadline
from lmdsl.proof.checking import faults
from lmdsl.results.directory.proved import loop_of

pytestmark = pytest.mark.long  # in other versions it would find nothing else

# What is reached in a few seconds; the whole of it takes minutes for some.
TARGETS = {"standard_map": 0.4, "logistic_map": 1.0, "henon_map": 0.95, "double_integrator": 0.999,
           "inverted_pendulum": 0.8, "pendulum_on_cart": 0.98, "van_der_pol": 0.999,
           "lorenz": 0.005, "cart_pole": 1e-4}  # fmt: skip
# 54,914 cells of four dimensions; the slowest of the others, of two.
MINUTES = {"cart_pole", "pendulum_on_cart"}


# One process has the proof of a system.
SYSTEMS = [
    pytest.param(
        name, marks=[pytest.mark.xdist_group(name), *[pytest.mark.full] * (name in MINUTES)]
    )
    for name in NAMED
]


@functools.cache
def proved(name):
    return solved(name), solved(name).prove(TARGETS[name])


def test_every_system_is_proved():
    assert TARGETS.keys() == NAMED.keys()


@pytest.mark.parametrize("name", SYSTEMS)
def test_random_states_do_what_is_proved_of_their_boxes(name):
    result, proof = proved(name)
    assert proof.reached
    assert exceptions(result, proof, 20_000) == {"arrives": 0, "lost": 0, "stays": 0}


@pytest.mark.parametrize("name", SYSTEMS)
def test_states_at_the_faces_of_boxes_too(name):
    """Corners, and what lies a rounding or less than the width of an edge away from them."""
    result, proof = proved(name)
    partition, rng = result.partition, np.random.default_rng(4)
    box = rng.integers(proof.boxes, size=400)
    index = np.stack(partition.multi_index(proof.cell[box]), axis=-1)
    part = (proof.place[box] + rng.integers(0, 2, index.shape)) / 2.0 ** proof.split[box]
    x = partition.low + (index + part) * partition.width
    x += rng.choice([0, 1e-16, -1e-16, 5e-10, -5e-10], x.shape) * partition.width
    x, cell = partition.enter(x)
    x = x[(cell >= 0) & (result.cell_status[cell] == 1)]
    boxes = np.array([box_at(proof, partition, state) for state in x])
    assert (boxes >= 0).all()
    found = exceptions(result, proof, len(x), x=x, box=boxes)
    assert found == {"arrives": 0, "lost": 0, "stays": 0}


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_check_confirms_the_proof(name):
    result, proof = proved(name)
    assert faults(loop_of(result), proof.arrays(), lambda: None) == []


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_mean_cost_lies_between_its_bounds(name):
    result, proof = proved(name)
    rng = np.random.default_rng(5)
    x, box = drawn(proof, result.partition, 20_000, rng)
    x = x[: len(x) // 2][proof.kind[box[: len(x) // 2]] == ARRIVES]  # by volume
    runs = result.closed_loop.compiled.run(x, int(proof.steps), rng, Deadline())
    error = 5 * runs.cost.std() / np.sqrt(len(x))
    assert proof.cost[0] - error <= runs.cost.mean() <= proof.cost[1] + error
    assert runs.taken.max() <= proof.steps


def test_bounds_close_in_with_more_boxes():
    """The mean cost of the logistic map is known within 6 % by 200,000 boxes."""
    _, proof = proved("logistic_map")
    low, high = proof.cost
    assert 0.94 * high < low < high

"""Lower bounds of the probability to arrive: by hand, against runs, and spoiled."""

from __future__ import annotations

import math

import numpy as np
import pytest
from problems import made

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.machine.deadline import Deadline
from lmdsl.proof import proving
from lmdsl.proof.bounds.chance import chances, weights
from lmdsl.proof.bounds.tightening import tighten
from lmdsl.proof.checking import faults
from lmdsl.proof.cover import Cover
from lmdsl.proof.prover import Prover
from lmdsl.proof.record import Proof
from lmdsl.results.directory.proved import add, loop_of

COIN = {"w": {"values": [0, 1], "weights": [0.75, 0.25]}}


def line(formula, noise, **more):
    """x+ = formula on [0, 1] in 4 cells, A = the first."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": formula}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": 4}},
        "attractor": {"cells": [[0]]},
        "control_grid": {},
        "stage_cost": "1",
        "noise": noise,
        "sampling": {"kind": "grid", "per_axis": 1},
        **more,
    }


def proved(data, most=3_000):
    """A proof of at most so many boxes and some more."""
    result = lm.solve(made(data))
    assert result.certificate.stabilizing
    loop = loop_of(result)
    images = loop.images(proving.SLACK)
    prover = Prover(Cover(loop.partition, loop.status), images, loop.factor, loop.entry(images))
    prover.run(lambda _: prover.cover.count > most, Deadline(), None)
    tighten(prover, lambda boxes: boxes > most, Deadline(), None)
    arrays = proving.boxes(prover, chances(prover, Deadline()))
    return result, Proof.of(arrays, loop, seconds=0.0, holds=None, target=0.9999)


DOWN = "0.125 + 0.25*(floor(4*x) - 1)"  # the middle of the cell below
STRIP = "abs(mod(4*x, 1) - 0.9) < 0.05"  # a tenth of every cell that no sample sees


def test_without_noise_nothing_is_said():
    data = line(DOWN, None)
    del data["noise"]
    proof = lm.solve(made(data)).prove(0.99)
    assert (proof.probability, proof.chance) == (None, None)
    assert proof.to_dict()["probability"] is None


def test_a_lazy_walk_arrives_with_probability_one():
    """It stays with probability 3/4: no number of steps is enough, but it arrives."""
    _, proof = proved(line("0.125 + 0.25*(floor(4*x) - w)", COIN))
    assert proof.arrives < 1e-3
    assert proof.probability == pytest.approx(1, abs=5e-3)
    assert proof.probability < 1


@pytest.mark.parametrize(
    ("noise", "bad", "lost"),
    [
        (COIN, "w > 0.5", 0.25),
        ({"w": {"uniform": {"low": 0, "high": 1, "points": 4}}}, "w > 0.76", 0.25),
        ({"w": {"uniform": {"low": 0, "high": 1, "points": 4}}}, "w > 0.6", 0.5),
        ({"w": {"uniform": {"low": 0, "high": 1, "points": 4}},
          "v": {"values": [0, 1], "weights": [0.5, 0.5]}}, "w > 0.76 and v > 0.5", 0.125),
    ],
)  # fmt: skip
def test_what_is_lost_with_some_noise_counts_by_its_probability(noise, bad, lost):
    """A tenth of C is lost at once with bad noise; parts that may be bad count as bad."""
    data = line(f"where({bad} and {STRIP}, 2, {DOWN})", noise)
    result, proof = proved(data)
    assert proof.probability == pytest.approx(1 - 0.1 * lost, abs=1e-3)
    assert proof.probability <= 1 - 0.1 * lost
    largest = np.argmax(proof.kind == 0)  # ordered by cell, not all of a cell arrives
    assert proof.chance[proof.kind == 1].min() == 1
    assert proof.chance[largest] <= 1 - lost + 1e-9
    assert faults(loop_of(result), proof.arrays(), lambda: None) == []


def test_noise_beyond_what_is_covered_counts_as_not_arriving():
    """A run arrives in as many steps as cells lie before: each time it must stay within."""
    noise = {"w": {"normal": {"std": 0.01, "points": 3, "within": 2.5}}}
    _, proof = proved(line(f"{DOWN} + w", noise))
    within = math.erf(2.5 / math.sqrt(2))
    expected = np.mean([within, within**2, within**3])
    assert proof.probability == pytest.approx(expected, abs=1e-3)
    assert proof.probability <= expected


def test_weights_are_at_most_probabilities():
    """Against SciPy's normal distribution; uniform parts and given weights by hand."""
    from scipy.stats import norm

    noise = {
        "w": {"normal": {"std": 2.0, "points": 4, "within": 3.0}},
        "v": {"values": [1, 2, 3], "weights": [0.2, 0.0, 0.8]},
    }
    data = line("0.1 + 0*w + 0*v", noise)
    found, whole = weights(made(data))
    ends = norm.cdf(np.linspace(-3, 3, 5))
    true = np.multiply.outer(np.diff(ends), [0.2, 0.8]).ravel()
    assert not whole
    assert (found <= true).all()
    assert found == pytest.approx(true, abs=1e-13)


WIND = {
    "format": "lmdsl/1",
    "system": {
        "kind": "map",
        "next": {
            "x": "where(x > 0.76 and x < 0.84 and w > 0.1, 5, 0.7*x - 0.2*y + u + 0.3*w)",
            "y": "0.8*y + w",
        },
    },
    "state_box": {
        "x": {"low": -1, "high": 1, "cells": 8},
        "y": {"low": -1, "high": 1, "cells": 8},
    },
    "attractor": {"boxes": [{"x": [-0.25, 0.25], "y": [-0.25, 0.25]}]},
    "control_grid": {"u": {"values": [-0.2, 0.0, 0.2]}},
    "stage_cost": "1",
    "noise": {"w": {"values": [-0.19, 0.0, 0.19], "weights": [0.25, 0.5, 0.25]}},
    "sampling": {"kind": "grid", "per_axis": 1},
}


@pytest.fixture(scope="module")
def windy():
    return proved(WIND)


def test_runs_arrive_as_often(windy):
    """From the least, the middle and the greatest chances, 4,000 runs each."""
    result, proof = windy
    assert proof.chance.min() < 0.9 < proof.probability < 1
    rng = np.random.default_rng(0)
    order = np.argsort(proof.chance, kind="stable")
    some = order[np.linspace(0, len(order) - 1, 25).astype(int)]
    index = np.stack(result.partition.multi_index(proof.cell[some]), axis=-1)
    part = (proof.place[some] + 0.5) / 2.0 ** proof.split[some]
    x = result.partition.low + (index + part) * result.partition.width
    for state, chance in zip(x, proof.chance[some], strict=True):
        runs = result.closed_loop.compiled.run(np.tile(state, (4_000, 1)), 400, rng)
        share = (runs.outcome == 0).mean()
        assert share >= chance - 4 * math.sqrt(chance * (1 - chance) / 4_000) - 1e-9


def test_what_is_proved_is_confirmed_and_more_is_refused(windy):
    result, proof = windy
    loop, arrays = loop_of(result), proof.arrays()
    assert faults(loop, arrays, lambda: None) == []
    between = np.flatnonzero((proof.chance > 0.01) & (proof.chance < 0.99))
    for i, value in ((between[0], 1.001), (between[-1], 1.00001)):
        spoiled = arrays["probability"].copy()
        spoiled[i] *= value
        found = faults(loop, {**arrays, "probability": spoiled}, lambda: None)
        assert any("probability" in text for text in found)
    for value in (np.nan, -0.1, 1.1):
        spoiled = arrays["probability"].copy()
        spoiled[0] = value
        assert faults(loop, {**arrays, "probability": spoiled}, lambda: None)


def test_to_stay_for_ever_is_not_to_arrive():
    """An island keeps its runs: that P is not more than P afterwards proves nothing of it."""
    formula = "where(abs(x - 0.95) < 0.03, 0.5*x + 0.475, where(w > 0.5, 0.1, 0.15))"
    result, proof = proved(line(formula, COIN))
    assert proof.stays == pytest.approx(0.06 / 0.75, abs=1e-3)
    assert proof.probability == pytest.approx(1 - 0.06 / 0.75, abs=1e-3)
    arrays = proof.arrays()
    arrays["probability"] = np.where(proof.kind == 3, 0.5, proof.chance)
    assert len(faults(loop_of(result), arrays, lambda: None)) == 3


def test_a_directory_keeps_it(tmp_path, windy):
    result, proof = windy
    result.save(tmp_path / "out")
    add(tmp_path / "out", result, proof)
    assert main(["verify", str(tmp_path / "out")]) == 0
    with np.load(tmp_path / "out" / "proof.npz") as stored:
        np.testing.assert_array_equal(stored["probability"], proof.chance)
    spoiled = proof.arrays()
    spoiled["probability"] = np.minimum(spoiled["probability"] + 0.01, 1.0)
    loop = loop_of(result)
    other = Proof.of(spoiled, loop, seconds=0.0, holds=proof.holds, target=proof.target)
    add(tmp_path / "out", result, other)
    assert main(["verify", str(tmp_path / "out")]) == 1

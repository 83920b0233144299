"""The weight m: boxes, densities, weights; conditional costs; controls where m = 0."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm


def weight(measure):
    return lm.compile(made(steps(measure=measure))).weight.tolist()


def test_kinds_of_weights():
    # Cells 1, 2, 3 of [0, 1] have centres 0.375, 0.625, 0.875.
    assert weight({"boxes": [{"x": [0.5, 1]}]}) == [0, 0.5, 0.5]
    assert weight({"density": "max(x - 0.375, 0)"}) == [0, 0.25 / 0.75, 0.5 / 0.75]
    assert weight({"weights": [7, 1, 0, 3]}) == [0.25, 0, 0.75]
    assert weight({"weights": [7, 1, 2, 3], "boxes": [{"x": [0.5, 1]}]}) == [0, 0.4, 0.6]
    assert weight({"density": "2", "boxes": [{"x": [0.5, 1]}]}) == [0, 0.5, 0.5]


def test_weights_near_the_largest_double():
    assert weight({"weights": [0, 1e308, 1e308, 1.7e308]})[0] == pytest.approx(1 / 3.7)


@pytest.mark.parametrize(
    ("measure", "where", "word"),
    [
        ({}, "measure", "give boxes"),
        ({"density": "1", "weights": [1, 1, 1, 1]}, "measure", "exclude"),
        ({"density": "u"}, "measure.density", "'u'"),
        ({"density": "x - 0.5"}, "measure.density", ">= 0"),
        ({"density": "1/(x - x)"}, "measure.density", "finite"),
        ({"density": "0"}, "measure", "no cell"),
        ({"weights": [1, 2]}, "measure.weights", "2 weights"),
        ({"weights": [1, 2, -1, 0]}, "measure.weights[2]", "-1"),
        ({"weights": [0, 0, 0, 0]}, "measure", "no cell"),
        ({"weights": []}, "measure.weights", "at least 1"),
    ],
)
def test_bad_weights(measure, where, word):
    with pytest.raises(lm.BadInput) as caught:
        lm.compile(made(steps(measure=measure)))
    assert str(caught.value).startswith(where)
    assert word in str(caught.value)


def test_weight_off_the_stabilizable_set_is_not_stabilizable():
    result = lm.solve(made(steps(measure={"weights": [1, 0, 0, 0]})))
    assert result.status == "not_stabilizable"
    assert result.cause == "measure"


def test_controls_do_not_depend_on_the_weight():
    everywhere = lm.solve(made(standard_map(20)))
    for backend in ("policy-iteration", "highs"):
        corner = lm.solve(
            made(standard_map(20, measure={"boxes": [{"x": [0, 0.1], "y": [0, 0.1]}]})), backend
        )
        assert corner.status == "verified"
        np.testing.assert_array_equal(corner.control_index, everywhere.control_index)


def test_the_weight_is_linear_in_the_cost():
    # The cost of a mixture of starts is the mixture of the costs.
    a = lm.solve(made(steps(1.2, measure={"weights": [0, 1, 0, 0]}))).cost
    b = lm.solve(made(steps(1.2, measure={"weights": [0, 0, 0, 1]}))).cost
    mixed = lm.solve(made(steps(1.2, measure={"weights": [0, 1, 0, 3]}))).cost
    assert mixed == pytest.approx((a + 3 * b) / 4, rel=1e-12)


def test_conditional_cost():
    result = lm.solve(made(steps(1.0)))
    found = result.cost_from({"x": (0.5, 1)})
    assert found.upper == pytest.approx(2.5)
    assert found.lower == pytest.approx(2.5)
    assert found.lower <= found.upper
    assert found.mass == pytest.approx(2 / 3)
    union = result.cost_from({"x": (0.25, 0.5)}, {"x": (0.75, 1)})
    assert union.upper == pytest.approx(2)
    with pytest.raises(lm.BadInput, match="carries weight"):
        result.cost_from({"x": (0, 0.25)})
    with pytest.raises(lm.BadInput, match="not an axis"):
        result.cost_from({"z": (0, 1)})


def test_conditional_costs_add_up():
    result = lm.solve(made(standard_map(20)))
    left = result.cost_from({"x": (0, 0.5)})
    right = result.cost_from({"x": (0.5, 1)})
    total = left.mass * left.upper + right.mass * right.upper
    assert total == pytest.approx(result.cost, rel=1e-12)


def test_saved_weights_come_back(tmp_path):
    result = lm.solve(made(standard_map(10, measure={"density": "1 + sin(2*pi*x)"})))
    result.save(tmp_path / "out")
    loaded = lm.Result.load(tmp_path / "out")
    np.testing.assert_array_equal(loaded.weight, result.weight)
    assert lm.verify(tmp_path / "out").holds
    runs = loaded.simulate(starts=100, steps=1000)
    assert runs.reached > 90

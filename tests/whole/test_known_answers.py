"""Problems small enough to solve by hand; every number below was derived on paper."""

from __future__ import annotations

import numpy as np
import pytest
from problems import doubling, made, standard_map, steps

import lmdsl as lm


@pytest.mark.parametrize("gamma", [0.9, 1.0, 1.25, 3.0])
def test_three_steps(gamma):
    result = lm.solve(made(steps(gamma)))
    V = [1, 1 + gamma, 1 + gamma + gamma**2]
    assert result.status == "verified"
    np.testing.assert_allclose(result.value, [0, *V], rtol=1e-12)
    np.testing.assert_allclose(result.lower, [0, *V], rtol=1e-12)
    assert result.control_index.tolist() == [-1, 1, 1, 1]
    # From cells 1, 2, 3 with mass 1/3: mu_3 = 1/3, mu_2 = 1/3 + gamma mu_3, ...
    mu3 = 1 / 3
    mu2 = 1 / 3 + gamma * mu3
    mu1 = 1 / 3 + gamma * mu2
    np.testing.assert_allclose(result.measure, [0, mu1, mu2, mu3], rtol=1e-12)
    assert result.cost == pytest.approx(sum(V) / 3, rel=1e-12)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 1.5, 1.9, 1.9999])
def test_doubling_map(gamma):
    result = lm.solve(made(doubling(gamma)))
    assert result.status == "verified"
    np.testing.assert_allclose(result.value, [0, 1 / (1 - gamma / 2)], rtol=1e-9)
    assert result.contraction == pytest.approx(max(gamma, 1) / 2, rel=1e-9)


@pytest.mark.parametrize("gamma", [2.0, 2.0000001, 3.0, 1e6])
def test_doubling_map_beyond_its_limit_is_refused_with_proof(gamma):
    result = lm.solve(made(doubling(gamma)))
    assert result.status == "not_stabilizable"
    assert result.exit_status == 3
    assert result.certificate.refusal
    assert result.gamma_bar is not None
    assert result.gamma_bar[0] <= 2 <= result.gamma_bar[1]
    assert result.cost is result.gap is result.contraction is None
    assert (result.control_index == -1).all()
    assert result.value.tolist() == [0, np.inf]
    assert result.lower.tolist() == [0, 0]
    assert "gamma" in result.message


@pytest.mark.parametrize("gamma", [1.0, 1.1, 2.0])
def test_staying_for_free_is_not_chosen(gamma):
    # u = 0 stays for nothing, u = 1 goes for 1: a careless tie or value iteration stays.
    result = lm.solve(made(steps(gamma, cost="u")))
    assert result.status == "verified"
    assert result.control_index.tolist() == [-1, 1, 1, 1]
    np.testing.assert_allclose(result.value[1:], [1, 1 + gamma, 1 + gamma + gamma**2], rtol=1e-9)


def test_staying_for_free_at_gamma_below_one_is_not_verified():
    result = lm.solve(made(steps(0.5, cost="u")))
    assert result.status == "unverified"
    assert result.exit_status == 1
    assert "raise gamma to 1" in result.message
    assert not result.certificate.stabilizing
    # The other claims hold: staying costs nothing, and nothing is cheaper.
    assert result.certificate.upper_bound
    assert result.cost == 0


def test_no_cost_at_all_still_stabilizes():
    result = lm.solve(made(steps(1.5, cost="0")))
    assert result.status == "verified"
    assert result.cost == 0
    assert result.gap == 0
    assert result.control_index.tolist() == [-1, 1, 1, 1]


def test_escape_is_forbidden_or_clipped():
    # x+ = x + 0.5 u on [0, 1], A = cell 3 (of 4). From cell 2, u = 1 leaves the box.
    data = steps(1.0)
    data["system"]["next"] = {"x": "x + 0.5*u"}
    data["attractor"] = {"cells": [[3]]}
    result = lm.solve(made(data))
    assert result.cell_status.tolist() == [3, 1, 3, 0]
    clipped = lm.solve(made({**data, "on_exit": "clip"}))
    assert clipped.cell_status.tolist() == [1, 1, 1, 0]
    np.testing.assert_allclose(clipped.value, [2, 1, 1, 0])


def test_causes():
    # Cells 0..5 of [0, 6], A = cell 5. Moves by u in {0, 1} except:
    # cell 0: always leaves; cell 1: always stays; cell 2: half to 1, half to 5;
    # cell 3, 4: x + u.
    jump = "where(x < 1, -5, where(x < 2, x, where(x < 3, where(x < 2.5, 1.5, 5.5), x + u)))"
    data = steps(1.0)
    data["system"]["next"] = {"x": jump}
    data["state_box"] = {"x": {"low": 0, "high": 6, "cells": 6}}
    data["attractor"] = {"cells": [[5]]}
    result = lm.solve(made(data))
    assert result.cell_status.tolist() == [2, 3, 4, 1, 1, 0]
    assert result.status == "verified"
    everything = lm.solve(made(data), require_all=True)
    assert everything.status == "not_stabilizable"


def test_avoid_counts_as_leaving():
    data = steps(1.0, avoid={"boxes": [{"x": [0.25, 0.5]}]})
    result = lm.solve(made(data))
    assert result.cell_status.tolist() == [0, 5, 3, 3]
    assert result.status == "not_stabilizable"
    assert result.cause == "empty"


def test_measure_weighs_the_cost_only():
    data = steps(1.0, measure={"boxes": [{"x": [0.75, 1]}]})
    result = lm.solve(made(data))
    assert result.status == "verified"
    assert result.cost == pytest.approx(3)
    np.testing.assert_allclose(result.value, [0, 1, 2, 3])
    np.testing.assert_allclose(result.measure, [0, 1, 1, 1])


def test_measure_outside_the_stabilizable_set():
    data = steps(1.0, measure={"boxes": [{"x": [0, 0.25]}]})
    result = lm.solve(made(data))
    assert result.status == "not_stabilizable"
    assert result.cause == "measure"


def test_noise_by_hand():
    # x+ = x - 0.25 u + w, w = +-0.25 w.p. 1/2 on 4 cells, A = cell 0, reflecting at the top
    # by a control u = 2. Cells 1, 2, 3; admissible: the top cell must not be pushed out.
    data = steps(1.0)
    data["system"]["next"] = {"x": "x - 0.25*u + w"}
    data["noise"] = {"w": {"values": [0.25, -0.25], "weights": [0.5, 0.5]}}
    data["control_grid"] = {"u": {"values": [0, 1]}}
    result = lm.solve(made(data))
    # u = 1 moves by 0 or -2 cells. Cell 1 would leave below with probability 1/2, u = 0 moves
    # +-1: cell 1 -> {2, 0}; cell 2 under u=1 -> {2, 0}; cell 3 under u=1 -> {3, 1}.
    assert result.status == "verified"
    # V1 = 1 + V2/2, V2 = min(1 + V2/2, 1 + (V1 + V3)/2), V3 = 1 + (V3 + V1)/2
    np.testing.assert_allclose(result.value, [0, 2, 2, 4], rtol=1e-12)


def test_noise_of_zero_weight_is_dropped():
    data = steps(1.0)
    data["system"]["next"] = {"x": "x - 0.25*u + w"}
    data["noise"] = {"w": {"values": [0, 100], "weights": [1, 0]}}
    np.testing.assert_allclose(lm.solve(made(data)).value, [0, 1, 2, 3])


def test_two_controls():
    # Moves of 1 (cost 1) and 2 (cost 1.5) cells combine: three cells in one step cost 2.5.
    data = steps(1.0, cost="a + 1.5*b")
    data["system"]["next"] = {"x": "x - 0.25*a - 0.5*b"}
    data["control_grid"] = {"a": {"values": [0, 1]}, "b": {"values": [0, 1]}}
    result = lm.solve(made(data))
    np.testing.assert_allclose(result.value, [0, 1, 1.5, 2.5])
    assert result.control_vectors[result.control_index[3]].tolist() in ([1, 1], [0, 1], [1, 0])


def test_ode_is_integrated_by_runge_kutta():
    # x' = -x + u with step log(2): the classical RK4 factor is 1 - h + h^2/2 - h^3/6 + h^4/24.
    h = np.log(2)
    data = steps(1.0)
    data["system"] = {"kind": "ode", "derivative": {"x": "-x"}, "step": float(h)}
    data["control_grid"] = {}
    problem = made(data)
    image = problem.step()({"x": np.array([1.0])})[0]
    factor = 1 - h + h**2 / 2 - h**3 / 6 + h**4 / 24
    assert image[0] == pytest.approx(factor, rel=1e-15)
    assert abs(image[0] - 0.5) < 2e-3
    finer = made({**data, "system": {**data["system"], "substeps": 10}})
    assert abs(finer.step()({"x": np.array([1.0])})[0][0] - 0.5) < 2e-7
    # x halves (a little less): cell k -> k/2; cells 2, 3 -> 1; cell 1 -> 0.
    np.testing.assert_allclose(lm.solve(finer).value, [0, 1, 2, 2])


def test_gauss_hermite_moments():
    from lmdsl.model.discretization import noise_nodes

    data = steps(1.0)
    data["noise"] = {"w": {"normal": {"std": 0.3, "points": 5}}}
    nodes = noise_nodes(made(data))
    w = nodes.weights / nodes.weights.sum()
    x = nodes.values[:, 0]
    for power, moment in ((1, 0), (2, 0.3**2), (3, 0), (4, 3 * 0.3**4), (6, 15 * 0.3**6)):
        assert (w * x**power).sum() == pytest.approx(moment, abs=1e-15)


def test_the_papers_example():
    result = lm.solve(made(standard_map()))
    assert result.status == "verified"
    assert (result.attractor_cells, result.stabilizable_cells, result.pairs) == (4, 2496, 52416)
    assert result.lp.A.shape == (2496, 52416)
    assert result.gap <= 1e-6
    runs = result.simulate(starts=10_000, steps=10_000, seed=0)
    assert runs.reached >= 9_990


@pytest.mark.long
def test_the_papers_example_on_every_backend():
    found = lm.compare(made(standard_map()))
    assert [result.backend for result in found.results] == [
        "policy-iteration", "highs", "clarabel", "cvxpy",
    ]  # fmt: skip
    for result in found.results:
        assert result.status == "verified", result.message
        assert result.gap <= 1e-6
        assert (result.lp.n, result.lp.K) == (2496, 52416)
    assert found.agreement.cost <= 1e-6
    assert found.agreement.controls == 1
    assert found.exit_status == 0

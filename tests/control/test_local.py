"""Local controllers: the regulator, the whole feedback, and what is proved of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from local_controllers import ORBIT, linear_system, local_of
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.control.invariance import examine


def test_the_regulator_of_a_fixed_point_solves_its_riccati_equation():
    A, B = [[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]]
    weights = {"state_weights": {"x0": 2.0, "x1": 0.5}, "control_weights": {"u0": 3.0}}
    data = linear_system(A, B, local_controller={"kind": "lqr", "orbit": [[0, 0]], **weights})
    local = local_of(made(data))
    # Value iteration of the Riccati recursion, an independent route to the same gain.
    A, B, Q, R = np.array(A), np.array(B), np.diag([2.0, 0.5]), np.array([[3.0]])
    X = Q
    for _ in range(5000):
        K = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A)
        X = Q + A.T @ X @ (A - B @ K)
    np.testing.assert_allclose(local.gain[0], K, rtol=1e-9)
    assert local.multiplier == pytest.approx(np.abs(np.linalg.eigvals(A - B @ K)).max())
    x = np.array([[0.05, -0.1]])
    np.testing.assert_allclose(local(x, np.array([27])), np.clip(-x @ K.T, -1, 1), rtol=1e-9)


def test_the_regulator_of_a_periodic_orbit_solves_the_periodic_recursion():
    data = standard_map(50, local_controller={"kind": "lqr", "orbit": ORBIT})
    local = local_of(made(data))
    Q, R = np.diag([2500.0, 2500.0]), np.array([[4.0]])
    A = np.array([[1.0, 1.0], [0.0, 1.0]])
    B = [0.25 * s * np.ones((2, 1)) for s in (1.0, -1.0)]
    X = [Q, Q]
    for _ in range(2000):
        for k in (1, 0):
            after = X[(k + 1) % 2]
            K = np.linalg.solve(R + B[k].T @ after @ B[k], B[k].T @ after @ A)
            X[k] = Q + A.T @ after @ (A - B[k] @ K)
            np.testing.assert_array_equal(K.shape, (1, 2))
            if k == 0:
                K0 = K
            else:
                K1 = K
    np.testing.assert_allclose(local.gain, [K0, K1], rtol=1e-9)
    np.testing.assert_allclose(K0, -K1)  # the symmetry of the map


def test_the_orbit_of_the_standard_map_is_held_and_u_0_does_not_hold_it():
    held = lm.solve(made(standard_map(50, local_controller={"kind": "lqr", "orbit": ORBIT})))
    assert held.local_controller.proved == held.local_controller.cells == 4
    assert held.local_controller.kept == held.local_controller.samples
    assert held.local_controller.multiplier < 0.2
    runs = held.simulate(starts=500, hold=300)
    assert runs.reached == runs.held.stayed == 500
    assert runs.held.distance[1] < 1e-9
    drifting = lm.solve(made(standard_map(50, local_controller={"kind": "constant"})))
    assert drifting.local_controller.proved == 0
    assert drifting.local_controller.kept < 6000
    after = drifting.simulate(starts=500, hold=300).held
    assert after.stayed < 25
    assert after.returned + after.away > 475  # the other controller brings it back, again and again
    assert (after.lost, after.distance) == (0, None)
    assert held.cost == drifting.cost  # C1 knows nothing of C0
    np.testing.assert_array_equal(held.control_index, drifting.control_index)


def test_the_whole_feedback():
    result = lm.solve(made(standard_map(50, local_controller={"kind": "lqr", "orbit": ORBIT})))
    K = result.controller.local.gain
    x = np.array([[0.255, 0.49], [0.75, 0.51], [1.255, -0.51], [0.1, 0.1]])
    u = result.controller(x)
    assert u[0, 0] == pytest.approx(-(K[0] @ [0.005, -0.01])[0])
    assert u[1, 0] == pytest.approx(-(K[1] @ [0, 0.01])[0])
    assert u[2, 0] == pytest.approx(u[0, 0])  # axes wrap
    assert u[3, 0] == result.control_vectors[result.control_index[5 * 50 + 5], 0]


def test_controls_stay_in_their_range_and_owners_are_nearest():
    gain = {"u": {"x": [1000, -1000], "y": 0}}
    local = local_of(
        made(
            standard_map(
                50,
                local_controller={
                    "kind": "linear", "orbit": ORBIT, "control": {"u": 0.0}, "gain": gain,
                },
            )
        )
    )  # fmt: skip
    cells = np.flatnonzero(local.attractor)
    assert local.owner(cells).tolist() == [0, 0, 1, 1]
    x = local.partition.centres(cells) + np.array([0.001, 0])
    np.testing.assert_allclose(local(x, cells)[:, 0], [-0.5, -0.5, 0.5, 0.5])


def test_a_python_function_is_differentiated_too():
    def step(x, y, u):
        kick = 0.25 * u * np.sin(2 * np.pi * x)
        return x + y + kick, y + kick

    data = standard_map(50, local_controller={"kind": "lqr", "orbit": ORBIT})
    formula = local_of(made(data))
    problem = made(data).replaced(system=lm.systems.FunctionSystem(next=step))
    function = local_of(problem)
    np.testing.assert_allclose(function.gain, formula.gain, rtol=1e-7)
    found = examine(problem, function)
    assert (found.proved, found.kept) == (None, 10_000)


def test_a_saved_python_function_keeps_the_outer_controller(tmp_path):
    data = steps(local_controller={"kind": "lqr", "orbit": [[0.0]]})
    function = lm.systems.FunctionSystem(next=lambda x, u: [x - 0.25 * u])
    problem = made(data).replaced(system=function)
    result = lm.solve(problem)
    assert result.controller([[0.1]]) == pytest.approx(-0.1 * result.controller.local.gain[0, 0, 0])
    result.save(tmp_path / "out")
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.local_controller == result.local_controller
    assert np.isnan(loaded.controller([[0.1]])).all()
    assert loaded.controller([[0.3]]) == 1
    assert lm.verify(tmp_path / "out").holds


def test_noise_counts_at_every_node():
    data = linear_system([[0.5]], [[1.0]], cells=8, attractor={"boxes": [{"x0": [-0.25, 0.25]}]})
    data["system"]["next"]["x0"] += " + w"
    data["local_controller"] = {"kind": "linear", "orbit": [[0]], "gain": {"u0": {"x0": 0.25}}}
    for amplitude, proved in ((0.15, 2), (0.24, 0)):
        values = [-amplitude, amplitude]
        data["noise"] = {"w": {"values": values, "weights": [0.5, 0.5]}}
        problem = made(data)
        found = examine(problem, local_of(problem))
        assert found.proved == proved
        assert (found.kept == 10_000) == (proved == 2)


def test_it_survives_saving_and_a_false_one_is_found(tmp_path):
    data = standard_map(30, local_controller={"kind": "lqr", "orbit": ORBIT})
    problem = made(data)
    assert made(problem.to_dict()) == problem
    result = lm.solve(problem)
    result.save(tmp_path / "out")
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.local_controller == result.local_controller
    x = np.random.default_rng(0).random((200, 2))
    np.testing.assert_array_equal(loaded.controller(x), result.controller(x))
    assert lm.verify(tmp_path / "out").holds
    path = tmp_path / "out" / "certificate.json"
    good = json.loads(path.read_text())
    stored = good["local_controller"]
    for key, value in (("multiplier", stored["multiplier"] / 2), ("proved", stored["cells"] + 1),
                       ("kept", stored["kept"] + 1)):  # fmt: skip
        path.write_text(json.dumps({**good, "local_controller": {**stored, key: value}}))
        assert f"local_controller.{key}" in lm.verify(tmp_path / "out").reasons[0]
    for broken in ({}, [], {**stored, "proved": "all"}, {**stored, "more": 1}, "yes",
                   {**stored, "multiplier": 10**400}):  # fmt: skip
        path.write_text(json.dumps({**good, "local_controller": broken}))
        with pytest.raises(lm.BadInput, match="local_controller"):
            lm.Result.load(tmp_path / "out")
    del good["local_controller"]  # a result of an earlier version
    path.write_text(json.dumps(good))
    assert lm.Result.load(tmp_path / "out").local_controller is None


@pytest.mark.parametrize(
    ("local", "message"),
    [
        ({"kind": "pid"}, "'pid' is not a kind; the kinds are constant, linear, lqr"),
        ({"kind": "constant", "control": {"v": 0}}, "local_controller.control: 'v' is unknown"),
        ({"kind": "constant", "control": {"u": 2}}, "control.u: 2.0 is outside the control grid"),
        ({"kind": "lqr", "orbit": []}, "local_controller.orbit: "),
        ({"kind": "lqr", "orbit": [[0.25]]}, "orbit[0]: 1 coordinates for 2 axes"),
        ({"kind": "lqr", "orbit": [{"x": 0.25, "z": 0}]}, "a point names every axis"),
        ({"kind": "lqr", "orbit": [[0.25, 0.5]]}, "orbit: point 0 is mapped to [0.75, 0.5], 25"),
        ({"kind": "lqr", "orbit": [[0.1, 0.5], [0.6, 0.5]]}, "orbit[0]: the point lies in no"),
        ({"kind": "lqr", "orbit": ORBIT, "state_weights": {"x": 0}}, "state_weights.x: 0"),
        ({"kind": "lqr", "orbit": ORBIT, "state_weights": {"u": 1}}, "state_weights: 'u' is"),
        ({"kind": "lqr", "orbit": ORBIT, "control": {"u": [0]}}, "control.u: 1 values for 2"),
        ({"kind": "linear", "orbit": ORBIT, "gain": {"x": {}}}, "gain: 'x' is unknown"),
        ({"kind": "linear", "orbit": ORBIT, "gain": {"u": {"x": [1, 2, 3]}}}, "gain.u.x: 3 values"),
        ({"kind": "lqr", "orbit": [[0.25, 0.5]] * 65}, "local_controller.orbit"),
    ],
)  # fmt: skip
def test_bad_ones_are_refused(local, message):
    with pytest.raises(lm.BadInput) as caught:
        lm.compile(made(standard_map(50, local_controller=local)))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_regulated_is_refused():
    data = linear_system([[2.0, 0.0], [0.0, 0.5]], [[0.0], [1.0]])
    data["local_controller"] = {"kind": "lqr", "orbit": [[0, 0]]}
    with pytest.raises(lm.BadInput, match="cannot stabilize the linearisation"):
        lm.compile(made(data))


def test_a_jump_at_the_orbit_cannot_be_linearised():
    data = linear_system([[0.5]], [[1.0]])
    data["system"]["next"]["x0"] += " + 0.1*sign(x0)"
    data["local_controller"] = {"kind": "lqr", "orbit": [[0]]}
    with pytest.raises(lm.BadInput, match="not differentiable"):
        lm.compile(made(data))


def test_the_autonomous_case():
    data = doubling(attractor={"points": [[0.0]]}, local_controller={"kind": "lqr", "orbit": [[0]]})
    local = local_of(made(data))
    assert local.gain.shape == (1, 0, 1)
    assert local.multiplier == pytest.approx(2.0)

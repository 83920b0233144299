"""Local controllers: the regulator, the whole feedback, and what is proved of it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from local_controllers import ORBIT, linear_system, local_of
from problems import doubling, made, standard_map, steps

import lmdsl as lm
from lmdsl.control.invariance import check
from lmdsl.formulas.enclosures import Jet, apply
from lmdsl.formulas.intervals import Interval


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
    found = check(problem, function)
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
        found = check(problem, local_of(problem))
        assert found.proved == proved
        assert (found.kept == 10_000) == (proved == 2)


@pytest.mark.long
@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_what_is_proved_holds_at_every_point(seed):
    rng = np.random.default_rng(seed)
    d = int(rng.integers(1, 3))
    A = (rng.standard_normal((d, d)) * rng.choice([0.3, 0.8])).round(3).tolist()
    B = rng.standard_normal((d, 1)).round(3).tolist()
    data = linear_system(A, B, cells=int(rng.choice([4, 8])))
    if rng.random() < 0.5:
        data["on_exit"] = "clip"
    if rng.random() < 0.3:
        for axis in data["state_box"].values():
            axis["periodic"] = True
        data.pop("on_exit", None)
    if rng.random() < 0.7:
        bend = rng.choice(["sin(3*x0) - 3*x0", "abs(x0)", "0.3*x0**2", "min(x0, 0)*x0"])
        data["system"]["next"]["x0"] += f" + {float(rng.choice([0.3, 1.0]))!r}*({bend})"
    gain = {"u0": {f"x{i}": float(rng.standard_normal()) for i in range(d)}}
    data["local_controller"] = {"kind": "linear", "orbit": [[0] * d], "gain": gain}
    problem = made(data)
    local = local_of(problem)
    found = check(problem, local)
    # An independent count: cells none of whose many points, rim included, leaves A.
    partition = local.partition
    cells = np.flatnonzero(local.attractor)
    ticks = np.linspace(0, 1, 41)
    offsets = np.stack(np.meshgrid(*[ticks] * d), axis=-1).reshape(-1, d)
    good = 0
    for cell in cells:
        corner = partition.low + np.array(partition.multi_index(np.array([cell]))).T[0] * 2 / (
            partition.cells
        )
        x = corner + offsets * partition.width
        u = np.clip(-sum(local.gain[0, 0, i] * x[:, i] for i in range(d)), -1, 1)
        values = {f"x{i}": x[:, i] for i in range(d)} | {"u0": u}
        target = partition.locate([np.broadcast_to(y, len(x)) for y in problem.step()(values)])
        good += bool(((target >= 0) & local.attractor[target]).all())
    assert found.proved <= good
    assert not (found.kept < found.samples and found.proved == found.cells)
    if good == 0:
        assert found.kept < found.samples


def test_a_contraction_is_proved_and_an_expansion_is_not():
    for factor, proved in ((0.5, 4), (0.999, 4), (1.001, 0)):
        rotation = (factor / np.sqrt(2) * np.array([[1, -1], [1, 1]])).tolist()
        for system, count in ((np.diag([factor, factor]).tolist(), proved), (rotation, None)):
            data = linear_system(system, [[0.0], [0.0]])
            data["local_controller"] = {"kind": "linear", "orbit": [[0, 0]], "gain": {}}
            problem = made(data)
            found = check(problem, local_of(problem))
            if count is not None:
                assert found.proved == count


def test_the_law_has_no_jump_inside_a_cell_of_a_circle():
    # One cell straddles the far side of the circle from its orbit point.
    data = doubling(attractor={"cells": [[0], [1]]})
    data["system"]["next"] = {"x": "0.2 + 0*x"}
    data["state_box"]["x"]["cells"] = 3
    data["control_grid"] = {"u": {"values": [-9, 9]}}
    data["local_controller"] = {"kind": "linear", "orbit": [[0.2]], "gain": {"u": {"x": 1}}}
    local = local_of(made(data))
    x = np.linspace(0.34, 0.66, 33)[:, None]
    u = local(x, np.ones(33, dtype=np.int64))[:, 0]
    np.testing.assert_allclose(u, 0.2 - x[:, 0])


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
        ({"kind": "pid"}, "'kind' is missing or unknown; known kinds: constant"),
        ({"kind": "constant", "control": {"v": 0}}, "local_controller.control: 'v' is unknown"),
        ({"kind": "constant", "control": {"u": 2}}, "control.u: 2.0 is outside the control grid"),
        ({"kind": "lqr", "orbit": []}, "local_controller.orbit: "),
        ({"kind": "lqr", "orbit": [[0.25]]}, "orbit[0]: 1 coordinates for 2 axes"),
        ({"kind": "lqr", "orbit": [{"x": 0.25, "z": 0}]}, "orbit[0]: a point names every axis"),
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


@pytest.mark.long
def test_a_long_enclosure_stops_in_time(monkeypatch):
    text = " + ".join(["0.001*sin(x0)"] * 150)
    data = linear_system([[0.5]], [[1.0]], cells=2000)
    data["attractor"] = {"boxes": [{"x0": [-0.9, 0.9]}]}
    data["system"] = {"kind": "ode", "derivative": {"x0": f"u0 - x0 + {text}"}, "step": 1e-6,
                      "substeps": 1000}  # fmt: skip
    data["local_controller"] = {"kind": "constant"}
    problem = made(data)
    found = check(problem, local_of(problem))
    assert (found.cells, found.proved, found.kept) == (1800, 0, 10_000)  # nothing is claimed
    data["system"] = {"kind": "map", "next": {"x0": "0.5*x0"}}
    data["state_box"]["x0"]["cells"] = 100_000
    problem = made(data)
    assert check(problem, local_of(problem)).proved == 90_000
    monkeypatch.setattr("lmdsl.control.invariance.WORK", 1e5)
    found = check(problem, local_of(problem))
    assert 0 < found.proved < found.cells  # what the work allowed


def test_the_autonomous_case():
    data = doubling(attractor={"points": [[0.0]]}, local_controller={"kind": "lqr", "orbit": [[0]]})
    local = local_of(made(data))
    assert local.gain.shape == (1, 0, 1)
    assert local.multiplier == pytest.approx(2.0)


def held(text, axis, cells, **more):
    """One axis, one map, A and the constant control."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": axis},
        "attractor": {"cells": [[k] for k in cells]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
        "local_controller": {"kind": "constant"},
        **more,
    }


CIRCLE = {"low": 0, "high": 1, "cells": 10, "periodic": True}
SEAM = "where(x > 0.5, where(x > 0.9, 0.55, 0.99999999999), 0.05)"
CANCELLED = (
    "5.000001 + 140737206880349.36*(((5.1020070614639586e-14*(x - 5) + -4.095844186343325e-14) - "
    "(((5.1020070614639586e-14*(x - 5) + -4.095844186343325e-14) + 32.0) - 32.0)) - "
    "(-4.790265519712003e-15))"
)
FINE = {"low": -3, "high": 5, "cells": 10_000_000}


@pytest.mark.parametrize(
    ("text", "axis", "cells", "proved"),
    [
        # A state near `high` lies in the first cell; -1e-11 becomes 1 - 1e-11, and so on.
        (SEAM, CIRCLE, [0], 0),
        ("where(x > 0.5, where(x > 0.9, 0.05, 0.99999999999), 0.05)", CIRCLE, [0], 1),
        ("where(x > 0.9, 0.55, -1e-11)", CIRCLE, [0], 0),
        ("where(x > 0.5, 3.05, 0.05)", CIRCLE, [0], 1),  # whole turns
        ("0.05 + 0.5*floor(x)", CIRCLE, [0], 0),  # the state may be exactly 1
        ("0.05 + 2e6*(1 + x)", CIRCLE, [0], 0),  # too many turns away
        ("0.05 + 1e6 + 0*x", CIRCLE, [0], 1),
        # What is left of the sum is rounding: the real map keeps the cell, the computed does not.
        (
            f"where(abs(x - 5.5) < 0.6, {CANCELLED}, 5.5)",
            {"low": 0, "high": 10, "cells": 10},
            [5],
            0,
        ),
        ("5.5 + 5e15*((x + 32) - 32 - x)", {"low": 0, "high": 10, "cells": 10}, [5], 0),
        ("5.5 + 1e13*((x + 32) - 32 - x)", {"low": 0, "high": 10, "cells": 10}, [5], 1),
        # One double of the cell lies outside of [low + i width, low + (i + 1) width] by rounding.
        (
            "where(x == 4.931865599999997, 4.9318675999999995, 4.931865999999999)",
            FINE,
            [9914832],
            0,
        ),
        ("where(x < 4.9, 4.9318675999999995, 4.931865999999999)", FINE, [9914832], 1),
        ("4.931866 + 0.1*(x - 4.931866)", FINE, [9914832], 1),
    ],
)
def test_a_proof_is_of_every_state_and_of_the_map_as_computed(text, axis, cells, proved):
    problem = made(held(text, axis, cells))
    found = check(problem, local_of(problem))
    assert found.proved == proved
    if proved == found.cells:
        assert found.kept == found.samples
    assert "proved to be kept (by the map as computed)" in found.sentence()


def states_at(partition, cell, rng):
    """States of a cell: inside, and up to the last double at its edges and across the seam."""
    low, high, _ = partition.domain(np.array([cell]))
    rows = []
    for a, b in zip(low, high, strict=True):
        share = rng.choice([0.0, 1e-9, 1e-6, 1 - 1e-6, 1 - 1e-9, 1.0, np.nan], (400, len(a)))
        share = np.where(np.isnan(share), rng.random(share.shape), share)
        x = a + share * (b - a)
        for _ in range(4):
            x = np.where(rng.random(x.shape) < 0.5, np.nextafter(x, rng.choice([-9.0, 9.0])), x)
        rows.append(x)
    x = partition.states(np.concatenate(rows))
    return x[partition.locate(list(x.T)) == cell]


def random_held(rng):
    """A map that keeps A, or nearly, on an axis that makes that hard to tell."""
    low = float(rng.choice([0.0, -1.0, 3.3, -np.pi, 1e5]))
    span = float(rng.choice([1.0, 2 * np.pi, 8.0, 1e-3]))
    n = int(rng.choice([3, 10, 1000, 10**6]))
    n = n if span / n > 1e-12 * (abs(low) + span) else 10
    kind = rng.choice(["interval", "circle", "clip"])
    width = span / n
    cell = int(rng.choice([0, n // 2, n - 1]))
    middle = low + (cell + 0.5) * width
    spread = float(rng.choice([0.3, 0.9, 0.99, 0.999999, 1.0, 1.000001]))
    turns = int(rng.choice([0, 0, 1, -3, 1000])) if kind == "circle" else 0
    away = f"(x - {middle!r})"
    if kind == "circle":  # the part near `high` of the first cell
        away = f"where(x - {middle!r} > {span / 2!r}, x - {middle!r} - {span!r}, x - {middle!r})"
    text = f"{middle + turns * span!r} + {spread!r}*{away}"
    bend = rng.random()
    if bend < 0.3:
        big = float(rng.choice([32.0, 1e6, 2.0**40]))
        size = float(width / (big * 2.0**-52) * rng.choice([0.01, 0.3, 1.0]))
        text += f" + {size!r}*(((x + {big!r}) - {big!r}) - x)"
    elif bend < 0.5:
        text += f" + {float(width) * 0.3!r}*sin({1 / width!r}*{away})"
    axis = {"low": low, "high": low + span, "cells": n, "periodic": kind == "circle"}
    return held(text, axis, [cell], on_exit="clip" if kind == "clip" else "forbid"), cell


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.long)])
def test_no_state_of_a_proved_cell_leaves(seed):
    rng = np.random.default_rng(seed)
    proved = broken = 0
    for _ in range(1000 if seed else 300):
        data, cell = random_held(rng)
        problem = made(data)
        local = local_of(problem)
        found = check(problem, local, samples=10)
        x = states_at(local.partition, cell, rng)
        images = problem.step()({"x": x[:, 0]})
        stays = (local.partition.locate(images) == cell).all()
        assert not (found.proved and not stays), data
        proved += found.proved
        broken += not stays
    assert min(proved, broken) > 0.2 * (1000 if seed else 300)


def test_the_law_is_enclosed_as_it_is_computed():
    data = standard_map(20, local_controller={"kind": "lqr", "orbit": ORBIT})
    data["state_box"]["x"].update(low=-0.5, high=0.5)
    data["attractor"] = {"cells": [[0, 9], [0, 10], [19, 10], [5, 10]]}
    data["local_controller"]["orbit"] = [{"x": -0.25, "y": 0.5}, {"x": 0.25, "y": 0.5}]
    data["attractor"]["cells"] += [[4, 9], [4, 10], [14, 10], [15, 9], [15, 10]]
    problem = made(data)
    local = local_of(problem)
    cells = np.flatnonzero(local.attractor)
    low, high, owner = local.partition.domain(cells)
    rng = np.random.default_rng(0)
    box = Interval(low, high)
    jets = [Jet.variable(Interval(low[:, i], high[:, i]), i, 2) for i in range(2)]

    def on_jets(operation, *operands):
        return apply(operation, [x if isinstance(x, Jet) else Jet.constant(x, 2) for x in operands])

    (law,) = local.law(jets, cells[owner], on_jets)
    assert np.isfinite(law.value.low).all()
    for _ in range(300):
        x = low + rng.random(low.shape) * (high - low)
        u = local(x, cells[owner])[:, 0]
        assert ((u >= law.value.low) & (u <= law.value.high)).all()
    assert box.low.shape == (len(cells) + 2, 2)  # two of the cells lie at the seam

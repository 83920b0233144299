"""Runs of the true differential equation: their whole path, and noise from its distribution."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import run
from problems import made, steps
from scipy.integrate import solve_ivp

import lmdsl as lm
from lmdsl.control.integration import Integrator
from lmdsl.control.steps import Drawn
from lmdsl.model.true_map import TrueMap


def gliding(**more):
    """x' = u from 0 to 10 by steps of 2 cells; A is [0, 1], and v drifts."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "derivative": {"x": "u", "v": "0.3"}, "step": 2.0},
        "state_box": {"x": {"low": 0, "high": 10, "cells": 10},
                      "v": {"low": 0, "high": 1, "cells": 4, "periodic": True}},
        "attractor": {"boxes": [{"x": [0, 1]}]},
        "control_grid": {"u": {"values": [-1, 1]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2, "corners": True},
        **more,
    }  # fmt: skip


def moved(data, x, u, absorb=True, pieces=0):
    problem = made(data)
    lp = lm.compile(problem)
    integrator = Integrator(TrueMap(lp.problem, lp.partition), lp.cell_status)
    x, u = np.array(x, dtype=float), np.array(u, dtype=float)
    values = dict(zip(("x", "v", "u"), (*x.T, *u.T), strict=True))
    return integrator.move(values, lambda: None, absorb, pieces), lp


def test_events_end_a_step_where_they_happen():
    """To A at x = 1, to an obstacle of a cell's width, out of the box, or nowhere: to 1e-8."""
    data = gliding(avoid={"boxes": [{"x": [4, 5], "v": [0, 1]}]})
    x = [[2.5, 0.1], [5.5, 0.9], [3.5, 0.2], [9.25, 0.5], [7.5, 0.95]]
    found, lp = moved(data, x, [[-1], [-1], [1], [1], [1]])
    assert found.state[:, 0] == pytest.approx([1, 5, 4, 10, 9.5], abs=2e-8)
    time = np.array([1.5, 0.5, 0.5, 0.75, 2.0])
    assert found.state[:, 1] == pytest.approx((np.array(x)[:, 1] + 0.3 * time) % 1, abs=2e-8)
    status = [lp.cell_status[c] if c >= 0 else -1 for c in found.cell]
    assert status[:4] == [0, 5, 5, -1]
    assert found.cell[4] == lp.partition.locate(list(found.state[4:].T))[0]


def test_an_obstacle_between_two_ends_is_met_only_on_the_path():
    data = gliding(avoid={"boxes": [{"x": [4, 5], "v": [0, 1]}]})
    data["system"]["judged"] = "endpoint"
    found, lp = moved(data, [[5.5, 0.1], [0.5, 0.1]], [[-1], [-1]])
    assert found.state[:, 0] == pytest.approx([3.5, -1.5])
    assert lp.cell_status[found.cell[0]] not in (0, 5)
    assert found.cell[1] == -1


def test_the_box_may_be_left_on_the_way_under_clip():
    data = gliding(on_exit="clip")
    data["system"]["derivative"]["x"] = "u*sin(pi*v)"
    found, _ = moved(data, [[9.5, 0.1]], [[1]])
    assert found.state[0, 0] == 10.0
    assert found.cell[0] >= 0


def test_a_step_within_the_attractor_goes_to_its_end():
    found, lp = moved(gliding(), [[0.5, 0.1], [1.5, 0.1]], [[1], [-1]], absorb=False)
    assert found.state[0, 0] == pytest.approx(2.5)
    assert found.cell[1] == -1  # it runs through A, out of the box
    assert lp.cell_status[found.cell[0]] == 1


def test_the_start_is_not_judged():
    found, lp = moved(gliding(), [[1.0, 0.1], [1.0, 0.1]], [[1], [-1]])
    assert found.state[:, 0] == pytest.approx([3.0, 1.0], abs=2e-8)
    assert lp.cell_status[found.cell].tolist() == [1, 0]


def test_states_within_a_step_lie_at_equal_times():
    found, _ = moved(gliding(), [[6.5, 0.9], [2.5, 0.0]], [[-1], [-1]], pieces=7)
    assert found.drawn[:, 0, 0] == pytest.approx(6.5 - 0.25 * np.arange(1, 8), abs=1e-8)
    after = np.maximum(2.5 - 0.25 * np.arange(1, 8), 1.0)  # it ends in A after 1.5
    assert found.drawn[:, 1, 0] == pytest.approx(after, abs=2e-8)


def test_costs_run_until_the_event():
    """Rate 1 + x along -1 from s to 1, by its integral; the terminal cost once, times gamma."""

    def integral(s, end):
        return s - end + (s**2 - end**2) / 2

    data = gliding(cost_rate="1 + x", terminal_cost="5 + x", gamma=1.5)
    del data["stage_cost"]
    found, _ = moved(data, [[2.5, 0.1], [6.5, 0.1]], [[-1], [-1]])
    assert found.cost == pytest.approx([integral(2.5, 1), integral(6.5, 4.5)], rel=1e-7)
    loop = lm.solve(made(data)).closed_loop
    runs = loop.run(np.array([[2.5, 0.1], [4.5, 0.1]]), 9, np.random.default_rng(0))
    first, second = integral(2.5, 1), integral(4.5, 2.5)
    exact = [first + 1.5 * 6, second + 1.5 * first + 1.5**2 * 6]
    assert runs.cost == pytest.approx(exact, rel=1e-7)


def dubins():
    """A car among two obstacles, on few cells."""
    return {
        "format": "lmdsl/1",
        "system": {"kind": "ode", "derivative": {"x": "cos(th)", "y": "sin(th)", "th": "u"},
                   "step": 0.6, "substeps": "auto"},
        "state_box": {"x": {"low": 0, "high": 4, "cells": 16},
                      "y": {"low": 0, "high": 4, "cells": 16},
                      "th": {"low": 0, "high": 6.283185307179586, "cells": 12, "periodic": True}},
        "attractor": {"boxes": [{"x": [3, 4], "y": [3, 4]}]},
        "avoid": {"boxes": [{"x": [1.1, 1.3], "y": [0.5, 2]}, {"x": [2.2, 2.4], "y": [2, 3.5]}]},
        "control_grid": {"u": {"values": [-1.5, 0, 1.5]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
    }  # fmt: skip


@pytest.mark.parametrize("judged", ["path", "endpoint"])
def test_every_run_ends_as_scipy_says(judged):
    """Each step again by solve_ivp, at 2,000 places, located by the documented rule alone."""
    data = dubins()
    data["system"]["judged"] = judged
    result = lm.solve(made(data))
    assert result.verified
    p = result.partition
    rng = np.random.default_rng(3)
    cells = np.flatnonzero(result.cell_status == 1)
    cell = cells[rng.integers(len(cells), size=60)]
    x = p.low + (np.stack(p.multi_index(cell), axis=-1) + rng.random((60, 3))) * p.width
    found = result.closed_loop.move(x, cell, rng)
    u = result.controller(x)
    kinds = {0: 0, 1: 0, 5: 0, -1: 0}
    for k in range(60):
        at = [1.0] if judged == "endpoint" else np.arange(1, 2001) / 2000
        solution = solve_ivp(
            lambda t, y, k=k: [np.cos(y[2]), np.sin(y[2]), u[k, 0]], (0, 0.6), x[k],
            method="DOP853", rtol=1e-11, atol=1e-11, dense_output=True,
        )  # fmt: skip
        way = solution.sol(0.6 * np.array(at)).T
        index = np.floor((way[:, :2]) / 0.25 + 1e-9).astype(int)
        inside = ((index >= 0) & (index < 16)).all(axis=1)
        angle = np.floor((way[:, 2] % (2 * np.pi)) / (2 * np.pi / 12) + 1e-9).astype(int) % 12
        flat = np.where(inside, (index[:, 0] * 16 + index[:, 1]) * 12 + angle, 0)
        code = np.where(inside, result.cell_status[flat].astype(int), -1)
        events = np.flatnonzero(np.isin(code, (0, 5, -1)))
        first = events[0] if len(events) else len(way) - 1
        mine = result.cell_status[found.cell[k]] if found.cell[k] >= 0 else -1
        if code[first] in (0, 5, -1):
            assert mine == code[first]
            assert found.state[k, :2] == pytest.approx(way[first, :2], abs=1e-3)
            kinds[int(mine)] += 1
        else:
            assert mine not in (0, 5, -1)
            assert found.state[k, :2] == pytest.approx(way[-1, :2], abs=1e-7)
    assert kinds[0] > 3


def test_the_report_says_what_was_followed_and_where_runs_were_lost(tmp_path, capsys):
    data = dubins()
    data["system"]["judged"] = "endpoint"
    result = lm.solve(made(data))
    assert result.problem.system.substeps == 1
    result.save(tmp_path / "out")
    _, out, _ = run(capsys, "simulate", str(tmp_path / "out"), "--starts", "500", "--json")
    report = json.loads(out)
    assert sum(report["lost_to"].values()) == report["lost"]
    assert report["method"].startswith("DOP853")
    _, out, _ = run(
        capsys, "simulate", str(tmp_path / "out"), "--starts", "500", "--json", "--as-compiled"
    )
    compiled = json.loads(out)
    assert compiled["method"] == "as compiled: Runge-Kutta steps, 1 per sampling time"
    _, out, _ = run(capsys, "simulate", str(tmp_path / "out"), "--starts", "500")
    assert "  followed               DOP853, errors controlled per run, tolerance 1e-09" in out
    kinked = dubins()
    kinked["system"]["derivative"]["x"] = "cos(th) + 0*abs(x)"
    runs = lm.solve(made(kinked)).simulate(50, 200)
    assert runs.method.startswith("16 fixed Runge-Kutta steps per sampling time")


def test_a_judged_car_with_corners_touches_no_obstacle():
    data = dubins()
    data["sampling"]["corners"] = True
    runs = lm.solve(made(data)).simulate(1000, 500)
    assert (runs.lost, runs.cycling) == (0, 0)


def test_far_too_few_steps_are_found_out():
    """The van der Pol oscillator, one Runge-Kutta step of 0.4: verified, and not true."""
    data = dict(lm.systems.VanDerPol.problem)
    data["system"] = {"kind": "van_der_pol", "parameters": {"mu": 2}, "step": 0.4, "substeps": 1}
    data["state_box"] = {"x": {"low": -3, "high": 3, "cells": 60},
                         "v": {"low": -8, "high": 8, "cells": 60}}  # fmt: skip
    result = lm.solve(made(data))
    assert result.verified
    assert result.integration_error.excessive
    assert "more than a tenth of a cell" in result.message
    true, compiled = (result.simulate(1000, 1000, as_compiled=c) for c in (False, True))
    assert true.reached < 0.95 * 1000 < 0.99 * 1000 < compiled.reached


def noisy(noise, text="0.5 + w"):
    return steps(
        system={"kind": "map", "next": {"x": text}}, control_grid={}, noise={"w": noise},
        state_box={"x": {"low": 0, "high": 1, "cells": 10}},
    )  # fmt: skip


NOISES = [
    ({"normal": {"std": 0.05, "points": 3}}, 0.0, 0.05),
    ({"normal": {"std": 0.05, "points": 3, "within": 3.0}}, 0.0, 0.05),
    ({"uniform": {"low": -0.2, "high": 0.4, "points": 4}}, 0.1, 0.6 / 12**0.5),
    ({"values": [0.0, 0.3], "weights": [0.75, 0.25]}, 0.075, 0.3 * (3 / 16) ** 0.5),
]


@pytest.mark.parametrize(("noise", "mean", "deviation"), NOISES)
def test_noise_comes_from_its_distribution(noise, mean, deviation):
    problem = made(noisy(noise))
    count = 40_000
    (drawn,) = Drawn(problem, False)(np.random.default_rng(1), count)
    (nodes,) = Drawn(problem, True)(np.random.default_rng(1), count)
    assert drawn.mean() == pytest.approx(mean, abs=5 * deviation / count**0.5)
    assert drawn.std() == pytest.approx(deviation, rel=0.03)
    kinds = len(noise.get("values", ())) or 40_000
    assert len(np.unique(drawn)) == pytest.approx(kinds, rel=0.001)
    assert set(np.unique(nodes)) == set(problem.noise["w"].nodes()[0])
    assert nodes.mean() == pytest.approx(mean, abs=5 * deviation / count**0.5)


def test_uniform_nodes_are_midpoints_of_equal_weight():
    noise = made(noisy({"uniform": {"low": -1, "high": 2, "points": 3}})).noise["w"]
    values, weights = noise.nodes()
    assert values == pytest.approx([-0.5, 0.5, 1.5])
    assert weights == pytest.approx([1 / 3] * 3)
    low, high = noise.parts()
    assert (low.min(), high.max()) == (-1, 2)
    low, high = made(noisy(NOISES[1][0])).noise["w"].parts()
    assert (low.min(), high.max()) == pytest.approx((-0.15, 0.15))


def test_costs_are_compared_with_the_certificate():
    """On x+ = x - 0.25 u the finite model is exact: every run pays V of its cell."""
    for gamma in (1.0, 1.3, 0.5):
        for more in ({}, {"terminal_cost": "2"}):
            result = lm.solve(made(steps(gamma=gamma, **more)))
            x = np.array([[0.3], [0.6], [0.9]])
            runs = result.closed_loop.run(x, 9, np.random.default_rng(0))
            assert runs.cost == pytest.approx(result.value[1:], rel=1e-12)
            found = result.simulate(4000, 9).cost
            assert abs(found["mean"] - result.cost) < 5 * found["standard_error"] + 1e-12
    one = lm.solve(made(steps())).simulate(1, 9).cost
    assert one["standard_error"] is None
    assert lm.solve(made(steps(measure={"boxes": [{"x": [0.75, 1]}]}))).simulate(9, 1).cost is None


def test_as_compiled_is_the_compiled_map():
    """Judged places, nodes and weights: the share of runs absorbed in a step is that of a row."""
    data = gliding(noise={"w": {"normal": {"std": 0.4, "points": 3}}},
                   measure={"boxes": [{"x": [2, 3], "v": [0, 0.25]}]})  # fmt: skip
    data["system"]["derivative"]["x"] = "0.6*u + w"
    data["sampling"] = {"kind": "random", "points": 4000, "seed": 1}
    data["on_exit"] = "clip"
    result = lm.solve(made(data))
    (cell,) = np.flatnonzero(result.weight)
    column = result.lp.column(cell, result.control_index[cell])
    share = result.lp.rows.take(np.array([column])).matrix().sum()
    runs = result.simulate(20_000, 1, as_compiled=True)
    assert runs.reached / 20_000 == pytest.approx(1 - share, abs=0.02)

"""The reference itself: answers by hand, in closed form, by exact brute force, and by an LP."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from random_problems import CORNER_CASES
from reference import (
    Axis,
    attractor_cells,
    compile_reference,
    control_vectors,
    flat,
    formula,
    gamma_bracket,
    next_state_function,
    noise_nodes,
    sample_offsets,
    solve_reference,
    unflat,
)

CASES = {problem["name"]: problem for problem in CORNER_CASES}


def problem_of(text, cells, periodic=False, **more):
    problem = {
        "format": "lmdsl/1",
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": {"low": 0, "high": 1, "cells": cells, "periodic": periodic}},
        "attractor": {"cells": [[0]]},
        "control_grid": {},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
    }
    return problem | more


# closed forms ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gamma", [0.25, 0.9, 1, 1.02, 3])
@pytest.mark.parametrize("per_axis", [1, 2, 5])
def test_a_shift_pays_once_a_step(gamma, per_axis):
    control = {"u": {"low": 0, "high": 1, "points": 2}}
    sampling = {"kind": "grid", "per_axis": per_axis}
    problem = problem_of("x - 0.25*u", 4, control_grid=control, sampling=sampling, gamma=gamma)
    solution = solve_reference(compile_reference(problem))
    assert solution.status == "ok"
    assert pytest.approx({1: 1, 2: 1 + gamma, 3: 1 + gamma + gamma**2}, rel=1e-14) == solution.V
    assert solution.cost == pytest.approx((3 + 2 * gamma + gamma**2) / 3, rel=1e-14)
    if gamma >= 1:
        assert solution.policy == {1: 1, 2: 1, 3: 1}
        assert solution.gamma_bar == (math.inf, math.inf)


@pytest.mark.parametrize("gamma", [0.5, 1, 1.5, 1.99])
@pytest.mark.parametrize("per_axis", [2, 6])
def test_the_doubling_map_halves_what_is_left(gamma, per_axis):
    sampling = {"kind": "grid", "per_axis": per_axis}
    model = compile_reference(problem_of("2*x", 2, True, sampling=sampling))
    assert model.rows == {(1, 0): ({1: Fraction(1, 2)}, Fraction(1, 2), Fraction(0))}
    solution = solve_reference(model, gamma)
    assert pytest.approx({1: 1 / (1 - gamma / 2)}, rel=1e-13) == solution.V
    assert solution.gamma_bar == pytest.approx((2, 2), rel=1e-9)


@pytest.mark.parametrize("gamma", [2, 2.5, 3])
def test_the_doubling_map_from_gamma_two_on(gamma):
    solution = solve_reference(compile_reference(problem_of("2*x", 2, True)), gamma)
    assert (solution.status, solution.decided) == ("not_stabilizable", True)


def test_one_step_of_runge_kutta():
    system = {"kind": "ode", "derivative": {"x": "-a*x"}, "parameters": {"a": 2}, "step": 0.6}
    for substeps in (1, 3):
        image = next_state_function(problem_of("", 4, system=system | {"substeps": substeps}))
        z = -2 * 0.6 / substeps
        growth = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
        assert image({"x": 0.7}) == pytest.approx([0.7 * growth**substeps], rel=1e-14)


def test_hermite_nodes_have_the_moments_of_the_normal():
    nodes = noise_nodes({"noise": {"w": {"normal": {"std": 0.3, "points": 5}}}})
    moments = [math.fsum(p * v**k for (v,), p in nodes) for k in range(7)]
    assert moments == pytest.approx([1, 0, 0.09, 0, 3 * 0.3**4, 0, 15 * 0.3**6], abs=1e-15)


def test_one_recurrent_class_of_growth_nine_tenths_and_one_of_three_tenths():
    """Cell 1 stays with 0.9, cell 2 with 0.3, both else go to A: gamma_bar is 10/9."""
    noise = {"w": {"values": list(range(10)), "weights": [0.1] * 10}}
    text = "where(x < 0.66, where(w < 9, x, 0.1), where(w < 3, x, 0.1))"
    model = compile_reference(problem_of(text, 3, noise=noise))
    low, high, _, _ = gamma_bracket(model)
    assert low <= 10 / 9 * (1 + 1e-15)
    assert (low, high) == pytest.approx((10 / 9, 10 / 9), rel=1e-8)
    assert pytest.approx({1: 1 / 0.01, 2: 1 / 0.67}, rel=1e-12) == solve_reference(model, 1.1).V


def test_a_chain_of_classes_of_equal_growth():
    """Cell k stays with 1/2, else goes to k - 1: V_k = (1 + gamma V_(k-1)/2) / (1 - gamma/2)."""
    noise = {"w": {"values": [0, 1], "weights": [0.5, 0.5]}}
    model = compile_reference(problem_of("x - w/8", 8, noise=noise))
    assert solve_reference(model).gamma_bar == pytest.approx((2, 2), rel=1e-6)
    V, gamma = 0.0, 1.9
    expected = {k: (V := (1 + gamma * V / 2) / (1 - gamma / 2)) for k in range(1, 8)}
    assert pytest.approx(expected, rel=1e-12) == solve_reference(model, gamma).V


# the parts, by hand ---------------------------------------------------------------------------


def test_cells_of_images():
    axis = Axis("x", -1.0, 3.0, 4, False)
    given = [-1, -1 - 5e-10, -1 - 2e-9, 0, -2e-9, -5e-10, 3, 3 + 5e-10, 3 + 2e-9, 2.5, 1e300]
    assert [axis.cell_of(v) for v in given] == [0, 0, None, 1, 0, 1, 3, 3, None, 3, None]
    turn = Axis("x", -1.0, 3.0, 4, True)
    given = [-1, 3, -1 - 5e-10, -1 - 2e-9, 3 - 5e-10, 0.5 + 4e6, 0.5 - 4e6]
    assert [turn.cell_of(v) for v in given] == [0, 0, 0, 3, 0, 1, 1]
    assert axis.cell_of(math.nan) is None
    assert turn.cell_of(math.inf) is None


def test_cells_of_points_and_boxes():
    axis = Axis("x", -1.0, 3.0, 4, False)
    given = [-1, 0, 0.5, 1 + 5e-10, 1 + 2e-9, 3]
    assert [axis.touched_by(v) for v in given] == [[0], [0, 1], [1], [1, 2], [2], [3]]
    turn = Axis("x", -1.0, 3.0, 4, True)
    assert [turn.touched_by(v) for v in (-1, 3, 7, 0.5)] == [[0, 3], [0, 3], [0, 3], [1]]
    assert Axis("x", 0.0, 1.0, 1, True).touched_by(0) == [0]
    assert axis.inside(-1, 1) == axis.inside(-1 + 5e-10, 1.9) == [0, 1]
    assert axis.inside(-1 + 2e-9, 1) == [1]
    assert axis.overlapped(0.5, 1 + 5e-10) == [1]
    assert axis.overlapped(0.5, 1 + 2e-9) == [1, 2]


def test_orders_are_c_order():
    axes = [Axis("b", 0, 1, 2, False), Axis("a", 0, 1, 3, False), Axis("c", 0, 1, 4, False)]
    indices = list(itertools.product(range(2), range(3), range(4)))
    assert [unflat(axes, k) for k in range(24)] == indices
    assert [flat(axes, i) for i in indices] == list(range(24))
    grid = {"v": {"values": [2, -1]}, "u": {"low": 0, "high": 1, "points": 3}}
    vectors = control_vectors({"control_grid": grid})
    assert vectors == [(2, 0), (2, 0.5), (2, 1), (-1, 0), (-1, 0.5), (-1, 1)]
    assert control_vectors({"control_grid": {}}) == [()]
    noise = {n: {"values": [1, 2, 3], "weights": [0.5, 0, 0.5]} for n in "ab"}
    assert noise_nodes({"noise": noise}) == [((i, j), 0.25) for i in (1, 3) for j in (1, 3)]
    problem = {"state_box": {"x": {}, "y": {}}, "sampling": {"kind": "grid", "per_axis": 2}}
    assert sample_offsets(problem) == [(0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)]


def test_the_orbit_of_the_paper_touches_two_cells_a_point():
    axis = {"low": 0, "high": 1, "cells": 50, "periodic": True}
    points = [{"x": 0.25, "y": 0.5}, {"x": 0.75, "y": 0.5}]
    problem = {"state_box": {"x": axis, "y": axis}, "attractor": {"points": points}}
    assert attractor_cells(problem) == {12 * 50 + 24, 12 * 50 + 25, 37 * 50 + 24, 37 * 50 + 25}


def test_formulas_are_float64():
    names = {"x": np.float64(-2.0)}
    cases = {"x**2": 4.0, "-x**2": -4.0, "2**-1": 0.5, "7/2": 3.5, "1/(x + 2)": math.inf}
    cases |= {"where(x < 0, 1, 2)": 1.0, "min(x, 3) + max(x, 3)": 1.0, "atan2(0, x)": math.pi}
    for text, value in cases.items():
        assert formula(text)(names) == value
    for text in ("x**0.5", "sqrt(x)", "log(x)", "min(sqrt(x), 1)", "0/(x + 2)"):
        assert math.isnan(formula(text)(names))


# corner cases ---------------------------------------------------------------------------------

# name: cell_status, V (None: not stabilizable)
BY_HAND = {
    "shift": ([0, 1, 1, 1], {1: 1, 2: 2.5, 3: 4.75}),
    "point on an edge": ([0, 0, 1, 1], {2: 1, 3: 2}),
    "point at high": ([1, 1, 1, 0], {0: 3, 1: 2, 2: 1}),
    "point near an edge": ([0, 0, 1, 1], {2: 1, 3: 2}),
    "point not near an edge": ([3, 0, 1, 1], {2: 1, 3: 2}),
    "point on the seam": ([0, 1, 1, 0], {1: 1, 2: 2}),
    "point on a corner": (
        [3, 0, 0, 3, 3, 0, 0, 3, 3, 1, 1, 3, 3, 1, 1, 3],
        {9: 1, 10: 1, 13: 2, 14: 2},
    ),
    "box that nearly holds two cells": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "image on an edge": ([0, 3, 3, 3], None),
    "image at high": ([1, 1, 1, 0], {0: 3, 1: 2, 2: 1}),
    "image at low": ([3, 3, 3, 0], None),
    "images around edges": ([0, 1, 1, 3], {1: 1, 2: 1}),
    "one-cell axis": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "everything escapes": ([0, 2, 2, 2], None),
    "everything trapped": ([0, 3, 3, 3], None),
    "leads to these": ([0, 4, 4, 2, 4], None),
    "the risky shortcut does not survive": ([0, 1, 1, 3], {1: 1, 2: 2}),
    "half of it is trapped": ([0, 4, 4, 3], None),
    "values not sorted": ([0, 1, 1, 1], {1: 1, 2: 1, 3: 2}),
    "zero weight is dropped": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "small weight counts": ([0, 2, 2, 2], None),
    "weights that are not dyadic": ([0, 0, 1, 1], {2: 1 / 0.9, 3: (1 + 0.2 / 0.9) / 0.9}),
    "clip": ([0, 1, 1, 1], {1: 1, 2: 1, 3: 1}),
    "clip with avoid": ([0, 1, 1, 5], {1: 1, 2: 2}),
    "avoid touches without overlap": ([0, 1, 5, 3], {1: 1}),
    "clip does not save an infinite image": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 1}),
    "many turns": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "NaN for some controls": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "doubling map, gamma 0.5": ([0, 1], {1: 4 / 3}),
    "doubling map, gamma 1": ([0, 1], {1: 2}),
    "doubling map, gamma 1.5": ([0, 1], {1: 4}),
    "doubling map, gamma 2": ([0, 1], None),
    "doubling map, gamma 3": ([0, 1], None),
    "stay for free": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "stay for free, discounted": ([0, 1, 1, 1], {1: 0, 2: 0, 3: 0}),
    "stay for free, growing": ([0, 1, 1, 1], {1: 1, 2: 2.25, 3: 3.8125}),
    "all is free": ([0, 1, 1, 1], {1: 0, 2: 0, 3: 0}),
    "where as a box": ([0, 0, 1, 1, 1, 1], {2: 1, 3: 2, 4: 3, 5: 4}),
    "where on either side of the seam": ([0, 1, 5, 5, 5, 1, 1, 0], {1: 1, 5: 2, 6: 1}),
    "where, mod and not": ([0, 1, 0, 1, 1, 1, 1, 0], {1: 1, 3: 1, 4: 2, 5: 3, 6: 4}),
    # u = 2 is admissible in the cells 3 and 4 only; u = 1 costs 1.25, u = 2 costs 2
    "admissible by state": ([0, 1, 1, 1, 1], {1: 1.25, 2: 2.5, 3: 3.25, 4: 4.5}),
    "let in the map and the density": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
    "measure outside C": ([0, 1, 1, 3], None),
    "measure on one cell": ([0, 1, 1, 1], {1: 1, 2: 2, 3: 3}),
}


def test_every_corner_case_has_an_answer():
    assert set(CASES) == set(BY_HAND)
    assert len(CASES) == len(CORNER_CASES)


@pytest.mark.parametrize("name", CASES)
def test_corner_case(name):
    status, V = BY_HAND[name]
    model = compile_reference(CASES[name])
    solution = solve_reference(model)
    assert model.cell_status == status
    assert solution.status == ("not_stabilizable" if V is None else "ok")
    assert solution.decided
    assert pytest.approx(V or {}, rel=1e-12) == solution.V


def test_corner_cases_in_detail():
    model = compile_reference(CASES["images around edges"])
    assert {p for p in model.rows if p not in model.admissible} == {(2, 3), (3, 2)}
    assert [model.rows[1, u][1] for u in range(4)] == [0, 0, 1, 0]
    assert [model.rows[2, u][1] for u in range(4)] == [1, 1, 1, 0]
    model = compile_reference(CASES["NaN for some controls"])
    assert {p for p in model.rows if p not in model.admissible} == {(1, 0), (2, 0), (3, 0)}
    model = compile_reference(CASES["small weight counts"])
    assert 0 < model.rows[3, 0][2] < Fraction(1, 10**11)
    model = compile_reference(CASES["zero weight is dropped"])
    assert (model.S, model.points) == (1, 1)
    model = compile_reference(CASES["the risky shortcut does not survive"])
    assert (2, 1) in model.admissible
    assert (2, 1) not in model.surviving
    solution = solve_reference(compile_reference(CASES["measure on one cell"]))
    assert solution.cost == 2
    solution = solve_reference(compile_reference(CASES["stay for free, discounted"]))
    assert not solution.tied_policy_reaches
    solution = solve_reference(compile_reference(CASES["values not sorted"]))
    assert solution.ties == {1: {2}, 2: {0}, 3: {0, 2}}

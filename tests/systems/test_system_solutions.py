"""The systems known by name: controllers and costs that a specialist expects."""

import numpy as np
import pytest
from named_systems import NAMED, images, solved, variant

import lmdsl as lm

ATTRACTOR = 0


def control(result):
    """The control (of one dimension) on the grid of cells, NaN where there is none."""
    cells = np.arange(result.cells)
    return result.controller.at(cells)[:, 0].reshape(result.partition.shape)


def centres(result):
    cells = np.arange(result.cells)
    return result.partition.centres(cells).T.reshape(-1, *result.partition.shape)


def on_grid(result, array):
    return array.reshape(result.partition.shape)


def action_values(result):
    """Q of every surviving pair."""
    lp = result.lp
    return lp.gamma * (lp.P @ result.value[lp.cells]) + lp.c


def assert_mirrored(result, sign, image):
    """u at the image cell is sign times u, up to ties in Q; V is equal; C maps to itself."""
    lp, Q = result.lp, action_values(result)
    status = on_grid(result, result.cell_status)
    assert (status == image(status)).all()
    value = on_grid(result, result.value)
    inside = np.isfinite(value)
    np.testing.assert_allclose(image(value)[inside], value[inside], rtol=1e-9)
    # What the mirrored cell does, done here: it must be as good as what is done here.
    there = sign * image(control(result)).ravel()[lp.cells]
    grid = lp.controls[:, 0]
    index = np.abs(there[:, None] - grid).argmin(axis=1)
    np.testing.assert_allclose(grid[index], there, atol=1e-12 * np.abs(grid).max())
    pair = np.repeat(lp.cells, np.diff(lp.pair_pointer)) * len(grid) + lp.control  # ascending
    column = np.searchsorted(pair, lp.cells * len(grid) + index)
    assert (pair[column] == lp.cells * len(grid) + index).all()
    np.testing.assert_allclose(Q[column], result.value[lp.cells], rtol=1e-9)


# standard map ---------------------------------------------------------------------------------


def shift(array):
    """The value at (x + 1/2, y): 25 cells further."""
    return np.roll(array, -25, axis=0)


def test_standard_map_symmetry():
    """(x, y, u) -> (x + 1/2, y, -u) is exact, so with a symmetric cost u is antisymmetric."""
    result = lm.solve(variant("standard_map", stage_cost="1 + u**2"))
    assert result.verified
    assert_mirrored(result, -1, shift)
    u = control(result)
    has = ~np.isnan(u)
    assert np.corrcoef(u[has], shift(u)[has])[0, 1] < -1 + 1e-9


def test_standard_map_of_the_paper():
    """The paper's cost breaks the symmetry: its control is antisymmetric only roughly."""
    result = solved("standard_map")
    assert (result.attractor_cells, result.stabilizable_cells) == (4, 2496)
    assert result.pairs == 52416
    u = control(result)
    has = ~np.isnan(u)
    assert -0.9 < np.corrcoef(u[has], shift(u)[has])[0, 1] < -0.6


# logistic, Henon ------------------------------------------------------------------------------


def uncontrolled(name):
    return variant(name, control_grid={"u": {"values": [0]}})


def test_logistic_control_cancels_the_expansion():
    """Next to the fixed point x* the control is that of Ott, Grebogi and Yorke.

    There x+ - x* = (2 - r)(x - x*) + u, and u = (r - 2)(x - x*) cancels the growth.
    """
    result = solved("logistic_map")
    (x,), u = centres(result), control(result)
    fixed = 1 - 1 / 3.9
    assert result.partition.locate([np.array(fixed)]) in np.flatnonzero(
        result.cell_status == ATTRACTOR
    )
    near = (np.abs(x - fixed) < 0.0125) & ~np.isnan(u)
    assert near.sum() == 3
    np.testing.assert_allclose(u[near], 1.9 * (x[near] - fixed), atol=0.0055)


def test_logistic_control_beats_waiting():
    """Left alone, a chaotic orbit enters the attractor cells too, but some fifty times later."""
    controlled = solved("logistic_map").simulate(2000, 5000)
    left_alone = lm.solve(uncontrolled("logistic_map")).simulate(2000, 5000)
    assert left_alone.reached > 0.99 * 2000
    assert left_alone.steps["q50"] > 20 * controlled.steps["q50"]


@pytest.mark.parametrize("name", ["logistic_map", "henon_map"])
def test_control_is_zero_where_the_free_orbit_arrives_in_one_step(name):
    """The cheapest conceivable cost is one free step: 1."""
    result = solved(name)
    lp = result.lp
    zero = int(np.flatnonzero(lp.controls[:, 0] == 0)[0])
    columns = [lp.column(i, zero) for i in lp.cells]
    arrives = np.array(
        [
            k is not None
            and (lp.rows.target[lp.rows.pointer[k] : lp.rows.pointer[k + 1]] == lp.n).all()
            for k in columns
        ]
    )
    assert arrives.any()
    assert (result.control_index[lp.cells[arrives]] == zero).all()
    np.testing.assert_allclose(result.value[lp.cells[arrives]], 1, rtol=1e-9)
    assert (result.value[lp.cells[~arrives]] > 1).all()


def test_henon_control_cancels_the_expansion():
    """At the saddle x+ - x* = -2 a x* dx + dy + u: near it, u is about 2 a x* dx - dy."""
    result = solved("henon_map")
    (x, y), u = centres(result), control(result)
    fixed = (-0.7 + np.sqrt(0.7**2 + 4 * 1.4)) / 2.8
    dx, dy = x - fixed, y - 0.3 * fixed
    assert result.cell_status[result.partition.locate([fixed, 0.3 * fixed])] == ATTRACTOR
    near = ~np.isnan(u) & (np.abs(dx) < 0.08) & (np.abs(dy) < 0.03)
    wanted = np.clip(2.8 * fixed * dx - dy, -0.1, 0.1)[near]
    assert near.sum() >= 10
    assert np.corrcoef(u[near], wanted)[0, 1] > 0.95
    assert np.abs(u[near] - wanted).max() < 0.045


def test_henon_needs_its_control():
    """Without it hardly a cell can be kept from escaping to infinity (in the finite model)."""
    assert lm.solve(uncontrolled("henon_map")).stabilizable_cells < 100


# double integrator ----------------------------------------------------------------------------


def turn(array):
    """The value at -x."""
    return array[::-1, ::-1]


ODD = ["double_integrator", "inverted_pendulum", "pendulum_on_cart", "van_der_pol"]


@pytest.mark.parametrize("name", ODD)
def test_control_is_odd(name):
    """The dynamics are unchanged by (x, u) -> (-x, -u): so is the optimum, up to ties."""
    result = solved(name)
    assert_mirrored(result, -1, turn)
    u = control(result)
    has = ~np.isnan(u)
    assert np.corrcoef(u[has], turn(u)[has])[0, 1] < -0.95


def test_double_integrator_is_bang_bang():
    """Full thrust towards the switching curve x = -v |v| / 2, away from the limit on v."""
    result = solved("double_integrator")
    (x, v), u = centres(result), control(result)
    side = x + v * np.abs(v) / 2
    clear = ~np.isnan(u) & (np.abs(side) > 0.2) & (np.abs(v) < 1)
    assert clear.sum() > 2500
    assert np.mean(u[clear] == -np.sign(side[clear])) > 0.95
    assert np.mean(u[clear] * side[clear] < 0) > 0.99


def test_double_integrator_takes_the_minimum_time():
    """The value is the classical v + 2 sqrt(v^2/2 + x), but for one sampling time and the cells."""
    result = solved("double_integrator")
    (x, v), value = centres(result), on_grid(result, result.value)
    s = np.where(x + v * np.abs(v) / 2 > 0, 1, -1)
    least = s * v + 2 * np.sqrt(np.maximum(v**2 / 2 + s * x, 0))
    inside = on_grid(result, result.cell_status) == 1
    late = (value - least)[inside]
    assert np.corrcoef(value[inside], least[inside])[0, 1] > 0.995
    assert 0 < np.median(late) < 0.2
    assert np.abs(late).max() < 0.3


def test_double_integrator_loses_what_cannot_brake():
    """Exactly the states that full braking cannot stop before the wall are lost."""
    result = solved("double_integrator")
    x, v = centres(result)
    stopping = np.abs(x + v * np.abs(v) / 2)  # where full braking comes to rest
    towards_wall = x * v > 0
    kept = on_grid(result, result.cell_status) <= 1
    assert not (kept & towards_wall & (stopping > 2)).any()
    assert kept[~towards_wall & (np.abs(v) < 1.25)].all()
    assert kept[towards_wall & (stopping < 1.8)].all()


# pendulums ------------------------------------------------------------------------------------


def test_weak_motor_pumps_energy():
    """Near the bottom, below the energy of the upright, the torque pushes along the motion."""
    result = solved("inverted_pendulum")
    (theta, omega), u = centres(result), control(result)
    energy = omega**2 / 2 + 9.81 * (np.cos(theta) - 1)  # 0 upright at rest
    low = ~np.isnan(u) & (np.abs(theta) > 3 * np.pi / 4) & (energy < 0)
    swinging = low & (np.abs(omega) > 1)
    assert swinging.sum() > 500
    assert np.mean((u * omega)[swinging] > 0) > 0.99
    assert np.mean((u * omega)[low] >= 0) > 0.93


def test_weak_motor_catches_only_what_it_can():
    """Of the unstable mode z = sqrt(g/l) theta + omega the motor can undo |z| < u / sqrt(g/l)."""
    result = solved("inverted_pendulum")
    (theta, omega), u = centres(result), control(result)
    value = on_grid(result, result.value)
    mode = np.sqrt(9.81) * theta + omega
    upright = ~np.isnan(u) & (np.abs(theta) < 0.6)
    catchable = upright & (np.abs(mode) < 0.8)
    assert (u * mode <= 0)[catchable].all()
    assert (u * mode < 0)[catchable & (np.abs(mode) > 0.25)].all()
    # Beyond 3 / sqrt(9.81) = 0.96 it falls, and has to come round again.
    assert value[upright & (np.abs(mode) > 1.5)].min() > 2 * value[catchable].max()


def test_weak_motor_swings_up_from_rest():
    """The hanging pendulum reaches the upright, and not without swinging back and forth."""
    result = solved("inverted_pendulum")
    path = result.closed_loop.path([np.pi - 0.05, 0.05], 500)
    assert result.cell_status[result.partition.locate(list(path[-1:].T))] == ATTRACTOR
    assert np.count_nonzero(np.diff(np.sign(path[:, 1]))) >= 3


def test_cart_moves_under_the_falling_pendulum():
    """Falling to phi > 0, the cart is pushed with u > 0 (or left, where a swing is cheaper)."""
    result = solved("pendulum_on_cart")
    (phi, omega), u = centres(result), control(result)
    falling = ~np.isnan(u) & (np.abs(phi) < 1) & (phi * omega >= 0) & (np.abs(omega) < 2)
    assert falling.sum() > 30
    assert (u * phi >= 0)[falling].all()
    assert (u * phi > 0)[falling & (np.abs(phi) < 0.5) & (np.abs(omega) < 0.5)].all()


def test_cart_value_grows_away_from_the_upright():
    """The least value over omega grows with |phi|; hanging is worst among rest within one turn."""
    result = solved("pendulum_on_cart")
    value = on_grid(result, result.value)
    best = np.where(np.isfinite(value), value, np.inf).min(axis=1)[32:]  # phi > 0
    assert best[0] == 0
    running = np.maximum.accumulate(best)
    assert (best >= 0.95 * running).all()
    assert best[-1] > 3 * best[1]
    rest = value[32:57, 31:33].mean(axis=1)  # phi from 0 to 2 pi, omega next to 0
    assert np.abs((np.argmax(rest) + 0.5) / 4 - np.pi) < 0.5


# oscillator, Lorenz ---------------------------------------------------------------------------


def test_van_der_pol_cannot_rest_by_itself():
    """Without control every orbit ends on the limit cycle: no cell surely reaches the origin.

    Only next to the origin do the cells' coarseness and the slow spiral leave a chance.
    """
    result = lm.solve(uncontrolled("van_der_pol"))
    assert result.status == "not_stabilizable"
    assert result.stabilizable_cells == 0
    x, v = centres(result)
    trapped = on_grid(result, result.cell_status) == 3
    assert trapped[(np.hypot(x, v) < 2) & (np.hypot(x, v) > 0.8)].all()


def test_van_der_pol_control_brakes():
    """Within the limit cycle the forcing takes energy out: u v < 0."""
    result = solved("van_der_pol")
    (x, v), u = centres(result), control(result)
    within = ~np.isnan(u) & (np.hypot(x, v) < 1.5)
    assert within.sum() > 400
    assert np.mean((u * v)[within] <= 0) > 0.95
    assert np.mean((u * v)[within] < 0) > 0.9


def test_lorenz_target_is_steady_convection():
    """C+ is an equilibrium of the formulas and lies within the attractor cells; so is not C-."""
    result = solved("lorenz")
    c = np.sqrt(8 / 3 * 27)
    plus, minus = np.array([c, c, 27.0]), np.array([-c, -c, 27.0])
    for point in (plus, minus):
        image = images(result.problem, point, np.array(0.0))
        np.testing.assert_allclose(image, point, atol=1e-12)
    status = [result.cell_status[result.partition.locate(list(p))] for p in (plus, minus)]
    assert status == [ATTRACTOR, 1]


def test_lorenz_symmetry():
    """(x, y, z) -> (-x, -y, z) is a symmetry once both C+ and C- count as targets."""
    target = NAMED["lorenz"].problem["attractor"]["boxes"][0]
    mirror = {"x": [-10, -6], "y": [-12, -6], "z": target["z"]}
    result = lm.solve(
        variant(
            "lorenz",
            attractor={"boxes": [target, mirror]},
            sampling={"kind": "grid", "per_axis": 2},
        )
    )
    assert result.verified
    assert_mirrored(result, 1, lambda array: array[::-1, ::-1, :])


def test_lorenz_control_beats_waiting():
    """A free orbit visits C+ too, after hundreds of steps; adjusting the heating takes a dozen."""
    controlled = solved("lorenz").simulate(1000, 500)
    assert controlled.reached > 0.99 * controlled.starts
    assert controlled.steps["q99"] < 25
    left_alone = lm.solve(uncontrolled("lorenz")).simulate(1000, 200)
    assert left_alone.reached < 0.5 * left_alone.starts

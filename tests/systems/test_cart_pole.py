"""The cart and pole: its energy, its places of rest, its mirror image, and the swing-up."""

import numpy as np
import pytest
from named_systems import NAMED, images, solved, variant
from test_system_solutions import assert_mirrored

import lmdsl as lm

M, m, HALF, G = 1.0, 0.1, 0.5, 9.8


def whole(test):
    """Mark a test of the system as it is published: one process solves it, once."""
    return pytest.mark.long(pytest.mark.xdist_group("cart_pole")(test))


def of_time(step, substeps, **parameters):
    """The problem with another step, which is taken in so many parts."""
    system = {**NAMED["cart_pole"].problem["system"], "step": step, "substeps": substeps}
    return variant("cart_pole", system={**system, "parameters": parameters})


def energy(s):
    """Of the cart, and of the rod by Koenig: its centre's motion, and the turning about it."""
    _, theta, v, omega = s
    along, up = v + HALF * omega * np.cos(theta), -HALF * omega * np.sin(theta)
    moving = M / 2 * v**2 + m / 2 * (along**2 + up**2)
    return moving + m * (2 * HALF) ** 2 / 24 * omega**2 + m * G * HALF * np.cos(theta)


def states(count, seed):
    ends = np.array([[2.4], [np.pi], [6], [12]])
    return np.random.default_rng(seed).uniform(-ends, ends, (4, count))


def test_without_force_and_friction_energy_is_kept_to_the_fourth_order():
    x = states(200, 1)
    error = [
        np.abs(energy(images(of_time(0.1, n, b=0.0, d=0.0), x, np.zeros(200))) - energy(x)).max()
        for n in (4, 8, 16)
    ]
    assert error[2] < 1e-6
    # Each part's error is of the fifth order: of the parts together of the fourth, or less.
    assert 12 < error[0] / error[1] < 40
    assert 12 < error[1] / error[2] < 40


def test_energy_changes_by_what_force_and_frictions_do():
    x, u = states(200, 2), np.random.default_rng(3).uniform(-20, 20, 200)
    h, b, d = 1e-4, 0.3, 0.02
    later = images(of_time(h, 1, b=b, d=d), x, u)
    middle = (x + later) / 2
    work = u * middle[2] - b * middle[2] ** 2 - d * middle[3] ** 2
    np.testing.assert_allclose((energy(later) - energy(x)) / h, work, atol=2e-4)


def test_along_the_rail_only_force_and_friction_push():
    """The momentum of cart and rod changes by u - b v, whatever the rod does."""
    x, u = states(200, 4), np.random.default_rng(5).uniform(-20, 20, 200)
    h = 1e-4
    later = images(of_time(h, 1, b=0.3), x, u)
    first, then = ((M + m) * s[2] + m * HALF * s[3] * np.cos(s[1]) for s in (x, later))
    np.testing.assert_allclose((then - first) / h, u - 0.3 * (x + later)[2] / 2, atol=2e-4)


def test_upright_and_hanging_are_places_of_rest_and_the_mirror_image_moves_alike():
    place = np.linspace(-2.4, 2.4, 7)
    rest = np.zeros_like(place)
    problem = variant("cart_pole")
    assert (images(problem, [place, rest, rest, rest], rest)[0] == place).all()
    hanging = np.array([place, np.full(7, np.pi), rest, rest])
    np.testing.assert_allclose(images(problem, hanging, rest), hanging, atol=1e-15)
    x, u = states(200, 6), np.random.default_rng(7).uniform(-20, 20, 200)
    assert (images(problem, -x, -u) == -images(problem, x, u)).all()


@whole
def test_the_controller_is_odd():
    """(x, theta, v, omega, u) -> all negative is exact, and so are mirrored cells."""
    assert_mirrored(solved("cart_pole"), -1, lambda array: array[::-1, ::-1, ::-1, ::-1])


@whole
@pytest.mark.parametrize("place", [-1.5, 0.1, 1.5])
def test_the_pole_swings_up_from_hanging(place):
    """Measured by the equation itself, integrated with small steps."""
    path = solved("cart_pole").path([place, np.pi - 0.05, 0.1, -0.2])
    assert path.outcome == "reached"
    assert np.abs(path.states[:, 0]).max() <= 2.4
    assert energy(path.states[0]) < 0.49 - 0.9 < energy(path.states[-1])


@whole
def test_the_pole_is_balanced_once_it_is_up():
    """By the regulator in A; a run that leaves A on its way to rest is brought back."""
    held = solved("cart_pole").simulate(300, 1000, seed=2, hold=100).held
    assert held.lost == 0
    assert held.away <= 0.05 * 300
    assert held.distance[0] < 1e-6  # the median, in cells from the upright


@whole
def test_the_cart_moves_under_the_falling_pole():
    """Near the middle of the rail, of all cells in which the pole falls slowly to the right."""
    result = solved("cart_pole")
    cells = np.flatnonzero(result.cell_status == 1)
    x, theta, v, omega = result.partition.centres(cells).T
    falls = (abs(x) < 0.6) & (abs(v) < 1.5) & (theta > 0) & (theta < 1) & (omega > 0) & (omega < 3)
    u = result.controller.at(cells[falls])[:, 0]
    assert len(u) >= 20
    assert u.mean() > 2


def test_no_run_arrives_without_force():
    """A pole that hangs stays there: nothing below the upright's energy is stabilizable."""
    nothing = {"control_grid": {"u": {"values": [0]}}, "local_controller": None}
    idle = lm.solve(variant("cart_pole", **nothing))
    centres = idle.partition.centres(np.flatnonzero(idle.cell_status == 1)).T
    assert energy(centres).min(initial=np.inf) > 0

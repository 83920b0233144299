"""The systems of the zoo, against plain NumPy written from their sources, and their invariants."""

import numpy as np
import pytest
import zoo_systems as plain
from scipy.linalg import expm

from benchmarks import zoo

COUNT = 1000


def problem(name, **changes):
    declared = zoo.problem(zoo.entries()[name])
    return declared.replaced(**changes) if changes else declared


def images(declared, x, u, w=()):
    names = (*declared.states, *declared.controls, *declared.noises)
    return np.array(
        np.broadcast_arrays(*declared.step()(dict(zip(names, (*x, *u, *w), strict=True))))
    )


def held(name, step, substeps, **parameters):
    """The problem of a differential equation with a step and substeps of one's own."""
    declared = problem(name)
    wanted = {**declared.system.parameters, **parameters}
    system = declared.system.replaced(step=step, substeps=substeps, parameters=wanted)
    return declared.replaced(system=system)


def jacobian(declared, x, u, h=1e-6):
    """Central differences, shape (states, states, n)."""
    columns = []
    for k in range(len(x)):
        above, below = np.array(x), np.array(x)
        above[k] += h
        below[k] -= h
        columns.append((images(declared, above, u) - images(declared, below, u)) / (2 * h))
    return np.moveaxis(np.array(columns), 0, 1)


def rates(name, x, u, **parameters):
    """The right-hand side: what an Euler step so short that it cannot bend moves."""
    h = 2.0**-30
    declared = held(name, h, 1, **parameters)
    return (images(declared, x, u) - np.array(x)) / h


@pytest.mark.parametrize("by_hand", plain.MAPS, ids=lambda f: f.__name__)
def test_map_agrees_with_one_written_by_hand(by_hand):
    declared = problem(by_hand.__name__)
    x, u, w = plain.drawn(declared, COUNT, 1)
    np.testing.assert_allclose(images(declared, x, u, w), by_hand(x, u, w), rtol=0, atol=1e-12)


@pytest.mark.parametrize("by_hand", plain.EQUATIONS, ids=lambda f: f.__name__)
def test_equation_agrees_with_one_written_by_hand(by_hand):
    name = by_hand.__name__
    step = problem(name).system.step
    declared = held(name, step, 4)
    x, u, w = plain.drawn(declared, COUNT, 2)
    if name == "rantzer":  # polar coordinates by hand have a pole at infinity, and at the origin
        x[0] = np.clip(x[0], 0.05, 2.9)
    wanted = plain.runge_kutta(by_hand, step, 4)(x, u, w)
    np.testing.assert_allclose(images(declared, x, u, w), wanted, rtol=1e-9, atol=1e-9)


def test_every_system_is_written_by_hand():
    ours = {name for name, entry in zoo.entries().items() if "/zoo/" in entry["file"]}
    assert ours == {f.__name__ for f in (*plain.MAPS, *plain.EQUATIONS)}


# Maps -----------------------------------------------------------------------------------------


def test_tent_map_preserves_lebesgue_measure():
    x = (np.arange(2**16) + 0.5) / 2**16
    image = images(problem("tent_map"), [x], [np.zeros_like(x)])[0]
    assert (np.histogram(image, 64, (0, 1))[0] == 2**10).all()


def test_circle_map_locks_under_its_control_alone():
    declared = problem("circle_map")
    theta = np.arange(100_000) / 100_000
    turned = [images(declared, [theta], [np.full_like(theta, u)])[0] - theta for u in (0, -0.02)]
    assert turned[0].min() > 0  # it drifts round for ever
    assert turned[1].min() < 0 < turned[1].max()  # a fixed point is born
    ahead = images(declared, [theta + 1], [0 * theta])[0]
    np.testing.assert_allclose(ahead - images(declared, [theta], [0 * theta])[0], 1, atol=1e-12)


def test_ikeda_map_contracts_area_by_the_square_of_its_loss():
    declared = problem("ikeda_map")
    x, u, _ = plain.drawn(declared, COUNT, 3)
    determinant = np.linalg.det(np.moveaxis(jacobian(declared, x, u), -1, 0))
    np.testing.assert_allclose(determinant, 0.81, atol=1e-6)


def test_ikeda_target_holds_the_fixed_point():
    declared = problem("ikeda_map")
    point = np.array([0.53275, 0.24690])
    for _ in range(20):  # Newton's method
        slope = jacobian(declared, point[:, None], [np.zeros(1)])[..., 0]
        miss = images(declared, point[:, None], [np.zeros(1)])[:, 0] - point
        point = point - np.linalg.solve(slope - np.eye(2), miss)
    box = declared.attractor.boxes[0]
    assert all(box[name][0] < x < box[name][1] for name, x in zip("xy", point, strict=True))
    growth = np.abs(np.linalg.eigvals(jacobian(declared, point[:, None], [np.zeros(1)])[..., 0]))
    assert growth.max() > 1.5  # a saddle


def test_coupled_standard_maps_are_symplectic():
    declared = problem("coupled_standard_maps")
    x, u, _ = plain.drawn(declared, COUNT, 4)
    slope = np.moveaxis(jacobian(declared, x, u), -1, 0)
    form = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    both = slope.transpose(0, 2, 1) @ form @ slope
    np.testing.assert_allclose(both, np.broadcast_to(form, both.shape), atol=1e-7)
    np.testing.assert_allclose(np.linalg.det(slope), 1, atol=1e-7)


# Mechanics ------------------------------------------------------------------------------------


def power(energy, name, x, u, **parameters):
    """The rate of change of an energy along the equation."""
    rate, h = rates(name, x, u, **parameters), 1e-5
    ahead, behind = np.array(x) + h * rate, np.array(x) - h * rate
    return (energy(ahead) - energy(behind)) / (2 * h)


def test_duffing_force_works_against_friction_and_is_too_weak_to_climb():
    x, u, _ = plain.drawn(problem("duffing"), COUNT, 5)
    gained = power(lambda s: s[1] ** 2 / 2 + s[0] ** 4 / 4 - s[0] ** 2 / 2, "duffing", x, u)
    np.testing.assert_allclose(gained, 0.25 * u[0] * x[1] - 0.1 * x[1] ** 2, atol=1e-5)
    inside = np.linspace(0, 1, 1001)
    assert (inside - inside**3).max() > 0.25  # held by its spring, the force cannot lift it


def test_pendulum_motor_works_against_friction_and_cannot_lift():
    declared = problem("pendulum_held")
    x, u, _ = plain.drawn(declared, COUNT, 6)
    gained = power(lambda s: s[1] ** 2 / 2 + 9.81 * np.cos(s[0]), "pendulum_held", x, u)
    np.testing.assert_allclose(gained, u[0] * x[1] - 0.1 * x[1] ** 2, atol=1e-5)
    assert np.abs(declared.control_grid["torque"].vector()).max() < 9.81


def test_only_the_force_works_on_cart_and_pole():
    def energy(s):
        _, theta, v, omega = s
        bending = v * omega * np.cos(theta)
        return (
            1.1 * v**2 / 2 + 0.05 * bending + 0.1 / 6 * omega**2 + 0.1 * 9.8 * 0.5 * np.cos(theta)
        )

    x, u, _ = plain.drawn(problem("cart_pole"), COUNT, 7)
    np.testing.assert_allclose(power(energy, "cart_pole", x, u), u[0] * x[2], atol=1e-4)


def test_wheel_and_pendulum_exchange_momentum():
    """What the motor does to one it does to the other: only gravity changes their sum."""
    x, u, _ = plain.drawn(problem("reaction_wheel"), COUNT, 8)
    _, omega, wheel = rates("reaction_wheel", x, u)
    np.testing.assert_allclose(
        198 * omega + 1.08 * wheel, 198 * 78.4 * np.sin(x[0]), rtol=1e-5, atol=1e-2
    )
    assert 1.08 * 10 < 78.4  # the motor alone cannot lift the pendulum


def test_boost_converter_is_its_matrix_exponential():
    """Girard, Pola and Tabuada's matrices, times 0.5, by SciPy; the second state times 5."""
    parallel = 0.005 / 1.005
    first = np.array([[-0.05 / 3, 0], [0, -1 / 70 / 1.005]])
    second = np.array(
        [[-(0.05 + parallel) / 3, -1 / 1.005 / 15], [5 / 1.005 / 70, -1 / 70 / 1.005]]
    )
    declared = problem("boost_converter")
    x, u, _ = plain.drawn(declared, COUNT, 9)
    image = images(declared, x, u)
    for mode, A in ((1, first), (2, second)):
        wide = np.zeros((3, 3))
        wide[:2, :2], wide[0, 2] = A, 1 / 3
        flow = expm(0.5 * wide)
        here = u[0] == mode
        wanted = flow[:2, :2] @ np.array(x)[:, here] + flow[:2, 2:]
        np.testing.assert_allclose(image[:, here], wanted, atol=1e-8)


def test_unicycle_drives_along_a_circle():
    declared = held("unicycle", 0.6, 8)
    x, u, _ = plain.drawn(declared, COUNT, 10)
    angle = 0.6 * u[1] / 2
    chord = 0.6 * u[0] * np.sinc(angle / np.pi)
    wanted = [x[0] + chord * np.cos(x[2] + angle), x[1] + chord * np.sin(x[2] + angle)]
    np.testing.assert_allclose(images(declared, x, u)[:2], wanted, atol=1e-8)


# Flows ----------------------------------------------------------------------------------------


def test_compressor_rests_at_its_peak_and_stalls_on_its_branch():
    peak = [np.zeros(1)] * 3, [np.ones(1)]
    np.testing.assert_allclose(rates("compressor", *peak), 0, atol=1e-8)
    phi = np.linspace(-1.9, -0.05, 50)
    stall = -2 * phi - phi**2
    psi = -1.5 * phi**2 - 0.5 * phi**3 - 3 * (phi + 1) * stall
    np.testing.assert_allclose(
        rates("compressor", [phi, psi, stall], [phi + 1])[[0, 2]], 0, atol=1e-6
    )
    free = rates("compressor", [phi, psi, 0 * phi], [phi + 1])
    assert (free[2] == 0).all()  # without stall there never is any


def test_double_gyre_is_incompressible_and_keeps_its_walls():
    declared = problem("double_gyre")
    x, u, _ = plain.drawn(declared, COUNT, 11)
    still = [0 * u[0], 0 * u[1]]
    h, swirl = 1e-4, 0.0
    for k in (0, 1):
        above, below = np.array(x), np.array(x)
        above[k] += h
        below[k] -= h
        swirl = swirl + (rates("double_gyre", above, still) - rates("double_gyre", below, still))[k]
    np.testing.assert_allclose(swirl / (2 * h), 0, atol=1e-2)
    for k, wall in ((0, 0.0), (0, 2.0), (1, 0.0), (1, 1.0)):
        there = np.array(x)
        there[k] = wall
        np.testing.assert_allclose(rates("double_gyre", there, still)[k], 0, atol=1e-7)


def test_rantzer_density_grows_along_the_flow_almost_everywhere():
    """div(rho f) = 16 y^2 / |x|^6 for rho = |x|^-4: the dual of a Lyapunov function."""
    x, y = np.random.default_rng(12).uniform(-4, 4, (2, COUNT))
    keep = np.hypot(x, y) > 0.5
    x, y, h = x[keep], y[keep], 1e-5

    def carried(a, b):
        return plain.rantzer_plane(a, b) / (a**2 + b**2) ** 2

    outflow = carried(x + h, y)[0] - carried(x - h, y)[0]
    outflow = (outflow + carried(x, y + h)[1] - carried(x, y - h)[1]) / (2 * h)
    np.testing.assert_allclose(outflow, 16 * y**2 / (x**2 + y**2) ** 3, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("place", [(2, 0), (3, np.sqrt(3)), (3, -np.sqrt(3))])
def test_rantzer_has_equilibria_that_never_arrive(place):
    """No Lyapunov function has a way round them."""
    chi, alpha = 2 * np.arctan(np.hypot(*place)), np.arctan2(place[1], place[0])
    rate = rates("rantzer", [np.array([chi]), np.array([alpha])], [])
    np.testing.assert_allclose(rate, 0, atol=1e-6)


def test_rantzer_comes_home_by_the_horizon():
    """How many runs are on their way after n steps, by the plain equations alone.

    What passes (2, 0) at a distance x leaves it after log(1/x)/(2/sqrt 5), and waits log(1/x) at
    either end of the horizon. The mean cost at gamma = 1.02 is near that of the finest grid.
    """
    rng = np.random.default_rng(15)
    x = np.array([rng.uniform(np.pi / 12, np.pi, 40_000), rng.uniform(-np.pi, np.pi, 40_000)])
    step, left = plain.runge_kutta(plain.rantzer, 0.25, 2), [x.shape[1]]
    while left[-1]:
        x = step(x, [], [])
        x = x[:, x[0] > np.pi / 12]
        left.append(x.shape[1])
    decay = (left[30] / left[60]) ** (1 / 30)
    assert decay == pytest.approx(np.exp(0.25 / (2 + np.sqrt(5) / 2)), rel=0.01)
    cost = sum(1.02**n * share for n, share in enumerate(left)) / left[0]
    assert zoo.entries()["rantzer"]["grids"][-1]["cost"] == pytest.approx(cost, rel=0.05)


def test_nobody_is_lost_in_an_epidemic():
    """S + I + R stays: what S and I lose together has recovered. S^rho e^(-beta (S + I)) stays."""
    declared = held("epidemic", 4, 64)
    x, _, _ = plain.drawn(declared, COUNT, 13)
    x[0] = np.maximum(x[0], 0.01)
    free = [np.zeros(COUNT)]
    lost = rates("epidemic", x, free).sum(axis=0)
    np.testing.assert_allclose(lost, -0.1 * x[1], atol=1e-6)
    S, ill = images(declared, x, free)
    before = x[0] + x[1] - np.log(x[0]) / 3
    np.testing.assert_allclose(S + ill - np.log(S) / 3, before, atol=1e-8)


def test_predator_and_prey_go_round_where_nobody_fishes():
    declared = held("predator_prey", 0.5, 64)
    x, _, _ = plain.drawn(declared, COUNT, 14)
    after = images(declared, x, [np.zeros(COUNT)])

    def volterra(s):
        return np.exp(s[0]) - s[0] + np.exp(s[1]) - s[1]

    np.testing.assert_allclose(volterra(after), volterra(x), rtol=1e-8)

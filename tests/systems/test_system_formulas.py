"""The systems known by name, against formulas and integrators written independently."""

import numpy as np
import pytest
from named_systems import draw, images, variant
from scipy.integrate import solve_ivp


def standard_map(s, u):
    x, y = s
    y = y + 0.25 * u * np.sin(2 * np.pi * x)  # the usual order: first the kick, then the drift
    return np.array([x + y, y])


def logistic_map(s, u):
    return 3.9 * (s - s**2) + u


def henon_map(s, u):
    return np.array([1 + s[1] - 1.4 * np.square(s[0]) + u, 0.3 * s[0]])


@pytest.mark.parametrize("by_hand", [standard_map, logistic_map, henon_map])
def test_map_agrees_with_one_written_by_hand(by_hand):
    x, u = draw(by_hand.__name__, 200, np.random.default_rng(3))
    image = images(variant(by_hand.__name__), x, u)
    np.testing.assert_allclose(image, by_hand(x, u), rtol=1e-12, atol=1e-12)


def double_integrator(s, u):
    return [s[1], u]


def inverted_pendulum(s, u, m=1.0, length=1.0, g=9.81, d=0.1):
    # Moment of inertia times angular acceleration = gravity's moment + motor - friction.
    return [s[1], (m * g * length * np.sin(s[0]) + u - d * s[1]) / (m * length**2)]


def pendulum_on_cart(s, u):
    """Lagrange's equations of cart and uniform rod, solved for both accelerations.

    (M + m) x'' + m l (phi'' cos phi - phi'^2 sin phi) = u along the track,
    4/3 m l^2 phi'' + m l x'' cos phi = m g l sin phi about the pivot,
    with x to the right and phi clockwise.
    """
    m, M, length, g = 2.0, 8.0, 0.5, 9.8
    phi, omega = s
    mass = [[M + m, m * length * np.cos(phi)], [m * length * np.cos(phi), 4 / 3 * m * length**2]]
    force = [u + m * length * omega**2 * np.sin(phi), m * g * length * np.sin(phi)]
    return [omega, np.linalg.solve(mass, force)[1]]


def cart_pole(s, u):
    """The same equations, with the cart's place and with friction."""
    m, M, length, g, b, d = 0.1, 1.0, 0.5, 9.8, 0.1, 2e-6
    _, theta, v, omega = s
    bent = m * length * np.cos(theta)
    force = u - b * v + m * length * omega**2 * np.sin(theta)
    torque = m * g * length * np.sin(theta) - d * omega
    rates = np.linalg.solve([[M + m, bent], [bent, 4 / 3 * m * length**2]], [force, torque])
    return [v, omega, *rates]


def van_der_pol(s, u):
    return [s[1], u - s[0] + (1 - s[0]) * (1 + s[0]) * s[1]]


def lorenz(s, u):
    x, y, z = s
    return [10 * y - 10 * x, 28 * x + u * x - x * z - y, x * y - 8 * z / 3]


def integrate(field, x, u, duration):
    """The flow of every column of x, with its control held."""
    exact = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10}
    flows = [
        solve_ivp(lambda t, s, u=u[i]: field(s, u), (0, duration), x[:, i], **exact).y[:, -1]
        for i in range(x.shape[1])
    ]
    return np.array(flows).T


@pytest.mark.parametrize(
    "by_hand", [inverted_pendulum, pendulum_on_cart, van_der_pol, lorenz, cart_pole]
)
def test_sampled_flow_agrees_with_an_integrator(by_hand):
    """The right-hand side is right, and RK4's error is small against a cell."""
    problem = variant(by_hand.__name__)
    x, u = draw(by_hand.__name__, 60, np.random.default_rng(4))
    image = images(problem, x, u)
    true = integrate(by_hand, x, u, problem.system.step)
    width = np.array([(a.high - a.low) / a.cells for a in problem.state_box.values()])
    error = np.abs(image - true) / width[:, None]
    assert error.max() < 0.02
    # A wrong coefficient shows in the bulk of the points, far above the integrator's error.
    assert np.median(error) < 1e-3


def test_double_integrator_is_sampled_exactly():
    x, u = draw("double_integrator", 60, np.random.default_rng(5))
    image = images(variant("double_integrator"), x, u)
    np.testing.assert_allclose(image, integrate(double_integrator, x, u, 0.15), atol=1e-9)


def test_pendulum_of_other_size():
    """Mass and length of 1 would hide a wrong power of them."""
    other = {"m": 2.0, "l": 0.5, "g": 9.81, "d": 0.3}
    system = {"kind": "inverted_pendulum", "parameters": other, "step": 0.1, "substeps": 20}
    x, u = draw("inverted_pendulum", 30, np.random.default_rng(6))
    image = images(variant("inverted_pendulum", system=system), x, u)
    true = integrate(lambda s, u: inverted_pendulum(s, u, *other.values()), x, u, 0.1)
    np.testing.assert_allclose(image, true, atol=1e-6)

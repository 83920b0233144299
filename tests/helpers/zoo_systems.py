"""The systems of the zoo once more, in plain NumPy, written from their sources alone.

A map takes states, controls and noise, each of shape (n,) an entry, and returns the images; a
derivative returns the rates. Nothing of lmdsl is used.
"""

from __future__ import annotations

import numpy as np


def tent_map(x, u, w):
    return [np.where(x[0] < 0.5, 2 * x[0], 2 - 2 * x[0]) + u[0]]


def circle_map(x, u, w):
    return [x[0] + 0.15 + u[0] - 0.9 * np.sin(2 * np.pi * x[0]) / (2 * np.pi)]


def ikeda_map(x, u, w):
    """One turn of light round the ring, as a complex amplitude."""
    z = x[0] + 1j * x[1]
    z = 1 + u[0] + 0.9 * z * np.exp(1j * (0.4 - 6 / (1 + np.abs(z) ** 2)))
    return [z.real, z.imag]


def coupled_standard_maps(x, u, w):
    """Kicks first: minus the gradient of a potential; then both drift."""
    place, speed = np.array(x[:2]), np.array(x[2:])
    turn = 2 * np.pi
    kick = (0.9 * np.sin(turn * place) + 0.2 * np.sin(turn * place.sum(axis=0))) / turn
    speed = speed + kick + np.array(u)
    return [*(place + speed), *speed]


def inventory(x, u, w):
    return [x[0] + u[0] - w[0]]


def duffing(x, u, w):
    return [x[1], -(x[0] ** 3 - x[0]) - 0.1 * x[1] + 0.25 * u[0]]


def pendulum_held(x, u, w):
    """Moment of inertia times angular acceleration = gravity's moment + motor - friction."""
    mass, length = 1.0, 1.0
    moment = mass * 9.81 * length * np.sin(x[0]) + u[0] - 0.1 * x[1]
    return [x[1], moment / (mass * length**2)]


def cart_pole(x, u, w):
    """Lagrange's equations of cart and uniform rod of length 2 l, solved as a linear system."""
    M, m, half, g = 1.0, 0.1, 0.5, 9.8
    _, theta, v, omega = x
    mass = np.empty((*theta.shape, 2, 2))
    mass[..., 0, 0] = M + m
    mass[..., 0, 1] = mass[..., 1, 0] = m * half * np.cos(theta)
    mass[..., 1, 1] = 4 / 3 * m * half**2
    push = u[0] + m * half * omega**2 * np.sin(theta)
    fall = m * g * half * np.sin(theta)
    both = np.linalg.solve(mass, np.stack([push, fall], axis=-1)[..., None])[..., 0]
    return [v, omega, both[..., 0], both[..., 1]]


def reaction_wheel(x, u, w):
    current = 10 * (u[0] - x[2] / 800)
    return [x[1], 78.4 * np.sin(x[0]) - 1.08 * current, 198 * current]


def boost_converter(x, u, w):
    """The two linear modes of Girard, Pola and Tabuada, in scaled states (i, 5 v)."""
    xl, xc, rl, rc, ro = 3.0, 70.0, 0.05, 0.005, 1.0
    first = np.array([[-rl / xl, 0], [0, -1 / xc / (ro + rc)]])
    second = np.array(
        [
            [-(rl + ro * rc / (ro + rc)) / xl, -ro / (ro + rc) / xl / 5],
            [5 * ro / (ro + rc) / xc, -1 / (ro + rc) / xc],
        ]
    )
    A = np.where((u[0] == 1)[..., None, None], first, second)
    both = np.stack(x, axis=-1)[..., None]
    rate = (A @ both)[..., 0] + np.array([1 / xl, 0])
    return [rate[..., 0], rate[..., 1]]


def unicycle(x, u, w):
    rate = u[0] * np.exp(1j * x[2])
    return [rate.real, rate.imag, u[1]]


def compressor(x, u, w):
    """Moore and Greitzer: flow 1 + phi, pressure psi below the peak, R the square of the stall."""
    phi, psi, R = x
    flow = phi + 1
    characteristic = 1 + 1.5 * flow - 0.5 * flow**3 - 2  # counted from its peak, at flow 1
    return [
        -psi + characteristic - 3 * flow * R,
        2 * (flow - u[0]),
        7 * R * (1 - flow**2 - R),
    ]


def double_gyre(x, u, w):
    a = 0.25 * np.sin(2 * np.pi * x[2])
    f = a * x[0] ** 2 + x[0] - 2 * a * x[0]
    slope = 2 * a * x[0] + 1 - 2 * a
    return [
        0.1 * u[0] - np.pi * 0.1 * np.sin(np.pi * f) * np.cos(np.pi * x[1]),
        0.1 * u[1] + np.pi * 0.1 * np.cos(np.pi * f) * np.sin(np.pi * x[1]) * slope,
        np.full_like(x[2], 0.1),
    ]


def rantzer_plane(x, y):
    """Rantzer's equations themselves."""
    return np.array([-2 * x + x**2 - y**2, -6 * y + 2 * x * y])


def rantzer(x, u, w):
    """The same on the half sphere: place = tan(chi/2) (cos alpha, sin alpha), slower far out."""
    chi, alpha = x
    r = np.tan(chi / 2)
    place = r * np.cos(alpha), r * np.sin(alpha)
    rate = rantzer_plane(*place) * np.cos(chi / 2)
    outwards = rate[0] * np.cos(alpha) + rate[1] * np.sin(alpha)
    around = (rate[1] * np.cos(alpha) - rate[0] * np.sin(alpha)) / r
    return [2 * outwards / (1 + r**2), around]


def robot(x, u, w):
    return [u[0] + w[0], u[1] + w[1]]


def epidemic(x, u, w):
    infected = 0.3 * (1 - u[0]) * x[0] * x[1]
    return [-infected, infected - x[1] / 10]


def predator_prey(x, u, w):
    """Lotka and Volterra, with fishing, for the logarithms of both."""
    prey, predator = np.exp(x[0]), np.exp(x[1])
    growth = prey * (1 - predator) - 0.4 * prey * u[0]
    gain = predator * (prey - 1) - 0.2 * predator * u[0]
    return [growth / prey, gain / predator]


MAPS = (tent_map, circle_map, ikeda_map, coupled_standard_maps, inventory)
EQUATIONS = (
    duffing, pendulum_held, cart_pole, reaction_wheel, boost_converter, unicycle, compressor,
    double_gyre, rantzer, robot, epidemic, predator_prey,
)  # fmt: skip


def runge_kutta(rate, step, substeps):
    """Return the map of the classical method of order four."""

    def image(x, u, w):
        x, h = np.array(x), step / substeps
        for _ in range(substeps):
            k1 = np.array(rate(x, u, w))
            k2 = np.array(rate(x + h / 2 * k1, u, w))
            k3 = np.array(rate(x + h / 2 * k2, u, w))
            k4 = np.array(rate(x + h * k3, u, w))
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return image


def drawn(problem, count, seed):
    """Random states in the box, controls of the grid and noise, as lists of arrays."""
    rng = np.random.default_rng(seed)
    x = [rng.uniform(a.low, a.high, count) for a in problem.state_box.values()]
    u = [rng.choice(grid.vector(), count) for grid in problem.control_grid.values()]
    w = [law.draw(rng, count) for law in (problem.noise or {}).values()]
    return x, u, w

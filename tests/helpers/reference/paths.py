"""Where a step of a differential equation ends and what it costs, written from the documentation.

Part of the independent reference: plain, slow, one sample at a time, without the library.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Vector = list[float]


def knots(
    rate: Callable[[Vector], Vector], start: Vector, step: float, substeps: int
) -> tuple[list[Vector], list[Vector], list[list[Vector]]]:
    """States at the ends of all Runge-Kutta steps, slopes h f there, and the stages of each."""
    h = step / substeps
    states, slopes, stages = [start], [], []

    def moved(x: Vector, by: float, k: Vector) -> Vector:
        return [a + by * b for a, b in zip(x, k, strict=True)]

    for _ in range(substeps):
        x = states[-1]
        k1 = rate(x)
        k2 = rate(moved(x, h / 2, k1))
        k3 = rate(moved(x, h / 2, k2))
        k4 = rate(moved(x, h, k3))
        slopes.append([h * k for k in k1])
        stages.append([k1, k2, k3, k4])
        states.append(
            [
                a + h / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
                for a, b1, b2, b3, b4 in zip(x, k1, k2, k3, k4, strict=True)
            ]
        )
    slopes.append([h * k for k in rate(states[-1])])
    return states, slopes, stages


def hermite(a: float, b: float, m: float, n: float, t: float) -> float:
    """Cubic with values a, b and slopes m, n at the ends of [0, 1]; the ends exactly."""
    if t == 1:
        return b
    return (
        (2 * t**3 - 3 * t**2 + 1) * a
        + (t**3 - 2 * t**2 + t) * m
        + (-2 * t**3 + 3 * t**2) * b
        + (t**3 - t**2) * n
    )


def parts(slopes: list[Vector], widths: Vector) -> int:
    """Number of equal parts of every Runge-Kutta step."""
    steep = [abs(m) / w for slope in slopes for m, w in zip(slope, widths, strict=False)]
    largest = max((s for s in steep if not math.isnan(s)), default=0.0)
    return int(min(max(math.ceil(2 * min(largest, 1e6)), 1), 1000))


def journey(
    states: list[Vector],
    slopes: list[Vector],
    widths: Vector,
    judge: Callable[[Vector, bool], Any],
) -> tuple[Any, int, float, Vector]:
    """First event on the way: what `judge` said, Runge-Kutta step, time on it, place."""
    q = parts(slopes, widths)
    last = len(states) - 2
    for s in range(last + 1):
        for j in range(1, q + 1):
            t = j / q
            place = [
                hermite(a, b, m, n, t)
                for a, b, m, n in zip(
                    states[s], states[s + 1], slopes[s], slopes[s + 1], strict=True
                )
            ]
            final = s == last and j == q
            event = judge(place[: len(widths)], final)
            if event is not None:
                return event, s, t, place
    raise AssertionError("the image always decides")


def integral(
    states: list[Vector], stages: list[list[Vector]], place: Vector, s: int, t: float
) -> float:
    """The last component, an integral, until time t of step s; NaN if its rate is refused."""
    rates = [stage[-1] for each in stages[: s + 1] for stage in each]
    if not all(r >= 0 and np.isfinite(r) for r in rates):
        return math.nan
    if t == 1:
        return states[s + 1][-1]
    return min(max(place[-1], states[s][-1]), states[s + 1][-1])

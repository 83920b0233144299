"""The other parts of a problem: controls, noise, sampling, cost, sets, gamma."""

import numpy as np
from reference import compile_reference, gamma_bracket, read_axes

from random_problems.families import Problem, number


def controls(rng: np.random.Generator, names: list[str], size: float) -> Problem:
    grid: Problem = {}
    for i, name in enumerate(names):
        most = 6 if len(names) == 1 else 3 - i
        if rng.random() < 0.6:
            points = int(rng.integers(1, most + 1))
            bound = round(size * float(rng.uniform(0.5, 1.5)), 3)
            low = -bound if points > 1 else 0.1
            grid[name] = {"low": low, "high": bound if points > 1 else low, "points": points}
        else:
            values = [round(size * float(v), 3) for v in rng.uniform(-1.4, 1.4, most)]
            if rng.random() < 0.5:
                values[0] = 0.0
            grid[name] = {"values": [float(v) for v in dict.fromkeys(values)]}  # not sorted
    return grid


def noise(rng: np.random.Generator, names: list[str]) -> Problem:
    noise: Problem = {}
    for name in names:
        kind = rng.random()
        if kind < 0.4:
            points = int(rng.integers(1, 4))
            noise[name] = {"normal": {"std": number(rng, 0.01, 0.1), "points": points}}
        elif kind < 0.6:
            noise[name] = {"values": [0.04, -0.04], "weights": [0.5, 0.5]}
        elif kind < 0.8:
            noise[name] = {"values": [-0.05, 0.0, 0.07], "weights": [0.1, 0.2, 0.7]}
        else:  # a node of weight zero, far outside
            noise[name] = {"values": [0.03, 50.0, -0.06], "weights": [0.25, 0, 0.75]}
    return noise


def sampling(rng: np.random.Generator, names: list[str], most: int) -> Problem:
    d, kind = len(names), str(rng.choice(["grid", "random", "sobol"]))
    sampling: Problem = {"kind": kind}
    if kind == "grid":
        largest = max(k for k in range(1, 21) if k**d <= most)
        sampling["per_axis"] = int(rng.integers(1, largest + 1))
        if rng.random() < 0.3:
            sampling["per_axis"] = {k: int(rng.integers(1, largest + 1)) for k in names[::-1]}
    else:
        sampling["points"] = int(rng.integers(1, most + 1))
        if rng.random() < 0.7:
            sampling["seed"] = int(rng.integers(0, 1000))
    if 2**d <= most and rng.random() < 0.3:
        sampling["corners"] = True
    return sampling


def cost(rng: np.random.Generator, states, controls, noise, point: dict[str, float]) -> str:
    u, x = (controls or ["0"])[0], states[0]
    squares = " + ".join(f"({n} - {v})**2" for n, v in point.items())
    efforts = "".join(f" + {number(rng, 0.1, 1)}*{c}**2" for c in controls)
    choices = [
        "1",
        f"1{efforts}",
        f"{squares}{efforts}",
        f"0.2 + {squares}{efforts}",
        f"abs({u})",  # zero where the control is
        f"where({x} < {point[x]}, 0, 1 + {u}**2)",  # zero on one side
        f"max(0, {x} - {point[x]}) + max(0, {u})",
        f"where(abs({u}) <= 1e-6, 0, 1)",  # stay for free
        "0",
        f"0.5*(1 + tanh({x} + {u})) + 1e-3",
    ]
    weights = np.array([3, 3, 3, 2, 1, 1, 1, 1, 0.4, 2])
    text = str(rng.choice(choices, p=weights / weights.sum()))
    if noise and rng.random() < 0.5:
        text += f" + {noise[0]}**2"
    return text


def attractor(rng: np.random.Generator, problem: Problem, point: dict[str, float]) -> Problem:
    axes = read_axes(problem)
    home = [min(max(int(a.scaled(point[a.name])), 0), a.cells - 1) for a in axes]
    kinds = {str(k) for k in rng.choice(["points", "boxes", "cells"], rng.choice([1, 1, 1, 2]))}
    attractor: Problem = {}
    if "points" in kinds:
        as_list = rng.random() < 0.3
        attractor["points"] = [list(point.values()) if as_list else dict(point)]
        if rng.random() < 0.3:
            other = {a.name: round(a.low + a.width * (a.cells - 0.4), 3) for a in axes}
            attractor["points"].append(other)
    if "boxes" in kinds:
        box = {}
        for a, i in zip(axes, home, strict=True):
            if rng.random() < 0.15 and len(axes) > 1 and a is not axes[0]:
                continue  # unrestricted
            j = min(a.cells, i + 1 + int(rng.integers(0, 2)))
            low = a.low if i == 0 else a.low + i * a.width
            box[a.name] = [low, a.high if j == a.cells else a.low + j * a.width]
        attractor["boxes"] = [box]
    if "cells" in kinds:
        attractor["cells"] = [home]
        if rng.random() < 0.3:
            attractor["cells"].append([int(rng.integers(0, a.cells)) for a in axes])
    return attractor


def boxes(rng: np.random.Generator, problem: Problem, size: float) -> list[Problem]:
    """Random boxes inside the state box, edges anywhere."""
    boxes = []
    for _ in range(int(rng.integers(1, 3))):
        box = {}
        for a in read_axes(problem):
            if rng.random() < 0.2 and len(box) > 0:
                continue
            length = (a.high - a.low) * float(rng.uniform(0.5, 1.5)) * size
            start = a.low + float(rng.uniform(0, 1)) * max(a.high - a.low - length, 0)
            end = min(start + length, a.high)
            box[a.name] = [round(start, 5), min(round(end, 5), a.high)]
            box[a.name][0] = max(box[a.name][0], a.low)
        boxes.append(box)
    return boxes


def gamma(rng: np.random.Generator, problem: Problem) -> float | None:
    kind = rng.random()
    if kind < 0.12:
        return None  # the default
    if kind < 0.24:
        return 1.0 if rng.random() < 0.7 else 1
    if kind < 0.4:
        return number(rng, 0.5, 0.999)
    if kind < 0.5:
        return number(rng, 1.001, 1.1)
    bracket = gamma_bracket(compile_reference(problem))
    bar = bracket[0] if bracket else 2.0
    if bar > 20:
        return number(rng, 1.0, 3.0)
    factor = float(rng.choice([0.5, 0.9, 0.99, 0.999, 1.001, 1.01, 1.1, 1.5]))
    gamma = 1 + (bar - 1) * factor if factor < 1 else bar * factor
    return float(f"{gamma:.9g}")

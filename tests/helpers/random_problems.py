"""Small valid problems: a seeded generator of many kinds, and hand-written corner cases.

`random_problem(rng)` returns the dict of a problem file. Its geometry is generic: no image lies
where the last bit of a sine decides its cell. The corner cases do lie on edges, with arithmetic
that doubles carry out exactly.
"""

import math
from typing import Any

import numpy as np
from reference import (
    attractor_cells,
    avoid_cells,
    compile_reference,
    control_vectors,
    gamma_bracket,
    measure_cells,
    noise_nodes,
    read_axes,
    sample_offsets,
)

Problem = dict[str, Any]
EVALUATIONS = 4_000  # samples of one problem, about; an ODE step counts several times


def _number(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 4)


def _axis(low: float, high: float, cells: int, periodic: bool = False) -> dict[str, Any]:
    axis: dict[str, Any] = {"low": low, "high": high, "cells": cells}
    if periodic:
        axis["periodic"] = True
    return axis


# ----------------------------------------------------------------------------- families of systems
#
# Each takes (rng, s, u, w): names of up to three states, up to two controls ("0" beyond those the
# problem has), and a noise term ("" or " + ..."). It returns the system, the axes (cells None: to
# be chosen), a point worth stabilizing, and the size of a useful control.


def _linear(rng, s, u, w):
    d = int(rng.integers(1, 4))
    gain = _number(rng, 0.35, 1.25)
    A = rng.normal(size=(d, d))
    A = gain * A / max(abs(np.linalg.eigvals(A)).max(), 0.3)
    texts = {}
    for i in range(d):
        terms = [f"{round(float(A[i, j]), 3)}*{s[j]}" for j in range(d)]
        texts[s[i]] = " + ".join(terms) + f" + {u[i % 2]}" + (w if i == 0 else "")
    box = {s[i]: _axis(-1.3, 2.1 if i == 0 else 1.7, None) for i in range(d)}
    return {"kind": "map", "next": texts}, box, dict.fromkeys(box, 0.0), 0.8


def _logistic(rng, s, u, w):
    r = _number(rng, 2.5, 3.98)
    system = {
        "kind": "map",
        "parameters": {"r": r},
        "next": {s[0]: f"r*{s[0]}*(1 - {s[0]}) + {u[0]}{w}"},
    }
    return system, {s[0]: _axis(0, 1, None)}, {s[0]: round(1 - 1 / r, 6)}, 0.25


def _expanding(rng, s, u, w):
    factor = int(rng.integers(2, 4))
    text = f"{factor}*{s[0]} + {_number(rng, -0.2, 0.2)} + {u[0]}{w}"
    system = {"kind": "map", "next": {s[0]: text}}
    return system, {s[0]: _axis(0, 1, None, True)}, {s[0]: _number(rng, 0, 1)}, 0.2


def _tent(rng, s, u, w):
    a = _number(rng, 1.2, 1.95)
    text = f"where({s[0]} < 0.5003, a*{s[0]}, a*(1 - {s[0]})) + {u[0]}*cos({s[0]}){w}"
    system = {"kind": "map", "parameters": {"a": a}, "next": {s[0]: text}}
    return system, {s[0]: _axis(-0.1, 1.1, None)}, {s[0]: round(a / (1 + a), 6)}, 0.2


def _standard(rng, s, u, w):
    if rng.random() < 0.6 and s[0] == "x" and u[0] == "u" and u[1] in ("u", "0") and not w:
        system: Problem = {"kind": "standard_map", "parameters": {"K": _number(rng, 0.1, 1.0)}}
        names = ("x", "y")
    else:
        x, y = names = s[:2]
        kick = f"K*({u[0]})*sin(2*pi*{x})" if u[0] != "0" else f"K*sin(2*pi*{x})"
        texts = {x: f"{x} + {y} + {kick}{w}", y: f"{y} + {kick}"}
        system = {"kind": "map", "parameters": {"K": _number(rng, 0.1, 1.0)}, "next": texts}
    box = {n: _axis(0, 1, None, True) for n in names}
    return system, box, {names[0]: 0.25, names[1]: 0.5}, 1.0


def _cat(rng, s, u, w):
    x, y = s[:2]
    texts = {x: f"2*{x} + {y} + {u[0]}{w}", y: f"{x} + {y} + {u[1]}"}
    low = _number(rng, -0.5, 0)
    box = {x: _axis(low, low + 1, None, True), y: _axis(0, 1, None, True)}
    return {"kind": "map", "next": texts}, box, {x: low + 0.37, y: 0.61}, 0.3


def _rotation(rng, s, u, w):
    text = f"{s[0]} + {_number(rng, -3, 3)} + {u[0]}{w} + {_number(rng, 0, 0.5)}*sin({s[0]})"
    system = {"kind": "map", "next": {s[0]: text}}
    return system, {s[0]: _axis(-3.1, 3.183, None, True)}, {s[0]: 0.4}, 0.9


def _henon(rng, s, u, w):
    x, y = s[:2]
    texts = {x: f"1 - a*{x}**2 + {y} + {u[0]}{w}", y: f"b*{x}"}
    system = {"kind": "map", "parameters": {"a": _number(rng, 0.3, 1.4), "b": 0.3}, "next": texts}
    box = {x: _axis(-1.6, 1.7, None), y: _axis(-0.5, 0.55, None)}
    return system, box, {x: 0.63, y: 0.19}, 0.5


def _walk(rng, s, u, w):
    """Steps of the control along every axis, pulled back a little; always inside."""
    d = int(rng.integers(1, 4))
    box = {s[i]: _axis(-0.7, 2.3, None) for i in range(d)}
    pull = _number(rng, 0, 0.3)
    texts = {}
    for i in range(d):
        moved = f"{s[i]} + {u[i % 2]} - {pull}*({s[i]} - 0.4)" + (w if i == 0 else "")
        texts[s[i]] = f"min(2.29, max(-0.69, {moved}))"
    return {"kind": "map", "next": texts}, box, dict.fromkeys(box, 0.4), 0.7


def _bounded(rng, s, u, w):
    """Compositions of bounded functions, everything inside the box."""
    d = int(rng.integers(1, 3))
    inner = [
        "sin(3.1*{x} + {u})",
        "tanh(2*{x} - {y} + {u})",
        "cos({x} + {u}*{y})",
        "atan2({x} + {u}, 1.3 + abs({y}))",
        "exp(-abs({x} + {u})) - 0.2*sign({y})",
        "sqrt(abs({x}*{y} + {u})) - floor(0.7*{x})/3",
        "log(1.1 + {x}**2) + sinh({u})*cosh({y})/4",
        "asin(0.9*sin({x})) + acos(0.9*cos({y} - {u})) - atan({u})",
        "tan(0.4*sin({x})) + ceil({y} + {u})/2.7",
    ]
    texts = {}
    for i in range(d):
        body = str(rng.choice(inner)).format(x=s[i], y=s[(i + 1) % d], u=u[i % 2])
        texts[s[i]] = f"0.3 + 0.6*{body}" + (w if i == 0 else "")
    box = {s[i]: _axis(-1.3, 2.1, None) for i in range(d)}
    point = {n: _number(rng, -0.5, 1.2) for n in box}
    return {"kind": "map", "next": texts}, box, point, 0.9


def _ode(texts: dict[str, str], step: float, rng: np.random.Generator, **parameters) -> Problem:
    system: Problem = {"kind": "ode", "derivative": texts, "step": step}
    if parameters:
        system["parameters"] = parameters
    if rng.random() < 0.5:
        system["substeps"] = int(rng.integers(1, 4))
    return system


def _decay(rng, s, u, w):
    rate = _number(rng, -0.5, 1.5)
    system = _ode({s[0]: f"-rate*{s[0]} + {u[0]}{w}"}, _number(rng, 0.2, 1.0), rng, rate=rate)
    return system, {s[0]: _axis(-1.3, 2.1, None)}, {s[0]: 0.1}, 1.3


def _pendulum(rng, s, u, w):
    x, y = s[:2]
    texts = {x: y, y: f"-{_number(rng, 0.5, 2)}*sin({x}) - damping*{y} + {u[0]}{w}"}
    system = _ode(texts, _number(rng, 0.4, 1.2), rng, damping=_number(rng, 0.1, 0.9))
    box = {x: _axis(-math.pi, math.pi, None, True), y: _axis(-3.3, 3.1, None)}
    return system, box, {x: 0.0, y: 0.0}, 1.5


def _van_der_pol(rng, s, u, w):
    x, y = s[:2]
    texts = {x: y, y: f"mu*(1 - {x}**2)*{y} - {x} + {u[0]}{w}"}
    system = _ode(texts, _number(rng, 0.3, 0.8), rng, mu=_number(rng, -0.8, 0.8))
    box = {x: _axis(-2.7, 2.9, None), y: _axis(-3.1, 3.3, None)}
    return system, box, {x: 0.0, y: 0.0}, 1.5


def _car(rng, s, u, w):
    x, y, h = s[:3]
    texts = {x: f"cos({h})", y: f"sin({h}){w}", h: u[0] if u[0] != "0" else "0.7"}
    box = {
        x: _axis(-1.5, 1.7, None),
        y: _axis(-1.4, 1.6, None),
        h: _axis(-math.pi, math.pi, None, True),
    }
    return _ode(texts, _number(rng, 0.4, 0.9), rng), box, {x: 0.1, y: 0.1, h: 0.3}, 1.5


FAMILIES = [
    _linear,
    _logistic,
    _expanding,
    _tent,
    _standard,
    _cat,
    _rotation,
    _henon,
    _walk,
    _bounded,
    _decay,
    _pendulum,
    _van_der_pol,
    _car,
]
STATE_NAMES = [("x", "y", "z"), ("q", "p", "angle"), ("x2", "x1", "x_3")]
CONTROL_NAMES = [("u", "v"), ("force", "a_1")]


# ---------------------------------------------------------------------------------------- the parts


def _controls(rng: np.random.Generator, names: list[str], size: float) -> Problem:
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


def _noise(rng: np.random.Generator, names: list[str]) -> Problem:
    noise: Problem = {}
    for name in names:
        kind = rng.random()
        if kind < 0.4:
            points = int(rng.integers(1, 4))
            noise[name] = {"normal": {"std": _number(rng, 0.01, 0.1), "points": points}}
        elif kind < 0.6:
            noise[name] = {"values": [0.04, -0.04], "weights": [0.5, 0.5]}
        elif kind < 0.8:
            noise[name] = {"values": [-0.05, 0.0, 0.07], "weights": [0.1, 0.2, 0.7]}
        else:  # a node of weight zero, far outside
            noise[name] = {"values": [0.03, 50.0, -0.06], "weights": [0.25, 0, 0.75]}
    return noise


def _sampling(rng: np.random.Generator, names: list[str], most: int) -> Problem:
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


def _cost(rng: np.random.Generator, states, controls, noise, point: dict[str, float]) -> str:
    u, x = (controls or ["0"])[0], states[0]
    squares = " + ".join(f"({n} - {v})**2" for n, v in point.items())
    efforts = "".join(f" + {_number(rng, 0.1, 1)}*{c}**2" for c in controls)
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


def _attractor(rng: np.random.Generator, problem: Problem, point: dict[str, float]) -> Problem:
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


def _boxes(rng: np.random.Generator, problem: Problem, size: float) -> list[Problem]:
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


def _gamma(rng: np.random.Generator, problem: Problem) -> float | None:
    kind = rng.random()
    if kind < 0.12:
        return None  # the default
    if kind < 0.24:
        return 1.0 if rng.random() < 0.7 else 1
    if kind < 0.4:
        return _number(rng, 0.5, 0.999)
    if kind < 0.5:
        return _number(rng, 1.001, 1.1)
    bracket = gamma_bracket(compile_reference(problem))
    bar = bracket[0] if bracket else 2.0
    if bar > 20:
        return _number(rng, 1.0, 3.0)
    factor = float(rng.choice([0.5, 0.9, 0.99, 0.999, 1.001, 1.01, 1.1, 1.5]))
    gamma = 1 + (bar - 1) * factor if factor < 1 else bar * factor
    return float(f"{gamma:.9g}")


# ------------------------------------------------------------------------------------ the generator


def random_problem(rng: np.random.Generator) -> Problem:
    """Draw a small valid problem."""
    while True:
        problem = _attempt(rng)
        try:
            compile_reference(problem)  # refuses a cost that is negative or not finite
        except ValueError:
            continue
        return problem


def _attempt(rng: np.random.Generator) -> Problem:
    states = STATE_NAMES[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
    all_controls = CONTROL_NAMES[int(rng.choice(2, p=[0.8, 0.2]))]
    controls = list(all_controls[: int(rng.choice(3, p=[0.12, 0.6, 0.28]))])
    noise_names = ["w", "gust"][: int(rng.choice(3, p=[0.6, 0.3, 0.1]))]
    terms = [*controls, "0", "0"][:2]
    if len(controls) == 1 and rng.random() < 0.7:
        terms[1] = controls[0]
    shape = f"*(1 + {states[0]}/3)" if rng.random() < 0.3 else ""
    noise_term = "".join(f" + {n}{shape}" for n in noise_names)

    family = FAMILIES[int(rng.integers(len(FAMILIES)))]
    system, box, point, size = family(rng, states, terms, noise_term)
    if noise_names and noise_term not in str(system):  # a system that shows no noise has none
        noise_names = []

    d = len(box)
    expense = 4 * system.get("substeps", 1) if system["kind"] == "ode" else 1
    for axis in box.values():
        axis["cells"] = int(rng.integers(*[(1, 41), (2, 13), (2, 6)][d - 1]))
    problem: Problem = {
        "format": "lmdsl/1",
        "name": f"random {family.__name__[1:]}",
        "system": system,
        "state_box": box,
        "attractor": {},
        "control_grid": _controls(rng, controls, size),
        "stage_cost": _cost(rng, list(box), controls, noise_names, point),
    }
    if noise_names:
        problem["noise"] = _noise(rng, noise_names)
    nodes = len(noise_nodes(problem))
    pairs = len(control_vectors(problem)) * math.prod(a["cells"] for a in box.values())
    most = min(20 // nodes, max(1, EVALUATIONS // (pairs * nodes * expense)))
    problem["sampling"] = _sampling(rng, list(box), max(1, most))
    problem["attractor"] = _attractor(rng, problem, point)

    if rng.random() < 0.35:
        problem["on_exit"] = str(rng.choice(["clip", "clip", "forbid"]))
    if rng.random() < 0.25:
        problem["avoid"] = {"boxes": _boxes(rng, problem, 0.2)}
        if avoid_cells(problem) & attractor_cells(problem):
            del problem["avoid"]
    if rng.random() < 0.25:
        problem["measure"] = {"boxes": _boxes(rng, problem, 0.6)}
        if not measure_cells(problem):
            del problem["measure"]
    if system["kind"] == "ode":
        if rng.random() < 0.3:
            system["judged"] = str(rng.choice(["path", "endpoint", "endpoint"]))
        if rng.random() < 0.3:
            problem["cost_rate"] = problem.pop("stage_cost")
    if rng.random() < 0.2:
        problem["terminal_cost"] = _cost(rng, list(box), [], [], point)
    try:
        gamma = _gamma(rng, problem)
    except ValueError:  # the cost is not valid: the caller draws again
        gamma = None
    if gamma is not None:
        problem["gamma"] = gamma
    return problem


# ------------------------------------------------------------------------------------- corner cases


def _line(
    name: str, text: str, cells: int, high: int, attractor: Problem, controls: Problem, **more
) -> Problem:
    """Make a map of one state x on [0, high], unit cost, one sample in the middle of a cell."""
    axis = _axis(0, high, cells, more.pop("periodic", False))
    problem: Problem = {
        "format": "lmdsl/1",
        "name": name,
        "system": {"kind": "map", "next": {"x": text}},
        "state_box": {"x": axis},
        "attractor": attractor,
        "control_grid": controls,
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 1},
    }
    problem.update(more)
    return problem


FIRST: Problem = {"cells": [[0]]}
STEP: Problem = {"u": {"low": 0, "high": 1, "points": 2}}

CORNER_CASES: list[Problem] = [
    _line("shift", "x - 0.25*u", 4, 1, FIRST, STEP, gamma=1.5),
    # attractors that touch several cells
    _line("point on an edge", "x - u", 4, 4, {"points": [[1]]}, STEP),
    _line("point at high", "x + u", 4, 4, {"points": [{"x": 4}]}, STEP),
    _line("point near an edge", "x - u", 4, 4, {"points": [[1.0000000005]]}, STEP),
    _line("point not near an edge", "x - u", 4, 4, {"points": [[1.000000002]]}, STEP),
    _line("point on the seam", "x - u", 4, 4, {"points": [[4]]}, STEP, periodic=True),
    {
        **_line("point on a corner", "x - u", 4, 4, {"points": [[1, 2]]}, STEP),
        "system": {"kind": "map", "next": {"x": "x - u", "y": "y"}},
        "state_box": {"x": _axis(0, 4, 4), "y": _axis(0, 4, 4, True)},
    },
    _line("box that nearly holds two cells", "x - u", 4, 4, {"boxes": [{"x": [0, 1.9]}]}, STEP),
    # images on edges: sample x = i + 0.5, so that x - 0.5 is an edge
    _line("image on an edge", "x - 0.5*u", 4, 4, FIRST, STEP),
    _line("image at high", "x + 0.5*u", 4, 4, {"cells": [[3]]}, STEP),
    _line("image at low", "x - 0.5*u", 4, 4, {"cells": [[3]]}, {"u": {"values": [1]}}),
    _line(
        "images around edges",
        "where(x < 1, x, where(x < 2, 1 - u*1e-10, where(x < 3, u*1e-10, 4 + u*1e-10)))",
        4,
        4,
        FIRST,
        {"u": {"values": [5, -5, 20, -20]}},
    ),
    # one-cell axes
    {
        **_line("one-cell axis", "x - u", 4, 4, FIRST, STEP),
        "system": {"kind": "map", "next": {"one": "one + 0.25", "x": "x - u", "turn": "turn - 7"}},
        "state_box": {
            "one": _axis(-1, 1, 1),
            "x": _axis(0, 4, 4),
            "turn": _axis(0, 1, 1, True),
        },
        "attractor": {"cells": [[0, 0, 0]]},
    },
    # causes
    _line("everything escapes", "x + 10*u", 4, 4, FIRST, {"u": {"values": [1, -1]}}),
    _line("everything trapped", "x + 0*u", 4, 4, FIRST, STEP),
    _line(  # cell 1 goes to 0 or 3, 2 to 1, 3 leaves the box, 4 stays or goes to 2
        "leads to these",
        "where(x < 2, 0.5 + 3*w, where(x < 3, 1.5, where(x < 4, -1, where(u < 1, 4.5, 2.5))))",
        5,
        5,
        FIRST,
        STEP,
        noise={"w": {"values": [0, 1], "weights": [0.5, 0.5]}},
    ),
    _line(  # cell 2 goes to 1 or, with the other control, to 0 or the trap at 3
        "the risky shortcut does not survive",
        "where(x < 2, 0.5, where(x < 3, where(u < 1, 1.5, 0.5 + 3*w), 3.5))",
        4,
        4,
        FIRST,
        STEP,
        noise={"w": {"values": [0, 1], "weights": [0.5, 0.5]}},
    ),
    _line(  # half of the mass of cell 1 falls into the trap at 3
        "half of it is trapped",
        "where(x < 2, 0.5 + 3*w, where(x < 3, 1.5, 3.5))",
        4,
        4,
        FIRST,
        {},
        noise={"w": {"values": [0, 1], "weights": [0.5, 0.5]}},
    ),
    _line("values not sorted", "x - u", 4, 4, FIRST, {"u": {"values": [2, 0, 1, -1]}}),
    # noise
    _line(
        "zero weight is dropped",
        "x - 1 + w",
        4,
        4,
        FIRST,
        {},
        noise={"w": {"values": [0, 100], "weights": [1, 0]}},
    ),
    _line(
        "small weight counts",
        "x - 1 + w",
        4,
        4,
        FIRST,
        {},
        noise={"w": {"values": [0, 100], "weights": [1 - 1e-12, 1e-12]}},
    ),
    _line(
        "weights that are not dyadic",
        "x - w",
        4,
        4,
        {"cells": [[0], [1]]},
        {},
        noise={"w": {"values": [0, 1, 2], "weights": [0.1, 0.2, 0.7]}},
    ),
    # clip
    _line("clip", "x - 10*u", 4, 4, FIRST, STEP, on_exit="clip"),
    _line(
        "clip with avoid",
        "x - 1 + 10*u",
        4,
        4,
        FIRST,
        {"u": {"values": [1, 0]}},
        on_exit="clip",
        avoid={"boxes": [{"x": [3, 4]}]},
    ),
    _line(
        "avoid touches without overlap",
        "x - u",
        4,
        4,
        FIRST,
        STEP,
        avoid={"boxes": [{"x": [2.0000000005, 2.5]}, {"x": [3.9999999995, 7]}]},
    ),
    _line(
        "clip does not save an infinite image",
        "where(u > 0, 1/(x - 1.5), x - 1)",
        4,
        4,
        FIRST,
        STEP,
        on_exit="clip",
    ),
    # periodic images many turns away, numbers exact in doubles
    _line(
        "many turns",
        "x + 4*u - 1",
        4,
        4,
        FIRST,
        {"u": {"values": [1000000, -1000000, 1099511627776]}},
        periodic=True,
    ),
    _line("NaN for some controls", "sqrt(u)*0 + x - 1", 4, 4, FIRST, {"u": {"values": [-1, 0, 1]}}),
    # the doubling map: V = 1/(1 - gamma/2)
    *(
        _line(
            f"doubling map, gamma {gamma}",
            "2*x",
            2,
            1,
            FIRST,
            {},
            periodic=True,
            gamma=gamma,
            sampling={"kind": "grid", "per_axis": 4},
        )
        for gamma in (0.5, 1, 1.5, 2, 3)
    ),
    # zeros in the cost: staying is free, going costs 1
    _line("stay for free", "x - u", 4, 4, FIRST, STEP, stage_cost="u"),
    _line("stay for free, discounted", "x - u", 4, 4, FIRST, STEP, stage_cost="u", gamma=0.9),
    _line("stay for free, growing", "x - u", 4, 4, FIRST, STEP, stage_cost="u", gamma=1.25),
    _line("all is free", "x - u", 4, 4, FIRST, STEP, stage_cost="0*u", gamma=1.25),
    # conditions, and named subexpressions
    _line("where as a box", "x - u", 6, 6, {"where": "x <= 2 and x > -1"}, STEP),
    _line(
        "where on either side of the seam",
        "x + u - 0.25",
        8,
        4,
        {"where": ["x <= 0.5", "x >= 3.5"]},
        {"u": {"values": [-0.5, 0.5]}},
        periodic=True,
        avoid={"where": "abs(x - 2) < 0.2", "boxes": [{"x": [1, 1.5]}]},
    ),
    _line(
        "where, mod and not",
        "mod(x - u, 8)",
        8,
        8,
        {"where": "not x > 1 or 3 >= x and x >= 2", "cells": [[7]]},
        STEP,
        measure={"where": ["x >= 4", "mod(x, 4) <= 1"]},
    ),
    _line(
        "admissible by state",
        "x - u",
        5,
        5,
        FIRST,
        {"u": {"values": [0, 1, 2]}},
        admissible="u <= 1 or x > 3 and far > 1",
        let={"far": "x - 1.5", "small": "u/2 + far*0"},
        stage_cost="small**2 + where(far < 1 and not u > 0, 2, 1)",
    ),
    _line(
        "let in the map and the density",
        "down + w",
        4,
        4,
        FIRST,
        {"u": {"values": [0, 1]}},
        let={"v": "2*k*u", "down": "x - v", "heavy": "x + k"},
        system={"kind": "map", "parameters": {"k": 0.5}, "next": {"x": "down + w"}},
        noise={"w": {"values": [0, -0.5], "weights": [0.5, 0.5]}},
        on_exit="clip",
    ),
    # measure
    _line(
        "measure outside C",
        "where(x < 3, x - u, x)",
        4,
        4,
        FIRST,
        STEP,
        measure={"boxes": [{"x": [3, 4]}]},
    ),
    _line(
        "measure on one cell",
        "x - u",
        4,
        4,
        FIRST,
        STEP,
        measure={"boxes": [{"x": [0, 1]}, {"x": [1.5, 3]}]},
    ),
]


def describe(problem: Problem) -> str:
    """One line for the message of a failing test."""
    shape = [a.cells for a in read_axes(problem)]
    samples = len(sample_offsets(problem)) * len(noise_nodes(problem))
    return f"{problem.get('name', '')}: cells {shape}, {samples} samples"

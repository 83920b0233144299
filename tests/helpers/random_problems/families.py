"""Families of systems.

Each takes (rng, s, u, w): names of up to three states, up to two controls ("0" beyond those the
problem has), and a noise term ("" or " + ..."). It returns the system, the axes (cells None: to
be chosen), a point worth stabilizing, and the size of a useful control.
"""

import math
from typing import Any

import numpy as np

Problem = dict[str, Any]


def number(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 4)


def axis(low: float, high: float, cells: int, periodic: bool = False) -> dict[str, Any]:
    given: dict[str, Any] = {"low": low, "high": high, "cells": cells}
    return {**given, "periodic": True} if periodic else given


def _linear(rng, s, u, w):
    d = int(rng.integers(1, 4))
    gain = number(rng, 0.35, 1.25)
    A = rng.normal(size=(d, d))
    A = gain * A / max(abs(np.linalg.eigvals(A)).max(), 0.3)
    texts = {}
    for i in range(d):
        terms = [f"{round(float(A[i, j]), 3)}*{s[j]}" for j in range(d)]
        texts[s[i]] = " + ".join(terms) + f" + {u[i % 2]}" + (w if i == 0 else "")
    box = {s[i]: axis(-1.3, 2.1 if i == 0 else 1.7, None) for i in range(d)}
    return {"kind": "map", "next": texts}, box, dict.fromkeys(box, 0.0), 0.8


def _logistic(rng, s, u, w):
    r = number(rng, 2.5, 3.98)
    system = {
        "kind": "map",
        "parameters": {"r": r},
        "next": {s[0]: f"r*{s[0]}*(1 - {s[0]}) + {u[0]}{w}"},
    }
    return system, {s[0]: axis(0, 1, None)}, {s[0]: round(1 - 1 / r, 6)}, 0.25


def _expanding(rng, s, u, w):
    factor = int(rng.integers(2, 4))
    text = f"{factor}*{s[0]} + {number(rng, -0.2, 0.2)} + {u[0]}{w}"
    system = {"kind": "map", "next": {s[0]: text}}
    return system, {s[0]: axis(0, 1, None, True)}, {s[0]: number(rng, 0, 1)}, 0.2


def _tent(rng, s, u, w):
    a = number(rng, 1.2, 1.95)
    text = f"where({s[0]} < 0.5003, a*{s[0]}, a*(1 - {s[0]})) + {u[0]}*cos({s[0]}){w}"
    system = {"kind": "map", "parameters": {"a": a}, "next": {s[0]: text}}
    return system, {s[0]: axis(-0.1, 1.1, None)}, {s[0]: round(a / (1 + a), 6)}, 0.2


def _standard(rng, s, u, w):
    if rng.random() < 0.6 and s[0] == "x" and u[0] == "u" and u[1] in ("u", "0") and not w:
        system: Problem = {"kind": "standard_map", "parameters": {"K": number(rng, 0.1, 1.0)}}
        names = ("x", "y")
    else:
        x, y = names = s[:2]
        kick = f"K*({u[0]})*sin(2*pi*{x})" if u[0] != "0" else f"K*sin(2*pi*{x})"
        texts = {x: f"{x} + {y} + {kick}{w}", y: f"{y} + {kick}"}
        system = {"kind": "map", "parameters": {"K": number(rng, 0.1, 1.0)}, "next": texts}
    box = {n: axis(0, 1, None, True) for n in names}
    return system, box, {names[0]: 0.25, names[1]: 0.5}, 1.0


def _cat(rng, s, u, w):
    x, y = s[:2]
    texts = {x: f"2*{x} + {y} + {u[0]}{w}", y: f"{x} + {y} + {u[1]}"}
    low = number(rng, -0.5, 0)
    box = {x: axis(low, low + 1, None, True), y: axis(0, 1, None, True)}
    return {"kind": "map", "next": texts}, box, {x: low + 0.37, y: 0.61}, 0.3


def _rotation(rng, s, u, w):
    text = f"{s[0]} + {number(rng, -3, 3)} + {u[0]}{w} + {number(rng, 0, 0.5)}*sin({s[0]})"
    system = {"kind": "map", "next": {s[0]: text}}
    return system, {s[0]: axis(-3.1, 3.183, None, True)}, {s[0]: 0.4}, 0.9


def _henon(rng, s, u, w):
    x, y = s[:2]
    texts = {x: f"1 - a*{x}**2 + {y} + {u[0]}{w}", y: f"b*{x}"}
    system = {"kind": "map", "parameters": {"a": number(rng, 0.3, 1.4), "b": 0.3}, "next": texts}
    box = {x: axis(-1.6, 1.7, None), y: axis(-0.5, 0.55, None)}
    return system, box, {x: 0.63, y: 0.19}, 0.5


def _walk(rng, s, u, w):
    """Steps of the control along every axis, pulled back a little; always inside."""
    d = int(rng.integers(1, 4))
    box = {s[i]: axis(-0.7, 2.3, None) for i in range(d)}
    pull = number(rng, 0, 0.3)
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
    box = {s[i]: axis(-1.3, 2.1, None) for i in range(d)}
    point = {n: number(rng, -0.5, 1.2) for n in box}
    return {"kind": "map", "next": texts}, box, point, 0.9


def _ode(texts: dict[str, str], step: float, rng: np.random.Generator, **parameters) -> Problem:
    system: Problem = {"kind": "ode", "derivative": texts, "step": step}
    if parameters:
        system["parameters"] = parameters
    if rng.random() < 0.5:
        system["substeps"] = int(rng.integers(1, 4))
    return system


def _decay(rng, s, u, w):
    rate = number(rng, -0.5, 1.5)
    system = _ode({s[0]: f"-rate*{s[0]} + {u[0]}{w}"}, number(rng, 0.2, 1.0), rng, rate=rate)
    return system, {s[0]: axis(-1.3, 2.1, None)}, {s[0]: 0.1}, 1.3


def _pendulum(rng, s, u, w):
    x, y = s[:2]
    texts = {x: y, y: f"-{number(rng, 0.5, 2)}*sin({x}) - damping*{y} + {u[0]}{w}"}
    system = _ode(texts, number(rng, 0.4, 1.2), rng, damping=number(rng, 0.1, 0.9))
    box = {x: axis(-math.pi, math.pi, None, True), y: axis(-3.3, 3.1, None)}
    return system, box, {x: 0.0, y: 0.0}, 1.5


def _van_der_pol(rng, s, u, w):
    x, y = s[:2]
    texts = {x: y, y: f"mu*(1 - {x}**2)*{y} - {x} + {u[0]}{w}"}
    system = _ode(texts, number(rng, 0.3, 0.8), rng, mu=number(rng, -0.8, 0.8))
    box = {x: axis(-2.7, 2.9, None), y: axis(-3.1, 3.3, None)}
    return system, box, {x: 0.0, y: 0.0}, 1.5


def _car(rng, s, u, w):
    x, y, h = s[:3]
    texts = {x: f"cos({h})", y: f"sin({h}){w}", h: u[0] if u[0] != "0" else "0.7"}
    box = {
        x: axis(-1.5, 1.7, None),
        y: axis(-1.4, 1.6, None),
        h: axis(-math.pi, math.pi, None, True),
    }
    return _ode(texts, number(rng, 0.4, 0.9), rng), box, {x: 0.1, y: 0.1, h: 0.3}, 1.5


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

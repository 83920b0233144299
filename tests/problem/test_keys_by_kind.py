"""Every key with every kind of system: it changes what is compiled, or it is refused by name."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made

import lmdsl as lm
from lmdsl.problem.problem import Problem

COMMON = {
    "state_box": {"x": {"low": -1, "high": 1, "cells": 8}},
    "attractor": {"boxes": [{"x": [-0.25, 0.25]}]},
    "control_grid": {"u": {"values": [-0.5, 0, 0.5]}},
    "stage_cost": "1 + x**2",
    "sampling": {"kind": "grid", "per_axis": 2},
}
SYSTEMS = {
    "map": {"kind": "map", "next": {"x": "0.9*x + 0.5*u"}},
    "ode": {"kind": "ode", "derivative": {"x": "u"}, "step": 1.5},
    "logistic_map": {"kind": "logistic_map"},
    "function": lm.systems.FunctionSystem(next=lambda x, u, **_: {"x": 0.9 * x + 0.5 * u}),
}
KINDS = (*SYSTEMS, "matrices", "data")
FINITE = ("matrices", "data")
NOISE = {"w": {"values": [-0.1, 0.1], "weights": [0.5, 0.5]}}


def declared(kind, **changes):
    """A problem of a kind of system with some keys changed; None takes a key out."""
    if kind in FINITE:
        return finite(kind).replaced(**changes)
    data = {"format": "lmdsl/1", **COMMON, "system": SYSTEMS[kind], **changes}
    return made({key: value for key, value in data.items() if value is not None})


def finite(kind):
    if kind == "matrices":
        P = np.array([[[0, 0.5, 0.5], [0, 0.9, 0.1], [0, 0, 1]], [[1, 0, 0], [0, 0, 1], [0, 0, 1]]])
        return lm.from_matrices(P, np.ones((3, 2)), [2])
    x, u = np.meshgrid(np.linspace(-0.99, 0.99, 40), [-0.5, 0, 0.5])
    own = {key: value for key, value in COMMON.items() if key != "sampling"}
    return lm.from_data(x.ravel(), u.ravel(), (0.6 * x + 0.4 * u).ravel(), **own)


# What a key is changed to; {state} and {control} are the names of the kind.
CHANGES = {
    "avoid": {"avoid": {"boxes": [{"{state}": [-1, -0.4]}]}},
    "admissible": {"admissible": "{state} + {control} < 0.4"},
    "noise": {"noise": NOISE, "stage_cost": "1 + w**2"},
    "cost_rate": {"stage_cost": None, "cost_rate": "2 + {state}**2"},
    "terminal_cost": {"terminal_cost": "3 + {state}**2"},
    "sampling": {"sampling": {"kind": "random", "points": 3}},
    "gamma": {"gamma": 1.01},
    "discount": {"discount": 0.9},
    "on_exit": {"on_exit": "clip"},
    "measure": {"measure": {"density": "1 + {state}**2"}},
    "let": {"let": {"b": "4"}, "admissible": "{state} < b/10"},
    "stage_cost": {"stage_cost": "7 + {state}**2"},
}
# Keys that a kind has no place for; all other pairs must change what is compiled.
REFUSED = {
    "noise": FINITE,
    "cost_rate": ("map", "logistic_map", "function", *FINITE),
    "sampling": FINITE,
    "on_exit": FINITE,
    "stage_cost": ("data",),
}


def filled(value, names):
    if isinstance(value, dict):
        return {filled(key, names): filled(part, names) for key, part in value.items()}
    if isinstance(value, list):
        return [filled(part, names) for part in value]
    if isinstance(value, str):
        return value.replace("{state}", names[0]).replace("{control}", names[1])
    return value


def compiled(problem):
    lp = lm.compile(problem)
    rows = [(lp.rows.exact(k), lp.rows.total(k)) for k in range(lp.K)]
    return lp.gamma, lp.weight.tolist(), lp.cost.tolist(), rows, lp.cell_status.tolist()


@pytest.mark.parametrize("key", CHANGES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_key_has_an_effect_or_is_refused(kind, key):
    before = declared(kind)
    change = filled(CHANGES[key], (before.states[0], before.controls[0]))
    if kind in REFUSED.get(key, ()):
        with pytest.raises(lm.BadInput, match=f"^{key}: "):
            declared(kind, **change)
        return
    assert compiled(declared(kind, **change)) != compiled(before)


def test_no_key_is_forgotten():
    fixed = {"format", "name", "system", "state_box", "attractor", "control_grid"}
    # the one changes the feedback, not what is compiled; the other has tests of its own
    apart = {"local_controller", "successors"}
    assert {*CHANGES} | fixed | apart == {*Problem.model_fields}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("key", ["terminal_cost", "local_controller"])
def test_what_needs_an_attractor(kind, key):
    value = {"terminal_cost": "1", "local_controller": {"kind": "constant"}}[key]
    with pytest.raises(lm.BadInput, match=f"^{key}: .*leave it out") as caught:
        declared(kind, attractor={}, discount=0.9, **{key: value})
    if kind not in FINITE:
        assert "there is no attractor cell" in str(caught.value)


@pytest.mark.parametrize("key", ["step", "substeps", "judged", "derivative", "next"])
@pytest.mark.parametrize("kind", ["map", "ode", "logistic_map", "van_der_pol"])
def test_keys_of_other_kinds_of_system(kind, key):
    own = SYSTEMS.get(kind, {"kind": kind})
    value = {"step": 1, "substeps": 2, "judged": "path"}.get(key, {"x": "x"})
    data = {**own, key: value}
    ode = kind in ("ode", "van_der_pol")
    if key in own or (ode and key in ("step", "substeps", "judged")):
        lm.systems.OdeSystem(**data) if kind == "ode" else None
        return
    with pytest.raises(lm.BadInput, match=rf"system\.{key}: ") as caught:
        made({"format": "lmdsl/1", **COMMON, "system": data})
    says = {"next": "an ode has no next states", "derivative": "a map has no derivative"}
    wanted = says.get(key, "a map has no time between its steps")
    if kind in ("logistic_map", "van_der_pol") and key in says:
        wanted = "the formulas of a system known by name are fixed"
    assert wanted in str(caught.value)


def test_a_key_in_the_wrong_place():
    text = "judged: it is a key of system; move it there"
    with pytest.raises(lm.BadInput, match=text):
        declared("ode", judged="endpoint")
    with pytest.raises(lm.BadInput, match="corners: it is a key of sampling"):
        declared("map", corners=True)


def test_python_functions_where_there_can_be_none():
    def rate(x):
        return x

    words = "a Python function is not accepted here; write formulas as text: only stage_cost"
    for make in (
        lambda: declared("ode", stage_cost=None, cost_rate=rate),
        lambda: declared("map", terminal_cost=rate),
        lambda: lm.systems.OdeSystem(derivative=rate, step=1),
        lambda: lm.systems.OdeSystem(derivative={"x": rate}, step=1),
        lambda: lm.systems.MapSystem(next=rate),
    ):
        with pytest.raises(lm.BadInput, match=words):
            make()
    for key in ("derivative", "step", "substeps", "judged"):
        with pytest.raises(lm.BadInput, match="a FunctionSystem is a map: next returns the states"):
            lm.systems.FunctionSystem(next=rate, **{key: 1})


# Names ---------------------------------------------------------------------------------------

# Field of a formula: what puts one there, and the classes of names that it may use.
ALL, OF_PAIRS, OF_STATES = {"x", "u", "w", "k", "q"}, {"x", "u", "k"}, {"x", "k"}
FIELDS = {
    "system.next.x": (lambda f: {"system": {**SYSTEM, "next": {"x": f}}}, ALL),
    "let.z": (lambda f: {"let": {"q": "u + w", "z": f}}, ALL),
    "stage_cost": (lambda f: {"stage_cost": f}, ALL),
    "terminal_cost": (lambda f: {"terminal_cost": f}, OF_STATES),
    "admissible": (lambda f: {"admissible": f"{f} < 9"}, OF_PAIRS),
    "attractor.where": (lambda f: {"attractor": {"where": f"{f} < 0"}}, OF_STATES),
    "avoid.where": (lambda f: {"avoid": {"where": f"{f} < 0"}}, OF_STATES),
    "measure.where": (lambda f: {"measure": {"where": f"{f} < 0"}}, OF_STATES),
    "measure.density": (lambda f: {"measure": {"density": f}}, OF_STATES),
}
SYSTEM = {"kind": "map", "parameters": {"k": 1}, "next": {"x": "x + u + w"}}
CLASSES = {
    "x": "a state", "u": "a control", "w": "a noise variable", "k": "", "q": "depends on ",
    "nobody": "is not a declared name or function",
}  # fmt: skip


@pytest.mark.parametrize("name", CLASSES)
@pytest.mark.parametrize("field", FIELDS)
def test_a_name_without_a_value_is_called_what_it_is(field, name):
    change, allowed = FIELDS[field]
    data = {"format": "lmdsl/1", **COMMON, "system": SYSTEM, "noise": NOISE, "let": {"q": "u + w"}}
    data |= change(name)
    if name in allowed:
        assert made(data)
        return
    with pytest.raises(lm.BadInput) as caught:
        made(data)
    text = str(caught.value)
    assert text.startswith(f"{field}: character 1: '{name}' ")
    assert CLASSES[name] in text
    if name in ("u", "w"):
        assert "which has no value here; this is a formula in states" in text
        assert "is not a declared name" not in text
        assert ("states, controls and parameters" in text) == (field == "admissible")


def test_the_terminal_cost_named_is_the_one_of_the_formula():
    for more in ({"gamma": 2.0}, {"gamma": 0.5, "discount": 0.5}):
        with pytest.raises(lm.BadInput, match=r"the terminal cost is -3\.0 at x = "):
            lm.compile(declared("map", terminal_cost="-3", **more))
    with pytest.raises(lm.BadInput, match=r"the terminal cost is -3\.0 at state = 2; it must be"):
        lm.compile(declared("matrices", terminal_cost="-3", gamma=0.5))

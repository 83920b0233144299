"""Every fault of a problem is named at once, in words of JSON; see docs/messages.md too."""

from __future__ import annotations

import copy
from random import Random

import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.common.faults import MOST_FAULTS, written


def said(**changes):
    with pytest.raises(lm.BadInput) as caught:
        lm.compile(made({**steps(), **changes}))
    return str(caught.value)


def test_every_fault_is_named_up_to_twenty():
    wrong = {f"key{k:02}": 1 for k in range(MOST_FAULTS)}
    text = said(**wrong)
    assert all(f"{name}: unknown key" in text for name in wrong)
    assert " more" not in text
    assert text.count("known keys:") == 1
    text = said(**wrong, another=1, yet_another=1)
    assert text.endswith("; and 2 more")


def test_formulas_and_sets_are_judged_together():
    text = said(
        system={"kind": "map", "next": {"x": "x + nobody", "y": "x"}},
        stage_cost="cost",
        attractor={"boxes": [{"z": [0, 1]}, {"x": [1, 0]}]},
        avoid={"boxes": [{"w": [0, 1]}]},
        noise={"u": {"values": [0], "weights": [1]}},
        measure={"density": "q"},
    )
    for place in (
        "system.next: 'y'", "system.next.x: character 5: 'nobody'", "stage_cost: character 1:",
        "attractor.boxes[0]: 'z'", "attractor.boxes[1].x: [1.0, 0.0] is empty",
        "avoid.boxes[0]: 'w'", "noise: the name 'u'", "measure.density: character 1: 'q'",
    ):  # fmt: skip
        assert place in text, place


def test_what_a_definition_lacks_is_said_once():
    text = said(let={"d": "nobody"}, stage_cost="d", admissible="d > 0")
    assert text.count("nobody") == 1
    assert text.startswith("let.d: ")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (None, "null"),
        ([1, None], "[1, null]"),
        ({"a": False}, '{"a": false}'),
        (list(range(9)), "a list of 9 entries"),
        (dict.fromkeys("abcdefghi"), "an object of 9 keys"),
        ((1, 2), "[1, 2]"),
        ([object], "[<class 'object'>]"),
    ],
)
def test_values_are_written_as_json_has_them(value, text):
    assert written(value) == text
    assert len(written(["x" * 1000])) < 200


def test_a_cell_is_named_with_its_ends():
    both = said(avoid={"boxes": [{"x": [0.1, 0.9]}]})
    assert both.startswith("avoid: cell [0] (x in [0, 0.25]) is both")
    # Cell 1 is the first free one; its first sample lies at 0.3125.
    cost = said(stage_cost="x - 0.5 + 0*u")
    assert "is -0.1875 at x = 0.3125, u = 0, a sample of cell [1] (x in [0.25, 0.5])" in cost
    density = said(measure={"density": "x - 0.5"})
    assert "-0.375 in cell [0] (x in [0, 0.25])" in density


def test_the_sample_at_fault_is_the_one_named():
    # Only the second sample of the cell under the second control is negative.
    cost = said(stage_cost="where(x > 0.4, 1 - 2*u, 1)")
    assert "is -1.0 at x = 0.4375, u = 1, a sample of cell [1]" in cost


def test_boxes_without_a_cell_are_told_what_to_write():
    text = said(attractor={"boxes": [{"x": [0.3, 0.4]}]})
    assert text.startswith("attractor.boxes[0].x: [0.3, 0.4] holds no whole cell")
    assert "write [0.25, 0.5]" in text
    lm.compile(made({**steps(), "attractor": {"boxes": [{"x": [0.25, 0.5]}]}}))
    assert "lies outside the axis" in said(attractor={"boxes": [{"x": [2, 3]}]})
    assert "measure.boxes[0].x" in said(measure={"boxes": [{"x": [0.3, 0.4]}]})


def test_an_angle_in_degrees_outside_its_axis():
    box = {"x": {"low": -3.14159, "high": 3.14159, "cells": 20}}
    text = said(state_box=box, attractor={"points": [[180]]})
    assert "180 degrees are 3.141592653589793" in text
    assert "degrees" not in said(state_box=box, attractor={"points": [[4]]})


@pytest.mark.parametrize(
    ("change", "fix"),
    [
        ({"attractor": {"points": [1, 0]}}, "[[1, 0]]"),
        ({"attractor": {"points": {"x": 0}}}, '[{"x": 0}]'),
        ({"avoid": {"boxes": {"x": [0, 1]}}}, '[{"x": [0, 1]}]'),
        ({"control_grid": {"u": [-0.3, 0, 0.3]}}, '{"values": [-0.3, 0, 0.3]}'),
        ({"control_grid": {"u": 2}}, '{"values": [2]}'),
        ({"state_box": {"x": [-1, 1]}}, '{"low": -1, "high": 1, "cells": 50}'),
    ],
)
def test_the_fix_is_written_out(change, fix):
    assert fix in said(**change)


def test_kinds_that_no_file_holds_are_not_offered():
    text = said(system={"kind": "ODE", "derivative": {"x": "u"}, "step": 1})
    assert "did you mean 'ode'?" in text
    assert "function" not in text
    assert "matrices" not in text


# Types, unknown keys and formulas together ---------------------------------------------------


def test_formulas_are_judged_beside_types_and_unknown_keys():
    text = said(
        gamma=-1,
        system={"kind": "map", "next": {"x": "x^2"}},
        let={"a": "1 +", "b": "nobody"},
        stage_cost="a + x y",
        terminal_cost="u",
        admissible="x",
        attractor={"cells": [[0]], "where": ["x < 1", "w < 1"]},
        avoid={"where": "x = 1"},
        measure={"density": "2x", "where": "x"},
        noise={"w": {"values": [0], "weights": [2]}},
    )
    for place in (
        "gamma: -1 is not accepted", "noise.w.weights[0]: 2.0 is more than 1",
        "system.next.x: character 2: '^'", "let.a: character 4", "let.b: character 1: 'nobody'",
        "stage_cost: character 7: an operator is missing", "terminal_cost: character 1: 'u' is a c",
        "admissible: character 1: 'x' is not a comparison",
        "attractor.where[1]: character 1: 'w' is a noise variable",
        "avoid.where: character 3: '='", "measure.density: character 1: '2x'",
        "measure.where: character 1: 'x' is not a comparison",
    ):  # fmt: skip
        assert place in text, place
    assert text.count("; and ") == 0


@pytest.mark.parametrize(
    ("change", "count"),
    [
        # What the names are is not known: nothing is said of names, but of everything else.
        ({"statebox": {"x": {"low": 0, "high": 1, "cells": 4}}, "state_box": None}, 0),
        ({"controls": {"v": {"values": [0]}}}, 0),
        ({"noise": 3}, 0),
        ({"system": {"kind": "maps", "next": {"x": "x + v"}}}, 0),
        ({"system": {"kind": "map", "params": {"v": 1}, "next": {"x": "x + v"}}}, 0),
        ({"system": {"kind": "map", "parameters": [1], "next": {"x": "x + v"}}}, 0),
        ({"let": {"v": 1}}, 0),
        ({"control_grid": {"u v": {"values": [0]}}}, 0),
        # They are known: v is none of them.
        ({"gamma": "1"}, 1),
        ({"gamma": "1", "control_grid": {"v": {"values": [0, True]}}, "stage_cost": "u"}, 2),
    ],
)
def test_names_are_judged_where_they_are_known(change, count):
    data = {**steps(), "stage_cost": "v", **change}
    data = {key: value for key, value in data.items() if value is not None}
    with pytest.raises(lm.BadInput) as caught:
        made(data)
    assert str(caught.value).count("is not a declared name") == count, str(caught.value)
    if count:
        return
    data["stage_cost"] = "v*v2 + v^2"
    with pytest.raises(lm.BadInput, match=r"stage_cost: character 9: '\^' is not part"):
        made(data)
    data["stage_cost"] = "v + arcsin(v)"
    with pytest.raises(lm.BadInput, match=r"stage_cost: character 5: 'arcsin' .* mean 'asin'\?"):
        made(data)


def test_faults_of_let_hide_no_others_and_are_said_once():
    text = said(let={"a": "x y", "b": "a + (", "c": "a + b"}, stage_cost="c + z", admissible="c")
    assert text.count("let.a: ") == text.count("let.b: ") == 1
    assert "stage_cost: character 5: 'z'" in text
    assert "admissible: character 1: 'c' is not a comparison" in text
    assert "let.c" not in text


def test_formulas_of_a_problem_in_python_are_judged_too():
    problem = made(steps())
    with pytest.raises(lm.BadInput) as caught:
        problem.replaced(gamma=-1, stage_cost="nobody", system=lm.systems.StandardMap())
    text = str(caught.value)
    assert "gamma: -1" in text
    assert "stage_cost: character 1: 'nobody' is not a declared name" in text


def test_a_file_of_many_wrong_formulas_takes_no_time():
    text = said(gamma=-1, attractor={"where": ["x <"] * 100_000}, let={"a": "x +" * 1_000})
    assert len(text) < 10_000


WRONG = [
    None, -1, 1.5, True, "x", "x^2", "", [], {}, [1], {"x": 1}, {"x": "x^"}, {"kind": "map"},
    {"kind": [1]}, {"kind": "standard_map", "parameters": []}, {"next": {"x": 3}}, ["x < 1", 2],
    {"where": 3}, {"where": ["a", None]}, object(), {1: 2}, {"parameters": {"K": "x"}}, b"x",
    {"x": {"low": 0, "high": 1, "cells": 2}},
]  # fmt: skip


def _places(data, path=()):
    yield path
    if isinstance(data, dict | list):
        for key in data if isinstance(data, dict) else range(len(data)):
            yield from _places(data[key], (*path, key))


@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_wrong_is_one_message(seed):
    """Parts replaced, added and taken out: bad input or a problem, never another error."""
    random = Random(seed)
    whole = {**steps(), "let": {"a": "x + u"}, "noise": {"w": {"values": [0], "weights": [1]}},
             "measure": {"density": "x"}, "avoid": {"where": ["x > 2"]}, "admissible": "u < 3",
             "terminal_cost": "x"}  # fmt: skip
    said_of = []
    for _ in range(400):
        data = copy.deepcopy(whole)
        for _ in range(random.randint(1, 4)):
            *path, last = random.choice([path for path in _places(data) if path] or [("name",)])
            at = data
            for key in path:
                at = at[key]
            if random.random() < 0.6:
                at[last] = copy.deepcopy(random.choice(WRONG))
            elif isinstance(at, dict):
                at.pop(last, None)
                at[random.choice(["zz", "states", "a b", "sin", "judged", 3])] = 1
        try:
            made(data)
        except lm.BadInput as error:
            said_of.append(str(error))
    assert len(said_of) > 200
    assert not [text for text in said_of if "\n" in text]


def test_what_a_function_is_not_is_all_that_is_said():
    for more in ({}, {"step": 0.1}):
        with pytest.raises(lm.BadInput) as caught:
            lm.systems.FunctionSystem(derivative=lambda x: x, **more)
        assert str(caught.value).startswith("derivative: a FunctionSystem is a map")
        assert "missing" not in str(caught.value)
        assert str(caught.value).count("is a map") == 1
    with pytest.raises(lm.BadInput, match="next: required key is missing"):
        lm.systems.FunctionSystem()


def test_forms_and_whole_numbers_are_written_out():
    form = '{"low": ..., "high": ..., "points": ...}'
    uniform = said(noise={"w": {"uniform": [-0.03, 0.03]}})
    assert uniform.endswith(f"write an object in braces: {form}")
    assert said(sampling={"kind": "grid", "per_axis": 7.0}).endswith("write 7, without a point")
    assert said(sampling={"kind": "grid", "per_axis": 7.5}).endswith("write a whole number")

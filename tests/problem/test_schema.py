"""The JSON Schema: standard words only, no stricter than the reader, and every bound of it."""

from __future__ import annotations

import copy
import json
import re
import warnings

import numpy as np
import pydantic
import pytest
from bad_files import BAD, NOISE
from jsonschema import Draft202012Validator
from problems import doubling, standard_map, steps
from random_problems import CORNER_CASES, random_problem
from spoiled_files import spoiled_file

import lmdsl as lm
from lmdsl.common.files import strict_json
from lmdsl.problem import json_schema
from lmdsl.problem.problem import parse_problem

WORDS = {
    "$defs", "$ref", "$schema", "additionalProperties", "allOf",
    "anyOf", "const", "default", "description",
    "enum", "exclusiveMaximum", "exclusiveMinimum", "items", "maxItems", "maxLength",
    "maxProperties", "maximum", "minItems", "minLength", "minProperties", "minimum", "not", "oneOf",
    "pattern", "prefixItems", "properties", "propertyNames", "required", "title", "type",
    "uniqueItems",
}  # fmt: skip
"""Words of JSON Schema (draft 2020-12) in use."""

LQR = {"kind": "lqr", "orbit": [[0.1]], "state_weights": {"x": 1}, "control_weights": {"u": 1}}
LINEAR = {"kind": "linear", "orbit": [{"x": 0.1}], "gain": {"u": {"x": [0.5]}}}
ODE = {"kind": "ode", "derivative": {"x": "u - p"}, "step": 0.1, "substeps": 2,
       "parameters": {"p": 0.5}}  # fmt: skip
VARIED = [
    steps(noise=NOISE, measure={"boxes": [{"x": [0, 1]}], "density": "x"}),
    steps(noise={"w": {"normal": {"std": 0.1, "points": 3}}}, measure={"weights": [1, 1, 1, 1]}),
    steps(local_controller=LQR, avoid={"boxes": [{"x": [0.75, 1]}]}, on_exit="clip"),
    steps(local_controller=LINEAR, sampling={"kind": "sobol", "points": 4, "seed": 2}),
    steps(local_controller={"kind": "constant", "control": {"u": 0}}, name="a", gamma=0.5),
    steps(local_controller={"kind": "hold"}),
    steps(local_controller={"kind": "hold", "partial": True}, successors="enclosed"),
    steps(attractor={"points": [[0.1], {"x": 0.2}], "boxes": [{"x": [0, 0.25]}], "cells": [[0]]}),
    steps(sampling={"kind": "random", "points": 4, "seed": 2}, system=ODE),
    steps(sampling={"kind": "grid", "per_axis": 2}),
    steps(attractor={"where": "x < 0.3"}, avoid={"where": ["x > 0.8", "x == 0.7"]},
          measure={"where": "x > 0.4"}, let={"half": "u/2", "d": "half + x"}, admissible="d < 9"),
    steps(discount=0.5), steps(discount=0.5, attractor={}),
    {**steps(), "$schema": "./lmdsl.schema.json"},
    *(json.loads(json.dumps(dict(kind.problem))) for kind in lm.systems.NAMED.values()),
    doubling(), standard_map(), *CORNER_CASES,
]  # fmt: skip
"""Problems that between them hold every key of the format."""


@pytest.fixture(scope="module")
def schema():
    found = json_schema()
    Draft202012Validator.check_schema(found)
    return found


def places(schema, path=()):
    """Yield every schema inside a schema, with its path."""
    yield path, schema
    for word, inner in schema.items():
        if word in ("properties", "$defs"):
            for key, one in inner.items():
                yield from places(one, (*path, word, key))
        elif word in ("items", "additionalProperties", "propertyNames", "not"):
            if isinstance(inner, dict):
                yield from places(inner, (*path, word))
        elif word in ("anyOf", "oneOf", "prefixItems"):
            for k, one in enumerate(inner):
                yield from places(one, (*path, word, k))


def accepted(data):
    """Return whether the reader takes data; what it says else is in the words of the file."""
    try:
        parse_problem(data)
    except lm.BadInput as error:
        said = str(error)
    else:
        return True
    assert not re.search(r"function-|tuple\[|dict\[|\[key\]|Input should|<[a-z?]*>", said), said
    return False


def test_standard_words_only(schema):
    for path, place in places(schema):
        assert set(place) <= WORDS, path


def test_bounds_stand_with_their_types(schema):
    """minItems says nothing of a number, minimum nothing of a list."""
    kinds = {
        "array": {"items", "maxItems", "minItems", "prefixItems", "uniqueItems"},
        "object": {"additionalProperties", "maxProperties", "minProperties", "properties",
                   "propertyNames", "required"},
        "number": {"exclusiveMaximum", "exclusiveMinimum", "maximum", "minimum"},
        "string": {"maxLength", "minLength", "pattern"},
    }  # fmt: skip
    for path, place in places(schema):
        kind = {"integer": "number"}.get(place.get("type"), place.get("type"))
        for other, words in kinds.items():
            if kind is not None and kind != other:
                assert not words & set(place), path


def test_files_keep_it(schema):
    validator = Draft202012Validator(schema)
    for data in VARIED:
        validator.validate(data)
        assert accepted(data), data
    for name, data, *_ in BAD:
        if "unknown" in name or "missing" in name or "string" in name:
            assert not validator.is_valid(data), name
    assert "FunctionSystem" not in json.dumps(schema)


@pytest.mark.long
def test_what_it_refuses_the_reader_refuses(schema):
    """600 spoiled files, and 100 that are right."""
    validator, refused = Draft202012Validator(schema), 0
    for seed in range(600):
        try:
            data = strict_json(spoiled_file(np.random.default_rng(seed)))
        except lm.BadInput:
            continue
        if isinstance(data, dict) and not validator.is_valid(data):
            refused += 1
            assert not accepted(data), data
    assert refused > 120
    for seed in range(100):
        validator.validate(json.loads(json.dumps(random_problem(np.random.default_rng(seed)))))


def at(data, path):
    for key in path:
        data = data[key]
    return data


def spoilt(place, value):
    """Yield values that break one bound of a schema each, by as little as possible."""
    for word, bound in place.items():
        if word == "minimum" and isinstance(value, int | float):
            yield word, bound - 1
        elif word == "maximum" and isinstance(value, int | float):
            yield word, bound + 1
        elif word in ("exclusiveMinimum", "exclusiveMaximum") and isinstance(value, int | float):
            yield word, bound
        elif word == "minItems" and isinstance(value, list):
            yield word, value[: bound - 1]
        elif word == "maxItems" and isinstance(value, list):
            yield word, (value * (bound + 1))[: bound + 1]
        elif word == "uniqueItems" and isinstance(value, list):
            yield word, [*value, value[0]]
        elif word == "minProperties" and isinstance(value, dict):
            yield word, {}
        elif word == "maxProperties" and isinstance(value, dict):
            extra = {f"n{k}": next(iter(value.values()), 1.0) for k in range(bound + 1)}
            yield word, {**value, **extra}
        elif word == "minLength" and isinstance(value, str):
            yield word, value[: bound - 1]
        elif word == "maxLength" and isinstance(value, str):
            yield word, (value + " " * bound)[: bound + 1]
        elif word == "additionalProperties" and bound is False:
            yield word, {**value, "another": 1}
        elif word == "propertyNames":
            first = next(iter(value.values()), 1.0)
            yield from ((word, {**value, name: first}) for name in ("1", "sin", "a" * 65, "a.b"))
        elif word == "required":
            for key in bound:
                yield word, {k: v for k, v in value.items() if k != key}
        elif word in ("const", "enum", "type"):
            yield word, 3 if isinstance(value, bool) else True


def walk(schema, root, data, path=()):
    """Yield (schema, path in the data) for all that stands in a file."""
    if "$ref" in schema:
        schema = {**at(root, schema["$ref"].split("/")[1:]), **schema}
    yield schema, path
    value = data
    parts = [
        part for part in [*schema.get("oneOf", ()), *schema.get("anyOf", ())]
        if Draft202012Validator({**part, "$defs": root["$defs"]}).is_valid(value)
    ]  # fmt: skip
    for part in parts:
        if len(parts) == 1 or "type" in part or "$ref" in part:  # else another keeps it valid
            yield from walk(part, root, value, path)
    if isinstance(value, dict):
        for key, inner in value.items():
            part = schema.get("properties", {}).get(key, schema.get("additionalProperties"))
            if isinstance(part, dict):
                yield from walk(part, root, inner, (*path, key))
    elif isinstance(value, list) and "items" in schema:
        for k, inner in enumerate(value):
            yield from walk(schema["items"], root, inner, (*path, k))


@pytest.mark.long
def test_every_bound_is_one_of_the_readers(schema):
    """Each bound broken apart, in a file that is right but for it."""
    validator, broken = Draft202012Validator(schema), set()
    for data in VARIED[: -len(CORNER_CASES)]:
        for place, path in walk(schema, schema, data):
            for word, value in spoilt(place, at(data, path)):
                if path:
                    wrong = copy.deepcopy(data)
                    at(wrong, path[:-1])[path[-1]] = value
                else:
                    wrong = value
                assert not validator.is_valid(wrong), (word, path)
                assert not accepted(wrong), (word, path, value)
                broken.add(word)
    assert broken >= WORDS & {
        "additionalProperties", "exclusiveMinimum", "maxItems", "maxLength", "maxProperties",
        "maximum", "minItems", "minLength", "minProperties", "minimum", "propertyNames",
        "required", "type", "uniqueItems",
    }  # fmt: skip


def test_bounds_of_the_models_are_in_it(schema):
    validator = Draft202012Validator(schema)
    by_hand = [
        ("state_box", {"x": {"low": 0, "high": 1, "cells": 0}}),
        ("state_box", {}),
        ("gamma", 0),
        ("discount", 1),
        ("discount", 0),
        ("attractor", {"cells": [[-1]]}),
        ("avoid", {"boxes": []}),
        ("avoid", {}),
        ("avoid", {"where": []}),
        ("attractor", {"where": ["x < 1"] * 101}),
        ("attractor", {"where": ""}),
        ("admissible", ""),
        ("let", {"sin": "x"}),
        ("let", {f"a{k}": "x" for k in range(201)}),
        ("control_grid", {"u": {"values": []}}),
        ("control_grid", {"u": {"low": 0, "high": 1, "points": 0}}),
        ("control_grid", {"u": {"values": [1, 1]}}),
        ("control_grid", {"sin": {"values": [1]}}),
        ("noise", {"w": {"values": [0, 1], "weights": [1.5, -0.5]}}),
        ("noise", {"w": {"normal": {"std": 0, "points": 3}}}),
        ("noise", {"w": {"normal": {"std": 1, "points": 65}}}),
        ("sampling", {"kind": "grid", "per_axis": 0}),
        ("sampling", {"kind": "random", "points": 3, "seed": -1}),
        ("measure", {"weights": []}),
        ("measure", {"weights": [-1]}),
        ("stage_cost", ""),
        ("stage_cost", "x" + "+1" * 2000),
        ("system", {**ODE, "substeps": 1001}),
        ("system", {**ODE, "step": 0}),
        ("local_controller", {**LQR, "orbit": []}),
        ("local_controller", {"kind": "hold", "partial": 0}),
        ("local_controller", {"kind": "hold", "control": {"u": 0}}),
        ("local_controller", {**LQR, "state_weights": {"x": 0}}),
        ("name", "a" * 1001),
    ]
    for key, value in by_hand:
        assert not validator.is_valid({**steps(), key: value}), (key, value)


class Own(pydantic.BaseModel):
    """Somebody's model of the name of one of ours, that holds problems more than once."""

    first: lm.Problem
    others: list[lm.Problem] | None = None
    next: Own | None = None


class MapSystem(Own):
    pass


@pytest.mark.parametrize("mode", ["validation", "serialization"])
@pytest.mark.parametrize("held", [Own, MapSystem, list[lm.Problem], dict[str, lm.Problem],
                                  lm.Problem | MapSystem, lm.Problem])  # fmt: skip
def test_a_problem_held_several_times(held, mode):
    found = pydantic.TypeAdapter(held).json_schema(mode=mode)
    Draft202012Validator.check_schema(found)
    assert "FunctionSystem" not in json.dumps(found)
    validator, good, bad = Draft202012Validator(found), standard_map(), standard_map(gamma=0)
    wrap = {list[lm.Problem]: lambda p: [p], dict[str, lm.Problem]: lambda p: {"a": p}}.get(
        held, lambda p: p if "Problem" in str(held) else {"first": good, "others": [p]}
    )
    if mode == "validation":
        assert validator.is_valid(wrap(good))
    assert not validator.is_valid(wrap(bad))


def test_models_that_embed_a_problem():
    class Study(pydantic.BaseModel):
        problem: lm.Problem
        author: str

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = Study.model_json_schema()
    Draft202012Validator.check_schema(found)
    validator = Draft202012Validator(found)
    assert validator.is_valid({"problem": standard_map(), "author": "a"})
    spoiled = {**standard_map(), "gamma": 0}
    assert not validator.is_valid({"problem": spoiled, "author": "a"})
    assert lm.Problem.model_json_schema()["required"] == json_schema()["required"]
    for _, place in places(found):
        assert set(place) <= WORDS


@pytest.mark.parametrize("key", ["attractor", "measure"])
@pytest.mark.parametrize("value", [
    {}, {"points": []}, {"points": [], "boxes": [], "cells": []}, {"points": [], "cells": [[0]]},
    {"boxes": [{"x": [0, 0.3]}]}, {"boxes": []}, {"boxes": None}, {"density": None},
    {"boxes": None, "density": "x", "weights": None}, {"density": "x", "weights": [1, 1, 1, 1]},
    {"weights": [1, 1, 1, 1]}, {"points": [[0.1]]}, {"cells": [[0]]}, {"cells": None},
    {"where": "x < 1"}, {"where": ["x < 1"]}, {"where": []}, {"where": None},
    {"where": "x < 1", "boxes": [{"x": [0, 0.3]}]},
])  # fmt: skip
def test_one_of_several_keys_is_needed(schema, key, value):
    data = steps(**{key: value})
    try:
        lm.Problem.model_validate_json(json.dumps(data))
        taken = True
    except lm.BadInput:
        taken = False
    assert Draft202012Validator(schema).is_valid(data) == taken


def test_the_key_of_editors():
    url = "https://example.org/lmdsl.schema.json"
    problem = parse_problem({**steps(), "$schema": url})
    assert problem == parse_problem(steps())
    assert "$schema" not in problem.to_dict()
    with pytest.raises(lm.BadInput, match=r"^\$schema: 3 is not accepted; write a string$"):
        parse_problem({**steps(), "$schema": 3})

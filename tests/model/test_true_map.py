"""The true map: names bound in order, images wrapped and clipped by the one rule."""

from __future__ import annotations

import numpy as np
import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.formulas.enclosures import Jet
from lmdsl.formulas.intervals import Interval
from lmdsl.model.assembly.sampler import Sampler
from lmdsl.model.grid.partition import Partition
from lmdsl.model.true_map import TrueMap

NEXT = {"y": "y - 0.1*b*x + w", "x": "x*a + sin(y) - 3*b"}  # in another order than the axes


def by_hand(x, y, b, a, w):
    return x * a + np.sin(y) - 3 * b, y - 0.1 * b * x + w


def problem(system=None, **more):
    axis = {"low": -1, "high": 1, "cells": 4}
    data = {
        "system": system or {"kind": "map", "next": NEXT},
        "state_box": {"x": axis, "y": {**axis, "periodic": True}},
        "control_grid": {"b": {"values": [0, 1]}, "a": {"values": [0.5, 2]}},
        "noise": {"w": {"values": [-0.5, 0.25], "weights": [0.5, 0.5]}},
        "stage_cost": "1",
    }
    return made(steps(**data, attractor={"cells": [[0, 0]]}, **more))


def true_map(*arguments, **more):
    declared = problem(*arguments, **more)
    return TrueMap(declared, Partition.of(declared))


def values(r=7):
    rng = np.random.default_rng(0)
    return rng.uniform(-2, 2, (r, 2)), rng.uniform(-2, 2, (r, 2)), [rng.uniform(-2, 2, r)]


def function(**given):
    assert list(given) == ["x", "y", "b", "a", "w"]
    x, y = by_hand(**given)
    return {"y": y, "x": x}


@pytest.mark.parametrize("system", [None, lm.systems.FunctionSystem(next=function)])
def test_names_are_bound_in_order_to_the_bit(system):
    x, u, w = values()
    images = true_map(system).images(x, u, w)
    np.testing.assert_array_equal(images, np.stack(by_hand(*x.T, *u.T, *w), axis=-1))


def test_arrays_broadcast_and_keep_their_shapes():
    x, y, w = np.zeros((3, 1)), np.ones((3, 1)), np.arange(2.0)[None, :]
    images = true_map()([x, y], [np.ones((1, 1))] * 2, [w])
    assert [image.shape for image in images] == [(3, 1), (3, 2)]


@pytest.mark.parametrize("wrong", [([0.0], [0.0, 1.0], [0.0]), ([0.0, 0.0], [0.0, 1.0], [])])
def test_every_name_needs_a_value(wrong):
    with pytest.raises(ValueError, match="zip"):
        true_map()(*wrong)


@pytest.mark.parametrize("on_exit", ["forbid", "clip"])
def test_images_wrap_and_clip(on_exit):
    x = np.array([[0.25, 0.75], [4.0, 0.0], [np.nan, 0.0], [-0.5, 1e9]])
    given = problem({"kind": "map", "next": {"x": "x*a + 0*b", "y": "y + w"}}, on_exit=on_exit)
    step = TrueMap(given, Partition.of(given)).step
    states, cells = step(
        {"x": x[:, 0], "y": x[:, 1], "a": np.ones(4), "b": np.ones(4), "w": np.full(4, 0.5)}
    )
    clipped = on_exit == "clip"
    np.testing.assert_array_equal(states[:2], [[0.25, -0.75], [1.0 if clipped else 4.0, 0.5]])
    assert cells.tolist() == [8, 15 if clipped else -1, -1, -1]
    assert np.isnan(states[2:]).any(axis=1).all()  # not finite, and too many turns away


def test_the_model_samples_this_map():
    given = problem()
    sampler = Sampler(given, Partition.of(given))
    for block in sampler.blocks(np.arange(16)):
        named = sampler.values(block)
        for a, b in zip(sampler.step(named), by_hand(**named), strict=True):
            np.testing.assert_array_equal(a, b)


def test_enclosures_hold_the_images():
    (x, u, w), formulas = values(), true_map()
    ends = [Interval(y - 0.01, y + 0.01) for y in x.T]
    jets = [Jet.variable(end, k, 2) for k, end in enumerate(ends)]
    held = [[Jet.constant(y, 2) for y in part] for part in (u.T, w)]
    for jet, image in zip(formulas.enclose(jets, *held), formulas(x.T, u.T, w), strict=True):
        assert ((jet.value.low <= image) & (image <= jet.value.high)).all()
    opaque = true_map(lm.systems.FunctionSystem(next=function))
    assert opaque.enclose(jets, *held) is None

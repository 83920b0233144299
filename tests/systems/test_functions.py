"""Systems written as Python functions: what they may not do is refused, or does not matter."""

from __future__ import annotations

import itertools
import platform

import numpy as np
import pytest
from problems import made, standard_map, steps

import lmdsl as lm
from lmdsl.systems import FunctionSystem
from lmdsl.systems.black_box.function_map import FunctionMap
from lmdsl.systems.black_box.returned import Returned

NOISE = {"w": {"values": [-0.01, 0.01], "weights": [0.5, 0.5]}}


def problem(function, data=None):
    return made(data or steps()).replaced(system=FunctionSystem(next=function))


def right(x, u):
    return {"x": x - 0.25 * u}


@pytest.fixture(scope="module")
def truth():
    return lm.solve(made(steps()))


def same(result, truth):
    assert result.status == "verified"
    np.testing.assert_array_equal(result.value, truth.value)
    np.testing.assert_array_equal(result.control_index, truth.control_index)


# Arguments -----------------------------------------------------------------------------------


def scratch_after_use(x, u):
    image = x - 0.25 * u
    x *= 0
    return {"x": image}


def scratch_out(x, u):
    return {"x": np.subtract(x + 0 * u, 0.25 * u, out=x)}


def scratch_item(x, u):
    image = x - 0.25 * u
    u[...] = 0
    return {"x": image}


@pytest.mark.parametrize("function", [scratch_after_use, scratch_out, scratch_item])
def test_arguments_cannot_be_written_to(function):
    with pytest.raises(lm.BadInput, match=r"system.next: the function writes to its arguments"):
        lm.compile(problem(function))


def test_arguments_that_are_unlocked_are_copies(truth):
    def unlocks(x, u):
        image = x - 0.25 * u
        for array in (x, u):
            array.flags.writeable = True
            array[...] = 0
        return {"x": image}

    same(lm.solve(problem(unlocks)), truth)


def test_other_errors_of_a_function_are_its_own():
    def fails(x, u):
        raise ValueError("mine")

    with pytest.raises(ValueError, match="mine") as raised:
        lm.compile(problem(fails))
    assert not isinstance(raised.value, lm.BadInput)


# Images --------------------------------------------------------------------------------------

KINDS = {
    "complex": (lambda y: y.astype(complex), "complex128"),
    "boolean": (lambda y: y > 0.5, "bool"),
    "dates": (lambda y: (y * 100).astype("datetime64[s]"), "datetime64"),
    "durations": (lambda y: (y * 100).astype("timedelta64[s]"), "timedelta64"),
    "text": (lambda y: y.astype(str), "str"),
    "bytes": (lambda y: y.astype("S8"), "bytes"),
    "objects": (lambda y: y.astype(object), "object"),
    "records": (lambda y: y.astype([("x", float)]), "void"),
    "masked": (lambda y: np.ma.masked_greater(y, 0.5), "masked in"),
    "nothing": (lambda y: None, "object"),
    "ragged": (lambda y: [[1.0], [1.0, 2.0]], "no array of numbers"),
}
SHAPES = {
    "transposed": lambda y: y.T,
    "flat": lambda y: y.ravel(),
    "one row": lambda y: y[0],
    "one sample": lambda y: y.ravel()[:1],
    "last axis": lambda y: y[0, 0, 0],
    "another axis": lambda y: y[None],
    "column": lambda y: y.reshape(-1, 1),
    "too few": lambda y: y[..., :-1],
    "other order": lambda y: y.reshape(y.shape[::-1]),
    "mean of all, in a list": lambda y: [y.mean()],
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_images_are_real_numbers(kind):
    spoil, word = KINDS[kind]
    with pytest.raises(lm.BadInput, match=r"system.next: the image of x") as refused:
        lm.compile(problem(lambda x, u: {"x": spoil(x - 0.25 * u)}))
    assert word in str(refused.value)


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("cells", [4, 40])
def test_images_have_the_shape_of_their_arguments(kind, cells):
    data = steps()
    data["state_box"]["x"]["cells"] = cells
    data["control_grid"]["u"]["values"] = [0, 1, 2]
    with pytest.raises(lm.BadInput, match=r"the image of x has shape .*broadcast to"):
        lm.compile(problem(lambda x, u: {"x": SHAPES[kind](x - 0.25 * u)}, data))


def test_images_of_any_real_kind_are_right(truth):
    for change in (
        np.float64, lambda y: np.ma.MaskedArray(y), lambda y: y.astype(np.longdouble),
        lambda y: y.tolist(), lambda y: y.astype(">f8"), lambda y: np.array(y, order="F"),
    ):  # fmt: skip
        same(lm.solve(problem(lambda x, u, c=change: {"x": c(x - 0.25 * u)})), truth)
        same(lm.solve(problem(lambda x, u, c=change: [c(x - 0.25 * u)])), truth)


def test_images_that_depend_on_few_arguments_are_right():
    data = steps(noise=NOISE)
    for function, formula in (
        (lambda x, u, w: {"x": 0.1}, "0.1 + 0*u"),
        (lambda x, u, w: {"x": np.zeros(())}, "0*u"),
        (lambda x, u, w: {"x": 0.5 - 0.25 * u}, "0.5 - 0.25*u"),
        (lambda x, u, w: {"x": 0.05 + w}, "0.05 + w"),
        (lambda x, u, w: {"x": x}, "x"),
    ):
        own, plain = problem(function, data), made(data).replaced(
            system=lm.systems.MapSystem(next={"x": formula})
        )  # fmt: skip
        assert lm.compile(own).digest == lm.compile(plain).digest


@pytest.mark.parametrize("returned", [None, 7, "x", object(), {"y": 1}, {1: 0}, [], (1, 2)])
def test_what_is_returned_is_one_image_a_state(returned):
    with pytest.raises(lm.BadInput, match=r"system.next: the (function|image)"):
        lm.compile(problem(lambda x, u: returned))


# Purity --------------------------------------------------------------------------------------


def sorts(x, u):
    return {"x": np.sort(x, axis=None).reshape(x.shape) - 0.25 * u}


def centres(x, u):
    return {"x": x - x.mean() + 0.5 - 0.25 * u}


def sums(x, u):
    return {"x": np.cumsum(x, axis=-1) - 0.25 * u}


def rolls(x, u):
    return {"x": np.roll(x, 1, axis=-1) - 0.25 * u}


def reverses(x, u):
    return {"x": x[..., ::-1] - 0.25 * u}


@pytest.mark.parametrize("function", [sorts, centres, sums, rolls, reverses])
def test_a_sample_does_not_depend_on_others(function):
    data = steps()
    data["state_box"]["x"]["cells"] = 30
    data["sampling"] = {"kind": "random", "points": 8}
    with pytest.raises(lm.BadInput, match="must not depend on other samples"):
        lm.compile(problem(function, data))


def test_a_function_that_draws_is_named():
    rng = np.random.default_rng(0)
    with pytest.raises(lm.BadInput, match=r"and later .* x = .*, u = .*declare noise"):
        lm.compile(problem(lambda x, u: {"x": x - 0.25 * u + 1e-6 * rng.normal(size=x.shape)}))


def test_a_function_that_counts_is_named():
    calls = itertools.count()
    with pytest.raises(lm.BadInput, match="keep nothing between calls"):
        lm.compile(problem(lambda x, u: {"x": x - 0.25 * u + 1e-9 * next(calls)}))


def test_a_function_that_changes_in_the_course_of_time_is_named():
    calls = itertools.count()
    data = steps()
    data["state_box"]["x"]["cells"] = 40_000  # several blocks

    def ages(x, u):
        return {"x": x - 0.25 * u * (1 if next(calls) < 12 else 2)}

    with pytest.raises(lm.BadInput, match="keep nothing between calls"):
        lm.compile(problem(ages, data))


def large(function, **more):
    """A problem of several blocks, each far larger than what is asked beforehand."""
    data = steps(**more)
    data["state_box"]["x"]["cells"] = 600
    data["control_grid"] = {"u": {"low": 0, "high": 1, "points": 21}}
    data["sampling"] = {"kind": "grid", "per_axis": 30}
    return problem(function, data)


def by_shape():
    kept = {}

    def function(x, u):
        if x.size <= 500:
            return [x - 0.25 * u]
        return [kept.setdefault((x.shape, u.shape), x - 0.25 * u).copy()]

    return function


def large_only(change):
    def function(x, u):
        image = x - 0.25 * u
        return [change(image) if image.size > 10_000 else image]

    return function


@pytest.mark.parametrize("function", [
    by_shape(), large_only(lambda y: 0.5 * y), large_only(lambda y: np.sort(y, axis=-1)[..., ::-1]),
    large_only(lambda y: np.roll(y, 1, axis=1)), large_only(np.zeros_like),
    large_only(lambda y: np.resize(y.ravel()[:1000], y.shape)),
])  # fmt: skip
def test_large_blocks_are_answered_as_small_ones(function):
    with pytest.raises(lm.BadInput, match=r"among others .* keep nothing between"):
        lm.compile(large(function))


def test_a_function_that_changes_how_doubles_are_rounded_does_not_matter(truth):
    import ctypes

    try:
        libm = ctypes.CDLL("libm.so.6")
    except OSError:
        pytest.skip("no such library")

    def upward(x, u):
        image = x - 0.25 * u
        libm.fesetround(0x800 if platform.machine() == "x86_64" else 0)
        return [image]

    same(lm.solve(problem(upward)), truth)
    assert 1.0 + 2.0**-60 == 1.0


def test_images_in_the_same_memory_are_refused():
    kept = {}

    def stale(x, u):
        shape = np.broadcast_shapes(x.shape, u.shape)
        out = kept.setdefault(shape, np.empty(shape))
        return {"x": np.subtract(x, 0.25 * u, out=out)}

    with pytest.raises(lm.BadInput, match="in the same memory"):
        lm.compile(problem(stale))


def test_images_that_change_later_were_copied():
    kept = np.empty(3)
    step = FunctionMap(lambda x: {"x": np.multiply(x, 2, out=kept)}, Returned(("x",), "next"), {})
    (first,) = step({"x": np.ones(3)})
    step({"x": np.zeros(3)})
    assert first.tolist() == [2, 2, 2]
    assert type(first) is np.ndarray
    assert first.base is None


def test_chaos_and_holes_are_no_faults():
    # NaN, infinity and a map that amplifies rounding are as they are.
    def wild(x, y, u):
        p = np.where(x > 0.9, np.nan, y + 1e3 * np.sin(2e3 * np.pi * x))
        return {"x": np.where(y > 0.99, np.inf, x + 1e4 * p + u), "y": p}

    lm.compile(problem(wild, standard_map(20)))


def test_the_whole_chain_with_noise_local_controller_and_runs(tmp_path):
    data = steps(noise=NOISE, local_controller={"kind": "constant", "control": {"u": 0}})
    own = problem(lambda x, u, w: {"x": x - 0.25 * u + w}, data)
    plain = made(data).replaced(system=lm.systems.MapSystem(next={"x": "x - 0.25*u + w"}))
    mine, theirs = lm.solve(own), lm.solve(plain)
    assert mine.lp.digest == theirs.lp.digest
    assert mine.simulate(starts=200, steps=50) == theirs.simulate(starts=200, steps=50)
    mine.save(tmp_path / "out")
    with pytest.raises(lm.BadInput):
        lm.Result.load(tmp_path / "out").simulate(starts=10)


@pytest.mark.parametrize("vectorized", [True, False])
@pytest.mark.parametrize(
    "function", [lambda y, u: y, lambda x: x, lambda x, u, more: x, lambda x, u, /: x]
)
def test_arguments_that_do_not_fit_are_named(function, vectorized):
    with pytest.raises(lm.BadInput, match=r"system.next: .* called with x, u by name"):
        lm.Problem(
            system=lm.systems.FunctionSystem(next=function, vectorized=vectorized),
            state_box={"x": {"low": 0, "high": 1, "cells": 4}},
            attractor={"boxes": [{"x": [0, 0.25]}]},
            control_grid={"u": {"values": [0]}},
            stage_cost="1",
            sampling={"kind": "grid", "per_axis": 1},
        )

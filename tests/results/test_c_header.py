"""The controller as a C header: compiled, it gives what Python gives, to the same bits."""

import shutil
import subprocess

import numpy as np
import pytest
from c_controller import COMPILER, CompiledController, states
from problems import made, standard_map

import lmdsl as lm
from lmdsl.results.exports import c

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")

GAIN = {"kind": "linear", "gain": {"u": {"x": 0.3, "y": 0.7}},
        "orbit": [{"x": 0.25, "y": 0.5}, {"x": 0.75, "y": 0.5}]}  # fmt: skip


def clipped(local):
    """An interval under clip, and a circle; the attractor about the ends of the circle."""
    return {
        "format": "lmdsl/1",
        "name": "a \\ name */ ??/",
        "system": {"kind": "map", "next": {"x": "0.5*x + u", "y": "y + 0.1*v"}},
        "state_box": {"x": {"low": -1, "high": 1.1, "cells": 7},
                      "y": {"low": -0.3, "high": 0.4, "cells": 6, "periodic": True}},
        "attractor": {"boxes": [{"y": [-0.3, -0.05]}, {"y": [0.25, 0.4]}]},
        "control_grid": {"u": {"values": [0.5, -0.25, 0.0]}, "v": {"values": [1, -1]}},
        "stage_cost": "1",
        "sampling": {"kind": "grid", "per_axis": 2},
        "on_exit": "clip",
        "local_controller": local,
    }  # fmt: skip


LAWS = {
    "none": standard_map(20),
    "linear": standard_map(20, local_controller=GAIN),
    "constant": clipped({"kind": "constant", "control": {"u": -0.25}}),
    "lqr": standard_map(21, local_controller={"kind": "lqr", "orbit": GAIN["orbit"]}),
    "hold": clipped({"kind": "hold", "partial": True}),
}


@pytest.fixture(scope="module", params=LAWS)
def result(request) -> lm.Result:
    return lm.solve(made(LAWS[request.param]))


@needs_compiler
def test_it_is_the_controller_to_the_same_bits(result, tmp_path):
    x = states(result, 20_000)
    u, index = CompiledController(result, tmp_path)(x)
    np.testing.assert_array_equal(u, result.controller(x))
    assert ((index >= 0) == ~np.isnan(u[:, 0])).all()
    plain = (index >= 0) & (index < len(result.control_vectors))
    np.testing.assert_array_equal(u[plain], result.control_vectors[index[plain]])
    assert (index == len(result.control_vectors)).any() == (result.controller.local is not None)


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_a_compiler_of_cpp_takes_it(result, tmp_path):
    lm.exports.export_c(result, tmp_path / "controller.h")
    (tmp_path / "main.cpp").write_text(
        '#include "controller.h"\nint f(double *x, double *u) { return lmdsl_control(x, u); }\n'
    )
    strict = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only"]
    subprocess.run(["g++", *strict, tmp_path / "main.cpp"], check=True)


@needs_compiler
@pytest.mark.long
def test_it_is_the_controller_on_a_million_states(result, tmp_path):
    x = states(result, 1_000_000, seed=1)
    u, _ = CompiledController(result, tmp_path)(x)
    np.testing.assert_array_equal(u, result.controller(x))


@needs_compiler
def test_runs_are_looked_up_as_bits_are(tmp_path, monkeypatch):
    """A table of few runs is written as runs; the same controller as bits gives the same."""
    result = lm.solve(made(standard_map(20)))
    x = states(result, 5_000)
    for name in ("bits", "runs"):
        monkeypatch.setattr(c, "table", lambda code, name=name: forced(code, name))
        folder = tmp_path / name
        folder.mkdir()
        u, _ = CompiledController(result, folder)(x)
        np.testing.assert_array_equal(u, result.controller(x))
        head = (folder / "controller.h").read_text()
        assert ("lmdsl_run[" in head) == (name == "runs")


def forced(code, name):
    """Return a table of one kind: what else the module would have written, too."""
    bits = max(int(code.max()).bit_length(), 1)
    if name == "bits":
        return c._Table("bits", [("uint32_t", "lmdsl_code", c.packed(code, bits))], bits)
    first = np.flatnonzero(np.diff(code, prepend=-1))
    return c._Table("runs", [
        ("uint32_t", "lmdsl_run", first.astype(np.uint32)),
        ("uint8_t", "lmdsl_code", code[first].astype(np.uint8)),
    ], bits)  # fmt: skip


@needs_compiler
def test_a_wrong_table_is_noticed(tmp_path, monkeypatch):
    """A negative control of this comparison: one code changed."""
    result = lm.solve(made(standard_map(20)))
    right = c.codes

    def wrong(controller):
        code = right(controller).copy()
        code[137] = 1 + code[137] % len(controller.vectors)
        return code

    monkeypatch.setattr(c, "codes", wrong)
    x = states(result, 20_000)
    u, _ = CompiledController(result, tmp_path)(x)
    assert not np.array_equal(u, result.controller(x), equal_nan=True)


@pytest.mark.parametrize("bits", range(1, 33))
def test_packed_codes_are_read_as_they_were(bits):
    code = np.random.default_rng(bits).integers(0, 2**bits, 100)
    words = c.packed(code, bits).astype(object)
    at = np.arange(100) * bits
    read = [
        (words[k // 32] | words[k // 32 + 1] << 32) >> k % 32 & (2**bits - 1) for k in at.tolist()
    ]
    assert read == code.tolist()


def test_the_smaller_table_is_written():
    assert c.table(np.repeat([0, 1], 10_000)).name == "runs"
    assert c.table(np.resize([0, 1], 10_000)).name == "bits"


def test_the_head_names_problem_and_model_and_ends_no_comment(tmp_path):
    result = lm.solve(made(LAWS["constant"]))
    lm.exports.export_c(result, tmp_path / "fresh.h")
    result.save(tmp_path / "out")
    lm.exports.export_c(lm.Result.load(tmp_path / "out"), tmp_path / "loaded.h")
    text = (tmp_path / "fresh.h").read_text()
    assert text == (tmp_path / "loaded.h").read_text()
    head = text.split("#ifndef")[0]
    assert result.lp.digest in head
    assert head.count("*/") == 1
    assert "??" not in head


def test_without_a_controller_nothing_is_written(tmp_path):
    nowhere = lm.solve(made(standard_map(8, system={"kind": "map", "next": {"x": "x", "y": "y"}})))
    for export in (lm.exports.export_c, lm.exports.export_onnx):
        with pytest.raises(lm.BadInput, match="no controller to export"):
            export(nowhere, tmp_path / "file")
    assert not list(tmp_path.iterdir())

"""``lmdsl export`` writes every format that it lists, as Python does."""

from importlib import import_module
from importlib.util import find_spec

import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl import cli
from lmdsl.results.formats import FORMATS


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "out"
    result = lm.solve(made(steps()))
    result.save(folder)
    return result, folder


@pytest.mark.parametrize("name", FORMATS)
def test_the_command_line_writes_what_python_writes(saved, name, tmp_path):
    result, folder = saved
    if name == "onnx" and find_spec("onnx") is None:
        pytest.skip("onnx is not installed")
    command = ["export", str(folder), "--format", name, "--out", str(tmp_path / "file")]
    assert cli.main(command) == 0
    module = import_module(f"lmdsl.results.exports.{name}")
    module.write(result, result.lp, str(tmp_path / "python"))
    assert (tmp_path / "file").read_bytes() == (tmp_path / "python").read_bytes()


@pytest.mark.parametrize("name", FORMATS)
def test_no_file_of_the_result_is_written_over(saved, name):
    if name == "onnx" and find_spec("onnx") is None:
        pytest.skip("onnx is not installed")
    _, folder = saved
    before = (folder / "solution.npz").read_bytes()
    command = ["export", str(folder), "--format", name, "--out", str(folder / "solution.npz")]
    assert cli.main(command) == 2
    assert (folder / "solution.npz").read_bytes() == before

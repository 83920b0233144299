"""What the page on other packages says of the functions."""

import inspect
import shutil

import pytest
from pages import ROOT, blocks
from problems import made, standard_map

import lmdsl as lm

PAGE = (ROOT / "docs/interop.md").read_text()


@pytest.mark.parametrize("name", lm.interop.__all__)
def test_every_function_is_described_with_its_signature(name):
    function = getattr(lm.interop, name)
    signature = inspect.signature(function)
    bare = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
    wanted = str(signature.replace(parameters=bare, return_annotation=signature.empty))
    assert f"`{name}{wanted}`".replace("'", '"').removeprefix("`") in PAGE.replace("\n", " ")
    for parameter in signature.parameters:
        assert parameter in (inspect.getdoc(function) or "")


@pytest.mark.parametrize("package", ["xarray", "gymnasium", "python-control", "onnxruntime"])
def test_blocks_run_where_their_package_is(package, tmp_path, monkeypatch):
    """The blocks that the tests of the documentation leave out."""
    pytest.importorskip({"python-control": "control.nlsys"}.get(package, package))
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    result = lm.solve(made(standard_map(12)))
    if package == "onnxruntime":
        pytest.importorskip("onnx")
        lm.exports.export_onnx(result, "controller.onnx")
    space, ran = {"lm": lm, "result": result}, 0
    for page in ("interop", "exports"):
        for block in blocks((ROOT / f"docs/{page}.md").read_text()):
            if block.before == f"<!-- no-run: needs {package} -->":
                exec(block.text, space)
                ran += 1
    assert ran

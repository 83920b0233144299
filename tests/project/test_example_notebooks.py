"""The notebooks of the examples run from top to bottom, and show what is stored in them."""

from __future__ import annotations

import json
import re

import pytest
from pages import ROOT

NOTEBOOKS = sorted((ROOT / "examples/notebooks").glob("*.ipynb"))
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def printed(cell) -> str:
    return "".join("".join(x["text"]) for x in cell["outputs"] if x["output_type"] == "stream")


def kinds(cell) -> set[str]:
    """What a cell shows: text, pictures."""
    return {kind for x in cell["outputs"] for kind in (x["output_type"], *x.get("data", {}))}


def test_there_are_some():
    assert len(NOTEBOOKS) >= 3


@each
def test_they_are_stored_with_outputs_and_are_small(path):
    cells = json.loads(path.read_text())["cells"]
    assert cells[0]["cell_type"] == "markdown"
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == [*range(1, len(code) + 1)]
    assert any(printed(cell) for cell in code)
    assert path.stat().st_size < 400_000
    for cell in cells:
        for target in re.findall(r"\]\(([^)#:]+)[)#]", "".join(cell["source"])):
            assert cell["cell_type"] == "code" or (path.parent / target).exists(), target


@each
def test_they_run(path):
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient and ipykernel")
    nbformat = pytest.importorskip("nbformat")
    stored = nbformat.read(path, as_version=4)
    ran = nbformat.read(path, as_version=4)
    here = {"metadata": {"path": path.parent}}
    nbclient.NotebookClient(ran, resources=here, timeout=300).execute()
    for was, now in zip(stored.cells, ran.cells, strict=True):
        if was.cell_type == "code":
            assert kinds(now) >= kinds(was)

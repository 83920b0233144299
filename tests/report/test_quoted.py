"""A proof in a directory is told as it was found: terminal, certificate and page are equal."""

from __future__ import annotations

import json

import pytest
from command_line import run
from problems import made, standard_map
from reports import LIBRARY, Read

import lmdsl as lm
from lmdsl.proof import proving
from lmdsl.proof.bounds.flights import refining
from lmdsl.report import writing


@pytest.mark.parametrize("more", [(), pytest.param(("--bracket",), marks=pytest.mark.long)])
def test_terminal_certificate_and_page_say_the_same(tmp_path, capsys, monkeypatch, more):
    """Parts are followed, so that the bounds are better than those of the boxes alone."""
    monkeypatch.setattr(writing, "_library", lambda: LIBRARY)
    for module, name, value in ((refining, "FEW", 2**13), (refining, "CLOSE", -1.0),
                                (proving, "FEW", 0), (proving, "GROWN", 1)):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    out = tmp_path / "out"
    lm.solve(made(standard_map(12))).save(out)
    asked = ("prove", out, "--target", "0.5", "--json", *more)
    _, said, _ = run(capsys, *asked)
    terminal = json.loads(said)
    stored = json.loads((out / "certificate.json").read_text())["proof"]
    assert stored["followed"]
    assert (stored["optimum"] is not None) == bool(more)
    assert run(capsys, "report", out)[0] == 0
    text = Read((out / "report.html").read_text()).text
    low, high = stored["cost"]
    assert terminal["cost"] == [low, high]
    assert f"at a mean cost between true map {low:.6g} and {high:.6g} " in text
    assert f"its average cost lies between {low:.6g} and {high:.6g} " in text
    if more:
        low, high = stored["optimum"]
        assert terminal["optimum"] == [low, high]
        assert f"there, at least true map {low:.6g} (this one at most {high:.6g})" in text
        assert "--bracket" in text

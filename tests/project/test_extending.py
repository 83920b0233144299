"""What to touch, as docs/design.md says it: one of each is added to a copy of lmdsl, and works."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from problems import steps

import lmdsl as lm

PACKAGE = Path(lm.__file__).parent

SYSTEM = '''
from typing import ClassVar, Literal

from lmdsl.systems.named import NamedMap


class Halving(NamedMap):
    """x+ = x/2 + u."""

    kind: Literal["halving"] = "halving"
    formulas: ClassVar = {"x": "x/2 + u"}
    summary = "halving"
    source = "none"
    problem: ClassVar = {
        "format": "lmdsl/1",
        "system": {"kind": "halving"},
        "state_box": {"x": {"low": -1, "high": 1, "cells": 20}},
        "attractor": {"points": [{"x": 0}]},
        "control_grid": {"u": {"values": [-0.1, 0, 0.1]}},
        "stage_cost": "1 + u**2",
        "sampling": {"kind": "grid", "per_axis": 3},
    }
'''
BACKEND = """
from dataclasses import replace

from lmdsl.backends import policy_iteration
from lmdsl.backends.base import Backend, Capabilities


def solve(lp, options):
    return replace(policy_iteration.solve(lp, options), details={})


BACKEND = Backend("copying", solve, Capabilities(silent=True))
"""
FORMAT = """
from pathlib import Path


def write(result, lp, path):
    rows = zip(lp.cells, result.value[lp.cells], strict=True)
    Path(path).write_text("".join(f"{cell},{float(value)!r}\\n" for cell, value in rows))
"""
CLAIM = """NONNEGATIVE = Claim(
    "nonnegative", About.POLICY, "V_up", lambda lp, policy, V_up: Found(bool(V_up.min() >= 0)),
    exact_checks.nonnegative, lambda *_: "it costs less than nothing",
)"""


class Copy:
    """A copy of lmdsl that is added to, and the files that were touched."""

    def __init__(self, folder: Path):
        self.folder, self.new, self.changed = folder, set(), set()
        shutil.copytree(PACKAGE, folder / "lmdsl")

    def file(self, name: str, text: str) -> None:
        path = self.folder / "lmdsl" / name
        assert not path.exists()
        path.write_text(f'"""New."""\n{text}')
        self.new.add(name)

    def line(self, name: str, before: str, text: str) -> None:
        """Write a line before the one that begins so."""
        self.change(name, rf"^( *)(?={re.escape(before)})", rf"\1{text}\n\1")

    def change(self, name: str, pattern: str, text: str) -> None:
        path = self.folder / "lmdsl" / name
        changed, count = re.subn(pattern, text, path.read_text(), flags=re.MULTILINE)
        assert count == 1
        path.write_text(changed)
        self.changed.add(name)

    def run(self, *words: object) -> str:
        done = subprocess.run(
            [sys.executable, "-m", "lmdsl", *map(str, words)], cwd=self.folder, check=False,
            capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(self.folder)},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    def solved(self, data: dict[str, object], *options: object) -> dict[str, object]:
        """Solve and verify plain data; return the report."""
        (self.folder / "problem.json").write_text(json.dumps(data))
        report = self.run("solve", "problem.json", "--out", "out", "--json", *options)
        self.run("verify", "out", "--exact")
        return json.loads(report)

    def assert_as_documented(self, what: str) -> None:
        """Compare what was touched with the table of docs/design.md."""
        table = (PACKAGE.parent / "docs/design.md").read_text().split("## What to touch\n")[1]
        (row,) = re.findall(rf"^\| {what} \| (.*?) \|", table, re.MULTILINE)
        told = set(re.findall(r"`([\w/.]+\.py)`", row))
        new = {name for name in told if name.endswith("/NAME.py")}
        assert {str(Path(name).with_name("NAME.py")) for name in self.new} == new
        assert self.changed == told - new


@pytest.fixture
def copy(tmp_path):
    return Copy(tmp_path)


def test_a_named_system_is_a_file_and_a_line(copy):
    copy.file("systems/halving.py", SYSTEM)
    copy.line("systems/__init__.py", "# isort: on",
              "from lmdsl.systems.halving import Halving as Halving")  # fmt: skip
    assert "halving" in json.loads(copy.run("systems", "--json"))
    copy.run("init", "halving")
    report = copy.solved(json.loads((copy.folder / "halving.json").read_text()))
    assert (report["status"], report["stabilizable_cells"]) == ("verified", 18)
    copy.assert_as_documented("a named system")


def test_a_backend_is_a_file_and_a_line(copy):
    copy.file("backends/copying.py", BACKEND)
    copy.line("backends/registry.py", '"ipopt":', '"copying": "lmdsl.backends.copying",')
    report = copy.solved(steps(1.02), "--backend", "copying")
    assert (report["backend"], report["status"]) == ("copying", "verified")
    assert report["cost"] == pytest.approx((3 + 2 * 1.02 + 1.02**2) / 3)
    copy.assert_as_documented("a backend")


def test_an_output_format_is_a_file_and_a_line(copy):
    copy.file("results/exports/tsv.py", FORMAT)
    copy.line("results/formats.py", '"drn":', '"tsv": "for spreadsheets",')
    copy.solved(steps())
    copy.run("export", "out", "--format", "tsv", "--out", "values.tsv")
    values = [line.split(",") for line in (copy.folder / "values.tsv").read_text().splitlines()]
    assert [int(cell) for cell, _ in values] == [1, 2, 3]
    assert [float(value) for _, value in values] == pytest.approx([1, 2, 3])
    copy.assert_as_documented("an output format")


def test_a_problem_key_is_its_model_and_its_use(copy):
    copy.line("problem/problem.py", "gamma: Positive", "price: Positive = 1.0")
    copy.change("model/lp.py", r"cost=own\.cost", r"\g<0> * problem.price")
    assert copy.solved({**steps(), "price": 2})["cost"] == pytest.approx(4)
    assert json.loads((copy.folder / "out/problem.json").read_text())["price"] == 2
    copy.assert_as_documented("a problem key")


def test_a_claim_is_a_field_an_entry_and_an_exact_check(copy):
    copy.line("certificate/claims.py", "reasons: tuple", "nonnegative: bool = False")
    copy.line("certificate/exact_checks.py", "def gap(",
              "def nonnegative(model, V_up):\n    return Found(min(V_up) >= 0)\n\n\n")  # fmt: skip
    copy.line("certificate/judge.py", "CLAIMS = (", CLAIM)
    copy.change("certificate/judge.py", r"^(CLAIMS = .*)\)$", r"\1, NONNEGATIVE)")
    assert copy.solved(steps())["status"] == "verified"
    assert json.loads((copy.folder / "out/certificate.json").read_text())["claims"]["nonnegative"]
    assert json.loads(copy.run("verify", "out", "--json"))["claims"]["nonnegative"]
    copy.assert_as_documented("a claim")

"""Where to start: ``init`` without a name, and ``check``."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest
from command_line import run
from problems import standard_map, steps

import lmdsl as lm
from lmdsl.cli.own_system import SCRIPT, declared
from lmdsl.problem import json_schema
from lmdsl.systems import NAMED


def run_json(capsys, *arguments):
    status, out, _ = run(capsys, *arguments, "--json")
    return status, json.loads(out)


def test_init_without_a_name_writes_a_script_that_runs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, _ = run(capsys, "init")
    assert status == 0
    assert "python own_system.py" in out
    assert run(capsys, "init")[0] == 2  # not overwritten
    done = subprocess.run(
        [sys.executable, "own_system.py"], capture_output=True, text=True, check=True, timeout=300
    )
    assert "nothing looks wrong" in done.stdout
    assert "\nverified: " in done.stdout
    assert re.search(r"reached the attractor +1000", done.stdout)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["own_system.py"]


def test_init_writes_the_bare_file(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(capsys, "init", "--json")[0] == 0
    problem = lm.load("own_system.json")
    assert problem == lm.Problem.model_validate(declared())
    assert run(capsys, "init", "--json", "--out", "mine.json")[0] == 0
    assert lm.load("mine.json") == problem
    assert run(capsys, "init", "--out", "mine.py")[0] == 0
    assert (tmp_path / "mine.py").read_text() == SCRIPT


def test_the_script_names_every_key_and_kind():
    schema = json_schema()
    words = {*schema["properties"]}
    for name, model in schema["$defs"].items():
        words |= {*model.get("properties", {})}
        if name.lower() not in "".join(NAMED).replace("_", ""):
            words.add(model.get("properties", {}).get("kind", {}).get("const", "kind"))
    assert {"map", "ode", "sobol", "lqr"} < words
    written = set(re.findall(r'"([$\w]+)"', SCRIPT))
    assert not words - written


def test_what_the_script_offers_in_comments_is_accepted():
    offered = re.findall(r'^    #     ("\w+": .*),$', SCRIPT, re.MULTILINE)
    assert len(offered) == 7
    for line in offered:
        change = json.loads("{" + line + "}")
        data = {**declared(), **change}
        if "system" in change:
            data |= {
                "state_box": {"x": {"low": -1, "high": 1, "cells": 9}},
                "attractor": {"points": [[0]]},
                "stage_cost": "1",
                "let": {},
            }
        lm.compile(lm.Problem.model_validate(data))


def test_check_has_its_own_exit_statuses(capsys, file):
    status, out, _ = run(capsys, "check", file(standard_map(20)))
    assert status == 0
    assert "nothing looks wrong" in out
    data = steps()
    data["system"]["parameters"] = {"idle": 1}
    status, out, _ = run(capsys, "check", file(data))
    assert status == 1
    assert "unused, system.parameters.idle" in out
    data["stage_cost"] = "-1"
    status, out, err = run(capsys, "check", file(data))
    assert status == 2
    assert "stage_cost" in err
    assert run(capsys, "check", "no_such_file.json")[0] == 2


def test_check_prints_json(capsys, file):
    data = steps()
    data["system"]["parameters"] = {"idle": 1}
    status, found = run_json(capsys, "check", file(data))
    assert status == 1
    (finding,) = found["findings"]
    assert {*finding} == {"code", "where", "text", "remedy", "figures"}
    assert {*found} == {"findings", "expected", "axes", "notes", "suggestion"}
    assert found["expected"]["coverage"] == 1
    data["stage_cost"] = "-1"
    status, found = run_json(capsys, "check", file(data))
    assert (status, found["status"]) == (2, "bad_input")
    assert {*found} == {"status", "message"}


@pytest.mark.parametrize("arguments", [["check"], ["check", "a", "b"], ["init", "a", "b"]])
def test_usage(capsys, arguments):
    assert run(capsys, *arguments)[0] == 2

"""A box that is no union of cells: what became of it is said."""

from __future__ import annotations

import json

import pytest
from problems import made, steps

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.model.grid.partition import Partition
from lmdsl.model.sets import attractor_note

AXES = {"x": {"low": -1, "high": 1, "cells": 6}, "y": {"low": 0, "high": 8, "cells": 8}}


def note(*boxes, axes=AXES):
    data = steps(state_box=axes, attractor={"boxes": [*boxes], "cells": [[0] * len(axes)]})
    data["system"] = {"kind": "map", "next": {name: name for name in axes}}
    problem = made(data)
    return attractor_note(problem, Partition.of(problem))


@pytest.mark.parametrize("box", [
    {"x": [-1, 1]}, {"x": [0, 1]}, {"y": [2, 5]}, {"x": [-9, 9], "y": [-3, 4]}, {},
    {"x": [-2 / 3, 1 / 3]}, {"y": [2 + 1e-10, 5 - 1e-10]},
])  # fmt: skip
def test_nothing_is_said_of_whole_cells(box):
    assert note(box) == ""


def test_what_became_of_it():
    assert note({"x": [-0.5, 0.5]}) == (
        "attractor.boxes[0] asked for x in [-0.5, 0.5], got [-0.333333, 0.333333], whole cells"
    )
    assert note({"x": [-0.5, 9], "y": [1.5, 4]}, {"y": [0, 2]}) == (
        "attractor.boxes[0] asked for x in [-0.5, 1], got [-0.333333, 1], whole cells "
        "and y in [1.5, 4], got [2, 4], whole cells"
    )
    assert note({"y": [1.25, 1.5]}) == "attractor.boxes[0] holds no cell"
    many = note(*[{"y": [0, k + 0.5]} for k in range(6)])
    assert many.count("asked for") == 2
    assert many.endswith("; and 3 boxes more")


def test_every_output_says_it(tmp_path, capsys):
    data = steps(attractor={"boxes": [{"x": [0, 0.4]}]})
    said = "attractor.boxes[0] asked for x in [0, 0.4], got [0, 0.25], whole cells"
    (tmp_path / "p.json").write_text(json.dumps(data))
    assert main(["solve", str(tmp_path / "p.json"), "--json", "--no-simulate"]) == 0
    message = json.loads(capsys.readouterr().out)["message"]
    assert message.startswith("the controller brings every one of 3 cells")
    assert message.endswith(f"; {said}")
    assert main(["solve", str(tmp_path / "p.json"), "--no-simulate"]) == 0
    assert said in capsys.readouterr().out
    result = lm.solve(made(data))
    result.save(tmp_path / "out")
    assert lm.Result.load(tmp_path / "out").message == message
    assert lm.verify(tmp_path / "out").holds
    assert "asked for" not in lm.solve(made(steps())).message
    refused = lm.solve(made({**data, "admissible": "x > 2"}))
    assert refused.status == "not_stabilizable"
    assert said in refused.message

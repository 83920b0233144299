"""Directories of earlier versions mean what they meant."""

import json

import numpy as np
import pytest

import lmdsl as lm
from lmdsl.results.directory import archive


def saved_without(folder, result, *keys):
    """Write a result as a version did that did not know some keys of a system."""
    data = result.problem.to_dict()
    for key in keys:
        del data["system"][key]
    result.save(folder)
    certificate = json.loads((folder / "certificate.json").read_text())
    certificate.pop("files", None)
    certificate.pop("save", None)
    (folder / "problem.json").write_text(json.dumps(data))
    (folder / "certificate.json").write_text(json.dumps(certificate))


@pytest.mark.parametrize("name", ["van_der_pol", "ode"])
def test_steps_were_judged_where_they_end(tmp_path, name):
    data = dict(lm.systems.NAMED["van_der_pol"].problem)
    data["system"] = {**data["system"], "judged": "endpoint"}
    problem = lm.Problem.model_validate(data)
    if name == "ode":
        problem = problem.replaced(system=problem.system.definition())
    result = lm.solve(problem)
    saved_without(tmp_path / "out", result, "judged")
    loaded = lm.Result.load(tmp_path / "out")
    assert loaded.problem.judged == "endpoint"
    assert np.array_equal(loaded.control_index, result.control_index)
    assert lm.verify(tmp_path / "out").holds
    text = (tmp_path / "out" / "problem.json").read_text()
    assert lm.Problem.model_validate(json.loads(text)).judged == "path"  # a file of today


def test_new_directories_say_how_steps_are_judged(tmp_path):
    result = lm.solve(lm.Problem.model_validate(lm.systems.NAMED["inverted_pendulum"].problem))
    result.save(tmp_path / "out")
    data = json.loads((tmp_path / "out" / "problem.json").read_text())
    assert data["system"]["judged"] == "path"
    assert archive.load(tmp_path / "out").problem.judged == "path"


def test_maps_are_left_alone(tmp_path):
    result = lm.solve(lm.load("examples/logistic_map.json"))
    result.save(tmp_path / "out")
    assert lm.Result.load(tmp_path / "out").problem == result.problem

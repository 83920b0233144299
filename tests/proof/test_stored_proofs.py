"""The proof of a directory is read with its result, once it is asked for."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from problems import made
from saved_results import put

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.results.directory import proved

LINE = {
    "format": "lmdsl/1",
    "system": {"kind": "map", "next": {"x": "0.7*x"}},
    "state_box": {"x": {"low": 0, "high": 1, "cells": 8}},
    "attractor": {"boxes": [{"x": [0, 0.25]}]},
    "control_grid": {"u": {"values": [0]}},
    "stage_cost": "x",
    "sampling": {"kind": "grid", "per_axis": 2},
}


@pytest.fixture(scope="module")
def made_proof():
    result = lm.solve(made(LINE))
    return result, result.prove(0.9, bracket=True)


@pytest.fixture
def folder(made_proof, tmp_path):
    result, proof = made_proof
    result.save(tmp_path / "out")
    proved.add(tmp_path / "out", result, proof)
    return tmp_path / "out"


def test_a_loaded_result_has_the_proof_that_was_made(made_proof, folder, monkeypatch):
    proof = made_proof[1]
    monkeypatch.chdir(folder.parent)
    loaded = lm.Result.load("out")
    monkeypatch.chdir("/")  # read later, wherever the process is
    found = loaded.proof
    assert found is loaded.proof
    assert found.to_dict() == proof.to_dict()
    assert found.text() == proof.text()
    assert found.sha256 == proof.sha256
    np.testing.assert_array_equal(found.maps, proof.maps)
    assert found.bound.nonnegative == proof.bound.nonnegative
    assert copy.copy(loaded).proof == found


def test_without_a_proof_there_is_none(made_proof, tmp_path):
    result, _ = made_proof
    assert result.proof is None
    result.save(tmp_path / "out")
    assert lm.Result.load(tmp_path / "out").proof is None


def test_the_boxes_are_not_read_before(folder, monkeypatch):
    monkeypatch.setattr(proved, "read", lambda *_: pytest.fail("read"))
    assert lm.Result.load(folder).verified


def test_a_loaded_result_is_saved_with_its_proof(made_proof, folder, tmp_path):
    lm.Result.load(folder).save(tmp_path / "again")
    assert lm.Result.load(tmp_path / "again").proof.sha256 == made_proof[1].sha256
    assert lm.verify(tmp_path / "again").holds


@pytest.mark.parametrize("name", ["cell", "above", "optimum", "optimum_split"])
def test_a_spoiled_proof_is_refused_when_it_is_asked_for(folder, name):
    path = folder / "proof.npz"
    with np.load(path) as held:
        arrays = {key: held[key] for key in held.files}
    if name not in arrays:
        pytest.skip("nothing was followed")
    arrays[name] = arrays[name] + 7 if "split" in name else arrays[name][:-1]
    put(folder, proof=arrays)
    loaded = lm.Result.load(folder)
    assert loaded.verified
    with pytest.raises(lm.BadInput, match=r"proof\.npz"):
        _ = loaded.proof
    with pytest.raises(lm.BadInput, match=r"proof\.npz"):
        loaded.save(folder.parent / "again")


def test_another_proof_in_its_place_is_not_taken_for_it(folder, capsys):
    loaded = lm.Result.load(folder)
    assert main(["prove", str(folder), "--target", "0.5"]) == 0
    capsys.readouterr()
    with pytest.raises(lm.BadInput, match="another proof"):
        _ = loaded.proof
    assert lm.Result.load(folder).proof.bound is None

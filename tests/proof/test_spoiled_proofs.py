"""Negative controls: a proof that was changed anywhere is refused, box by box or as a whole."""

from __future__ import annotations

import json

import numpy as np
import pytest
from problems import made
from saved_results import put
from test_proof import line

import lmdsl as lm
from lmdsl.cli import main
from lmdsl.proof.checking import faults
from lmdsl.results.directory.proved import loop_of

pytestmark = pytest.mark.long  # in other versions it would find nothing else

FORMULA = "where(x > 0.95, 2, where(abs(x - 0.9) < 0.02, 0.5*x + 0.45, 0.9*x - 0.2))"


@pytest.fixture(scope="module")
def result():
    return lm.solve(made(line(FORMULA, stage_cost="1 + x")))


@pytest.fixture(scope="module")
def proof(result):
    return result.prove(0.85)


@pytest.fixture
def arrays(proof):
    return {name: array.copy() for name, array in proof.arrays().items()}


def found(result, arrays):
    return faults(loop_of(result), arrays, lambda: None)


def one_of(arrays, kind):
    """A box of a class, in the middle of those there are."""
    some = np.flatnonzero(arrays["class"] == kind)
    return int(some[len(some) // 2])


def test_a_proof_as_it_is_holds(result, proof, arrays):
    assert set(proof.kind.tolist()) == {0, 1, 2, 3}
    assert found(result, arrays) == []


def drop(arrays, i):
    return {name: np.delete(array, i, axis=0) for name, array in arrays.items()}


def twice(arrays, i):
    return {name: np.insert(array, i, array[i], axis=0) for name, array in arrays.items()}


def moved(arrays, i):
    arrays["place"][i] ^= 1
    return arrays


def coarser(arrays, i):
    arrays["split"][i] -= 1
    arrays["place"][i] //= 2
    return arrays


def reversed_(arrays, i):
    return {name: array[::-1] for name, array in arrays.items()}


def another_cell(arrays, i):
    arrays["cell"][arrays["cell"] == 3] = 0
    return arrays


def too_deep(arrays, i):
    arrays["split"][i] = 40
    return arrays


def out_of_range(arrays, i):
    arrays["cell"][-1] = 99
    return arrays


def unknown_class(arrays, i):
    arrays["class"][i] = 4
    return arrays


def not_a_number(arrays, i):
    arrays["cost"][i] = np.nan
    return arrays


@pytest.mark.parametrize(
    "spoil",
    [drop, twice, moved, coarser, reversed_, another_cell, too_deep, out_of_range, unknown_class,
     not_a_number],
)  # fmt: skip
def test_boxes_that_do_not_cover_c_once_are_refused(result, arrays, spoil):
    assert found(result, spoil(arrays, one_of(arrays, 1)))


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (0, "class", 1), (0, "class", 2), (0, "class", 3), (1, "class", 2), (1, "class", 3),
        (2, "class", 1), (2, "class", 3), (3, "class", 1), (3, "class", 2), (1, "level", 0),
        (2, "level", 0), (0, "level", 1), (3, "level", 1), (0, "cost", 1.0), (2, "lower", 1.0),
        (3, "cost", 1.0),
    ],
)  # fmt: skip
def test_what_is_said_of_a_box_must_follow(result, arrays, kind, name, value):
    arrays[name][one_of(arrays, kind)] = value
    (reason, *_) = found(result, arrays)
    assert reason.startswith("proof.npz: box ")


@pytest.mark.parametrize(("name", "factor"), [("cost", 1 - 1e-9), ("lower", 1 + 1e-9)])
def test_bounds_that_are_a_little_too_good_are_refused(result, arrays, name, factor):
    """Of every box: whichever it is, the bound follows from those it meets."""
    for i in np.flatnonzero(arrays["class"] == 1):
        spoiled = {key: array.copy() for key, array in arrays.items()}
        spoiled[name][i] *= factor
        assert found(result, spoiled)


def test_levels_that_go_in_a_circle_prove_nothing(result, arrays):
    """All that stays said to arrive, in growing numbers of steps: one of them is too small."""
    stays = np.flatnonzero(arrays["class"] == 3)
    arrays["class"][stays] = 1
    arrays["level"][stays] = np.arange(1, len(stays) + 1)
    arrays["cost"][stays] = 1e9
    assert found(result, arrays)


def held():
    """Two controls, one of which stays where it is."""
    data = line("x - 0.25*u", control_grid={"u": {"values": [0.0, 1.0]}})
    return lm.solve(made(data))


def test_another_controller_is_not_the_one_of_the_proof():
    result = held()
    arrays = result.prove(0.9).arrays()
    loop = loop_of(result)
    assert faults(loop, arrays, lambda: None) == []
    control = loop.control.copy()
    control[2] = 0.0
    assert faults(loop._replace(control=control), arrays, lambda: None)
    status = loop.status.copy()
    status[0] = 2
    assert faults(loop._replace(status=status), arrays, lambda: None)


def spoiled_margin(monkeypatch, data, target):
    """Prove with boxes that lack what ``pieces`` adds at a circle's seam or at outer faces."""
    from lmdsl.proof.images import seen

    true_pieces = seen.pieces

    def bare(partition, cell, split, place):
        index = np.stack(partition.multi_index(cell), axis=-1).astype(float)
        part = 2.0 ** -split.astype(float)
        low = partition.low + (index + place * part) * partition.width
        high = partition.low + (index + (place + 1.0) * part) * partition.width
        return true_pieces(partition, cell, split, place)._replace(
            owner=np.arange(len(cell)), low=low, high=high, start=index
        )

    result = lm.solve(made(data))
    monkeypatch.setattr(seen, "pieces", bare)
    arrays = result.prove(target).arrays()
    assert found(result, arrays) == []  # spoiled alike
    monkeypatch.undo()
    return found(result, arrays)


def test_boxes_without_the_margin_of_edges_are_refused(monkeypatch):
    data = line("where(x < 0.5 and x > 0.5 - 2e-10, 2, 0.1)")
    assert spoiled_margin(monkeypatch, data, 0.9)


def test_boxes_without_the_other_side_of_the_seam_are_refused(monkeypatch):
    data = line("where(x >= 1, 0.1, 0.6)", attractor={"cells": [[2]]})
    data["state_box"]["x"]["periodic"] = True
    data["system"]["next"]["x"] = "where(x >= 0.9999, x - 0.6, 0.6)"
    data["sampling"] = {"kind": "grid", "per_axis": 2}
    assert spoiled_margin(monkeypatch, data, 0.9)


@pytest.fixture
def directory(tmp_path, result):
    result.save(tmp_path / "out")
    assert main(["prove", str(tmp_path / "out"), "--target", "0.85", "--json"]) == 0
    return tmp_path / "out"


def test_a_directory_holds_its_proof(directory, result, capsys):
    capsys.readouterr()
    said = json.loads((directory / "certificate.json").read_text())["proof"]
    with np.load(directory / "proof.npz") as stored:
        assert len(stored["cell"]) == said["boxes"]
    assert main(["verify", str(directory)]) == 0
    assert "proof of the true map" in capsys.readouterr().out
    result.save(directory)
    assert not (directory / "proof.npz").exists()
    assert main(["verify", str(directory)]) == 0


@pytest.mark.parametrize("key", ["arrives", "lost", "steps", "cost", "boxes", "sha256", "holds"])
def test_what_a_certificate_says_of_a_proof_is_checked(directory, key):
    path = directory / "certificate.json"
    said = json.loads(path.read_text())
    said["proof"][key] = {"sha256": "0" * 64, "holds": True, "cost": [1.0, 2.0]}.get(key, 1)
    path.write_text(json.dumps(said))
    assert main(["verify", str(directory)]) != 0


def test_a_spoiled_box_of_a_directory_is_refused(directory, arrays, capsys):
    arrays["level"][one_of(arrays, 1)] = 0
    put(directory, proof=arrays)
    capsys.readouterr()
    assert main(["verify", str(directory)]) == 1
    assert "may take more" in capsys.readouterr().out


def test_a_proof_of_another_result_is_not_added(directory):
    from lmdsl.results.directory import proved

    with pytest.raises(lm.BadInput, match="another save"):
        proved.add(directory, held(), held().prove(0.9))


def test_exit_status_and_output(tmp_path, result, capsys):
    result.save(tmp_path / "out")
    assert main(["prove", str(tmp_path / "out"), "--target", "1", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert [*said] == ["arrives", "lost", "stays", "undecided", "steps", "cost", "boxes",
                       "seconds", "holds", "witnesses", "followed", "optimum",
                       "nonnegative", "parts", "probability", "where", "stopped"]  # fmt: skip
    assert main(["prove", str(tmp_path / "nowhere")]) == 2
    assert main(["prove", str(tmp_path / "out"), "--target", "7"]) == 2
    assert main(["prove", str(tmp_path / "out"), "--target", "0.5"]) == 0
    assert "is proved to arrive" in capsys.readouterr().out
